"""Which views may be trained on, and which are only measured."""

import pathlib

import numpy as np

from bavs_jax.scenes.base import SceneError

DEFAULT_POOL = 0.75


def random_split(num_views: int, pool_size: int | float, *, seed: int, path: pathlib.Path):
    """Pool and test views by a permutation from the seed, each sorted, int32.

    Args:
      num_views: how many there are.
      pool_size: an int takes that many, a float in (0, 1] that share of them.
      seed: of the permutation.
    """
    if isinstance(pool_size, float):
        num_pool = round(pool_size * num_views) if 0.0 < pool_size <= 1.0 else 0
    else:
        num_pool = pool_size if isinstance(pool_size, int) else 0
    if num_pool < 1:
        raise SceneError(f"{path}: pool_size {pool_size}: give a count or a share in (0, 1)")
    if num_pool >= num_views:
        raise SceneError(
            f"{path}: pool_size {pool_size} of {num_views} views: the test split is empty: "
            "choose a smaller pool or add views"
        )
    order = np.random.default_rng(seed).permutation(num_views).astype(np.int32)
    return np.sort(order[:num_pool]), np.sort(order[num_pool:])


def every_nth(num_views: int, step: int, *, path: pathlib.Path):
    """Pool and test views, int32: of the sorted views 0, step, 2 step, ... are test views."""
    if not isinstance(step, int) or step < 2:
        raise SceneError(f"{path}: test_every {step}: give 2 or more")
    views = np.arange(num_views, dtype=np.int32)
    is_test = views % min(step, num_views) == 0  # the first view alone, however large the step
    if is_test.all():
        raise SceneError(f"{path}: {num_views} views are too few to train and to test: add some")
    return views[~is_test], views[is_test]


def listed_split(pool, test, num_views: int, *, path: pathlib.Path):
    """Pool and test views as they are listed, each sorted, int32.

    Raises:
      SceneError: a list is empty, they overlap, or a number has no view.
    """
    pool, test = (np.unique(np.asarray(views, np.int32)) for views in (pool, test))
    for name, views in (("pool", pool), ("test", test)):
        if not len(views):
            raise SceneError(f"{path}: the {name} split is empty: list at least one view for it")
        if views[-1] >= num_views:
            raise SceneError(
                f"{path}: the {name} split asks for view {views[-1]} of {num_views}: "
                "choose another split or add the views"
            )
    both = np.intersect1d(pool, test)
    if len(both):
        raise SceneError(
            f"{path}: views {both[:3].tolist()} are in the pool and in the test split: "
            "list each in one"
        )
    return pool, test


def choose_split(
    num_views: int, own_split, *, pool_size, test_every, seed: int, path: pathlib.Path
):
    """The split that the options ask for, or else the files' own, or else a share by the seed.

    Args:
      own_split: (pool, test) that comes with the files, or None.
      test_every: as `step` in `every_nth`, or None.
      num_views, pool_size, seed, path: as in `random_split`; the second may be None.
    """
    if num_views < 2:
        raise SceneError(
            f"{path}: has {num_views} view: give at least 2, one to train and one to test"
        )
    if pool_size is not None and test_every is not None:
        raise SceneError(f"{path}: pool_size and test_every are both given: choose one")
    if test_every is not None:
        return every_nth(num_views, test_every, path=path)
    if pool_size is None and own_split is not None:
        pool, test = own_split
        return listed_split(pool, test, num_views, path=path)
    if pool_size is None:
        pool_size = min(round(DEFAULT_POOL * num_views), num_views - 1)
    return random_split(num_views, pool_size, seed=seed, path=path)
