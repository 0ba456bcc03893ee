"""Where a policy's numbers come from: fills a selection's `Context` with what the policy needs."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.cameras import Cameras, take
from bavs_jax.candidates import Candidates
from bavs_jax.fields.deformation import vertices_in_box
from bavs_jax.selection.information import Information, make_cached_curvature_fn
from bavs_jax.selection.policy import Policy
from bavs_jax.selection.directional import Directional
from bavs_jax.uncertainty.model import ModelFns, Situation, Toolbox
from bavs_jax.uncertainty.models.laplace import training_curvature
from bavs_jax.uncertainty.posterior import posterior_precision
from bavs_jax.uncertainty.scoring import mean_uncertainty, reduced_cameras

WEIGHTING = "eq13"  # of candidates: the only one that needs no photo


class SourceOptions(NamedTuple):
    """How candidates are looked at."""

    image_scale: float  # of width and height, for the score (Eq 15)
    chunk: int  # rays of one compiled call
    cache_bytes: int = 2**30  # most memory for curvatures of candidates; the others are made anew


class Sources(NamedTuple):
    """What a policy may ask for."""

    fields: dict  # of `Context`
    seconds: dict[str, float]  # spent so far on "curvature", "fit" and "score"


def make_sources_fn(
    toolbox: Toolbox,
    models: Mapping[str, Callable],
    options: SourceOptions,
    *,
    track: Callable,
    true_error_fn: Callable | None = None,
) -> Callable:
    """Makes `sources(policy, key, situation, candidates) -> Sources`.

    Args:
      toolbox: the parts of a scene.
      models: name -> `() -> ModelFns`, made when first asked for.
      options: how candidates are looked at.
      track: (total, label, unit) -> a context with `advance(n)`, for progress.
      true_error_fn: (train_state, view_ids [n]) -> mean squared colour error [n] of renders against
        the photos themselves; None where candidates have none.
    """

    def make_mean_fn(policy, key, situation, candidates, seconds):
        fns: ModelFns = models[policy.uncertainty]()
        stage = "fit" if policy.uncertainty != "laplace" else "curvature"
        with _clock(seconds, stage):
            fitted = fns.fit(key, situation)

        def mean_fn(indices, picked):
            with _clock(seconds, "score"):
                known = fitted
                if fns.condition is not None:
                    known = fns.condition(fitted, situation.train, picked)
                small = reduced_cameras(take(candidates.cameras, indices), options.image_scale)
                num_rays = _count_rays(small)
                label = f"{situation.label}: score {len(indices)} views"
                with track(num_rays, label, "rays") as bar:
                    return mean_uncertainty(
                        lambda rays: fns.render(known, situation.train, rays),
                        small,
                        measure=policy.measure,
                        chunk=options.chunk,
                        progress_fn=bar.advance,
                    )

        return mean_fn

    def make_information(key, situation, candidates, seconds):
        with _clock(seconds, "curvature"):
            jac_sq_sum = training_curvature(key, toolbox, situation, WEIGHTING)
            precision = posterior_precision(
                jac_sq_sum,
                num_rays=situation.num_rays,
                prior_weight=toolbox.laplace.prior_weight,
                weighting=WEIGHTING,
            )
        dense = make_candidate_curvature_fn(
            toolbox, situation, candidates.cameras, options.image_scale
        )

        def timed(indices):
            with _clock(seconds, "score"):
                return jax.block_until_ready(dense(indices))

        curvature_fn = make_cached_curvature_fn(
            timed,
            num_vertices=toolbox.grid.num_vertices,
            max_bytes=options.cache_bytes,
            group_size=toolbox.group_size,
        )
        return Information(precision, curvature_fn)

    def make_directional(key, situation, candidates, seconds):
        rows = np.flatnonzero(situation.is_training_view)
        taken = take(situation.table.cameras, rows)
        fn = lambda c: make_cached_curvature_fn(make_candidate_curvature_fn(toolbox, situation, c, options.image_scale),
            num_vertices=toolbox.grid.num_vertices, max_bytes=options.cache_bytes, group_size=toolbox.group_size)
        cfn, tfn = fn(candidates.cameras), fn(taken)
        with _clock(seconds, "curvature"):
            looks = [(*rh, np.asarray(q)) for rh, q in zip(tfn(range(len(rows))), np.asarray(taken.positions))]
        known = {}
        with _clock(seconds, "score"):
            ids = np.flatnonzero(candidates.mask)
            for i, (r, h) in zip(ids, cfn(ids)):
                known[int(i)] = jnp.zeros_like(h)
        d = Directional(known, cfn, np.asarray(candidates.cameras.positions), toolbox, looks)
        return d

    def sources(policy: Policy, key, situation: Situation, candidates: Candidates) -> Sources:
        seconds = dict.fromkeys(("curvature", "fit", "score"), 0.0)
        makers = {
            "mean_uncertainty_fn": lambda: make_mean_fn(
                policy, key, situation, candidates, seconds
            ),
            "information": lambda: make_information(key, situation, candidates, seconds),
        }
        makers["directional"] = lambda: make_directional(key, situation, candidates, seconds)
        if true_error_fn is not None:
            makers["true_error_fn"] = lambda: (
                lambda indices: true_error_fn(situation.train, candidates.view_ids[indices])
            )
        # What is missing here is refused by name when the policy asks for it.
        return Sources({n: makers[n]() for n in sorted(policy.needs) if n in makers}, seconds)

    return sources


def make_candidate_curvature_fn(
    toolbox: Toolbox, situation: Situation, cameras: Cameras, image_scale: float
) -> Callable:
    """Makes `curvature(indices [n]) -> [n, G, 3]`: what photos would add to the precision.

    Eq 13 knows no colours, so a pose is enough. The sum runs over the pixels of a reduced image and
    is scaled up to the pixels that the photo would have; it is in the unit of the posterior's
    precision, `(2 / R) jac_sq_sum` with the run's own R, and 0 outside of what counts
    (`LaplaceOptions.extent`). Rays of all n cameras share compiled calls; n is at most
    `toolbox.group_size`.
    """
    counts = 1.0
    if toolbox.laplace.extent == "box":
        counts = vertices_in_box(toolbox.grid)[:, None]
    small = reduced_cameras(cameras, image_scale)
    whole_rays = np.prod(np.asarray(cameras.sizes), axis=-1)
    small_rays = np.prod(np.asarray(small.sizes), axis=-1)
    table = situation.table
    most = toolbox.group_size

    def curvature(indices):
        # The cameras stand in for the first views, so that all arrays keep the table's shapes and
        # nothing is compiled anew; their pixels are not looked at.
        places, sources = np.arange(len(indices)), np.resize(indices, most)
        stand_in = jax.tree.map(lambda x, y: x.at[:most].set(y[sources]), table.cameras, small)
        num_rays = small_rays[indices]
        added = toolbox.curvature(
            situation.train,
            table.replace(cameras=stand_in),
            np.repeat(places, num_rays).astype(np.int32),
            np.concatenate([np.arange(num, dtype=np.int32) for num in num_rays]),
            None,
            weighting=WEIGHTING,
            by_view=True,
        )
        scale = 2.0 / situation.num_rays * whole_rays[indices] / num_rays
        return counts * scale.astype(np.float32)[:, None, None] * added[: len(indices)]

    return curvature


def _count_rays(cameras) -> int:
    return int(np.prod(np.asarray(cameras.sizes), axis=-1).sum())


@contextlib.contextmanager
def _clock(seconds: dict[str, float], name: str):
    """Adds the time of a block to one entry of a table."""
    start = time.perf_counter()
    yield
    seconds[name] += time.perf_counter() - start
