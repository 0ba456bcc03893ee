"""Where candidate views come from, and how a chosen one becomes a training image."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.arrays import Array
from bavs_jax.cameras import Cameras, hemisphere_poses, take
from bavs_jax.pixel_table import PixelTable
from bavs_jax.scenes.base import Scene


class Candidates(NamedTuple):
    """C cameras to choose from; those outside of `mask` are not on offer."""

    cameras: Cameras  # [C]
    view_ids: np.ndarray  # [C] int32, distinct
    mask: np.ndarray  # [C] bool


class Propose(Protocol):
    """Candidates where the marked views [V] are trained on already; the same C at every call."""

    def __call__(
        self, key: jax.Array, table: PixelTable, is_training_view: Array, /
    ) -> Candidates: ...


class TakePictures(Protocol):
    """The table with the pictures of the candidates `selected` [k] in it, and their view ids [k]:
    rows of the table that may be trained on from now on."""

    def __call__(
        self, table: PixelTable, is_training_view: Array, candidates: Candidates, selected: Array, /
    ) -> tuple[PixelTable, np.ndarray]: ...


class CandidateSource(NamedTuple):
    """Where candidates come from."""

    propose: Propose
    acquire: TakePictures


def dataset_candidates(scene: Scene, *, hemisphere_draws: int | None = None) -> CandidateSource:
    """The unused views of a scene's pool.

    Args:
      hemisphere_draws: None offers every unused view. A number draws that many poses on the
        hemisphere (Eq 14) and offers the nearest unused view of each.
    """
    pool = np.asarray(scene.pool)
    cameras = take(scene.cameras, pool)
    positions = np.asarray(cameras.positions)

    def propose(key, table, is_training_view):
        del table
        mask = ~np.asarray(is_training_view)[pool]
        if hemisphere_draws is not None and mask.any():
            unused = np.flatnonzero(mask)
            poses = scene_hemisphere(key, scene, hemisphere_draws)
            distance = np.linalg.norm(poses[:, None, :, 3] - positions[unused], axis=-1)
            mask = np.zeros_like(mask)
            mask[unused[distance.argmin(axis=1)]] = True
        return Candidates(cameras, pool.astype(np.int32), mask)

    def acquire(table, is_training_view, candidates, selected):
        del is_training_view
        return table, candidates.view_ids[np.asarray(selected)]

    return CandidateSource(propose, acquire)


def captured_candidates(
    scene: Scene,
    capture_fn: Callable[[Cameras], tuple[Array, Array]],
    *,
    num_candidates: int,
    first_slot: int,
    draw_poses: Callable[[jax.Array, int], np.ndarray] | None = None,
) -> CandidateSource:
    """Free poses, photographed when they are chosen.

    Args:
      scene: the scene, with empty views from `first_slot` on (see `with_empty_views`).
      capture_fn: from k cameras to pixels [k * H * W, 3] and alpha [k * H * W], both uint8.
      num_candidates: C.
      first_slot: first view that a picture may be put into.
      draw_poses: from a key and C to poses [C, 3, 4]; None: on the hemisphere (Eq 14).
    """
    first_view = take(scene.cameras, np.asarray(scene.pool)[:1])

    def propose(key, table, is_training_view):
        del table, is_training_view
        if draw_poses is None:
            poses = scene_hemisphere(key, scene, num_candidates)
        else:
            poses = draw_poses(key, num_candidates)
        cameras = jax.tree.map(lambda x: np.repeat(np.asarray(x), num_candidates, 0), first_view)
        return Candidates(
            cameras.replace(world_from_cam=poses),
            np.arange(num_candidates, dtype=np.int32),
            np.ones(num_candidates, bool),
        )

    def acquire(table, is_training_view, candidates, selected):
        selected = np.asarray(selected)
        slot = first_slot + int(np.sum(np.asarray(is_training_view)[first_slot:]))
        view_ids = np.arange(slot, slot + len(selected), dtype=np.int32)
        if view_ids[-1] >= len(is_training_view):
            raise ValueError(
                f"{scene.name}: {len(is_training_view) - slot} empty views left for "
                f"{len(selected)} pictures; make room for more with with_empty_views"
            )
        chosen = take(candidates.cameras, selected)
        return _write_views(table, view_ids, chosen, *capture_fn(chosen)), view_ids

    return CandidateSource(propose, acquire)


def reachable_candidates(source: CandidateSource, current: int, num: int) -> CandidateSource:
    """The candidates of a source that a camera reaches in one move.

    Of those that the source has on offer, the nearest to the current view stay on offer; of equally
    near ones, the first.

    Args:
      source: of all candidates.
      current: row of the pixel table with the view taken last.
      num: most that are reached.
    """

    def propose(key, table, is_training_view):
        candidates = source.propose(key, table, is_training_view)
        here = np.asarray(table.cameras.positions[current])
        distance = np.linalg.norm(np.asarray(candidates.cameras.positions) - here, axis=-1)
        distance = np.where(candidates.mask, distance, np.inf)
        is_near = np.zeros_like(candidates.mask)
        is_near[np.argsort(distance, kind="stable")[:num]] = True
        return candidates._replace(mask=candidates.mask & is_near)

    return CandidateSource(propose, source.acquire)


def scene_hemisphere(key, scene: Scene, num: int) -> np.ndarray:
    """Poses on the hemisphere around a scene, as far away as its cameras are in the median."""
    positions = np.asarray(scene.cameras.positions)[np.asarray(scene.pool)]
    radius = float(np.median(np.linalg.norm(positions - scene.centre, axis=-1)))
    return hemisphere_poses(key, num, centre=scene.centre, radius=radius, up=scene.up)


def candidate_cameras(scene: Scene, poses) -> Cameras:
    """The poses as cameras with the lens of a photo whose image size is the commonest."""
    sizes = np.asarray(scene.cameras.sizes)
    _, first, counts = np.unique(sizes, axis=0, return_index=True, return_counts=True)
    cameras = jax.tree.map(np.asarray, scene.cameras)
    cameras = take(cameras, np.full(len(poses), first[counts.argmax()]))
    return cameras.replace(world_from_cam=np.asarray(poses, np.float32))


def with_empty_views(table: PixelTable, num: int) -> PixelTable:
    """A pixel table with room for `num` more pictures, sized like its first view.

    The new views are blank and stand where the first one does until a picture is written.
    """
    first = int(table.offsets[1])
    cameras = jax.tree.map(
        lambda x: jnp.concatenate([x, jnp.repeat(x[:1], num, axis=0)]), table.cameras
    )
    blank = jnp.zeros((num * first, 3), jnp.uint8)
    mask, alpha = table.pixel_mask, table.alpha
    if mask.shape[0] > 1:
        mask = jnp.concatenate([mask, jnp.ones(num * first, bool)])
    if alpha.shape[0] > 1:
        alpha = jnp.concatenate([alpha, jnp.full(num * first, 255, jnp.uint8)])
    more = table.offsets[-1] + first * jnp.arange(1, num + 1)
    return PixelTable(
        cameras=cameras,
        pixels=jnp.concatenate([table.pixels, blank]),
        pixel_mask=mask,
        offsets=jnp.concatenate([table.offsets, more]),
        alpha=alpha,
    )


def _write_views(table: PixelTable, view_ids, cameras: Cameras, pixels, alpha) -> PixelTable:
    """Puts pictures and their cameras into views of the same size.

    In a table without alpha all pictures count as opaque.
    """
    starts, ends = np.asarray(table.offsets)[view_ids], np.asarray(table.offsets)[view_ids + 1]
    rows = np.concatenate([np.arange(a, b) for a, b in zip(starts, ends)])
    merged = jax.tree.map(lambda old, new: old.at[view_ids].set(new), table.cameras, cameras)
    if table.alpha.shape[0] > 1:
        table = table.replace(alpha=table.alpha.at[rows].set(alpha))
    return table.replace(cameras=merged, pixels=table.pixels.at[rows].set(pixels))
