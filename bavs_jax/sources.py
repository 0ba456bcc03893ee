"""Where a policy's numbers come from: fills a selection's `Context` with what the policy needs."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import numpy as np

from bavs_jax.cameras import Cameras, num_pixels, take
from bavs_jax.candidates import Candidates
from bavs_jax.fields.deformation import vertex_positions, vertices_in_box
from bavs_jax.scenes.images import area_resize
from bavs_jax.selection.directional import DirectionalInformation, Look, make_precision_fn
from bavs_jax.selection.information import (
    DEFAULT_MAX_BYTES,
    Information,
    make_cached_curvature_fn,
)
from bavs_jax.selection.policy import Policy
from bavs_jax.training.batches import PixelTable
from bavs_jax.uncertainty.model import ModelFns, Situation, Toolbox
from bavs_jax.uncertainty.models.laplace import training_curvature
from bavs_jax.uncertainty.posterior import posterior_precision
from bavs_jax.uncertainty.scoring import mean_uncertainty, reduced_cameras
from bavs_jax.uncertainty.streaming import rays_through_pixels

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
                num_rays = int(num_pixels(small).sum())
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

    def candidate_curvature(situation, candidates, seconds):
        dense = make_candidate_curvature_fn(
            toolbox, situation, candidates.cameras, options.image_scale
        )

        def timed(indices):
            with _clock(seconds, "score"):
                return jax.block_until_ready(dense(indices))

        return make_cached_curvature_fn(
            timed,
            num_vertices=toolbox.grid.num_vertices,
            max_bytes=options.cache_bytes,
            group_size=toolbox.group_size,
        )

    def make_information(key, situation, candidates, seconds):
        with _clock(seconds, "curvature"):
            jac_sq_sum = training_curvature(key, toolbox, situation, WEIGHTING)
            precision = posterior_precision(
                jac_sq_sum,
                num_rays=situation.num_rays,
                prior_weight=toolbox.laplace.prior_weight,
                weighting=WEIGHTING,
            )
        return Information(precision, candidate_curvature(situation, candidates, seconds))

    def make_directional(situation, candidates, seconds):
        curvature_fn = candidate_curvature(situation, candidates, seconds)
        with _clock(seconds, "curvature"):
            return directional_information(
                toolbox,
                situation,
                candidates.cameras,
                curvature_fn,
                image_scale=options.image_scale,
                max_bytes=options.cache_bytes,
            )

    def sources(policy: Policy, key, situation: Situation, candidates: Candidates) -> Sources:
        seconds = dict.fromkeys(("curvature", "fit", "score"), 0.0)
        makers = {
            "mean_uncertainty_fn": lambda: make_mean_fn(
                policy, key, situation, candidates, seconds
            ),
            "information": lambda: make_information(key, situation, candidates, seconds),
            "directional": lambda: make_directional(situation, candidates, seconds),
        }
        if true_error_fn is not None:
            makers["true_error_fn"] = lambda: (
                lambda indices: true_error_fn(situation.train, candidates.view_ids[indices])
            )
        # What is missing here is refused by name when the policy asks for it.
        return Sources({n: makers[n]() for n in sorted(policy.needs) if n in makers}, seconds)

    return sources


def directional_information(
    toolbox: Toolbox,
    situation: Situation,
    cameras: Cameras,
    curvature_fn: Callable,
    *,
    image_scale: float,
    max_bytes: int = DEFAULT_MAX_BYTES,
) -> DirectionalInformation:
    """What the training views have told about each side, and what C cameras would add.

    Args:
      toolbox, situation: the field and its training views.
      cameras: the candidates.
      curvature_fn: theirs, as in `Information`.
      image_scale: of the training views' width and height, as for candidates.
      max_bytes: of host memory for precisions that are kept from pick to pick.
    """
    positions = np.asarray(cameras.positions)

    def look_fn(indices):
        for index, (rows, h) in zip(indices, curvature_fn(indices)):
            yield Look(rows, h, positions[index])

    precision_fn = make_precision_fn(
        look_fn,
        vertex_positions(toolbox.grid),
        prior=2.0 * toolbox.laplace.prior_weight,
        max_bytes=max_bytes,
    )
    return DirectionalInformation(
        training_looks(toolbox, situation, image_scale), look_fn, precision_fn
    )


def training_looks(toolbox: Toolbox, situation: Situation, image_scale: float) -> tuple[Look, ...]:
    """The curvature that each training view by itself has brought, at a reduced size.

    Of the same field and by the same rule as that of candidates, so that both can be compared; but
    a view that was trained on is read with its own code, and without its masked pixels.
    """
    views = np.flatnonzero(situation.is_training_view)
    view_rays = make_view_rays_fn(situation.table.cameras, image_scale, situation.table)
    curvature_fn = make_cached_curvature_fn(
        _make_curvature_fn(toolbox, situation, view_rays),
        num_vertices=toolbox.grid.num_vertices,
        max_bytes=0,
        group_size=toolbox.group_size,
    )
    positions = np.asarray(situation.table.cameras.positions)[views]
    return tuple(Look(rows, h, place) for (rows, h), place in zip(curvature_fn(views), positions))


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
    return _make_curvature_fn(toolbox, situation, make_view_rays_fn(cameras, image_scale))


def _make_curvature_fn(toolbox: Toolbox, situation: Situation, view_rays: Callable) -> Callable:
    """`make_candidate_curvature_fn` of the cameras of `view_rays`."""
    counts = 1.0
    if toolbox.laplace.extent == "box":
        counts = vertices_in_box(toolbox.grid)[:, None]

    def curvature(indices):
        of_rays, places, scale = view_rays(indices)
        added = toolbox.curvature(
            situation.train, label=None, weighting=WEIGHTING, group_ids=places, **of_rays
        )
        scale = (2.0 / situation.num_rays * scale).astype(np.float32)[:, None, None]
        return counts * scale * added[: len(indices)]

    return curvature


def make_view_rays_fn(cameras: Cameras, image_scale: float, table: PixelTable | None = None):
    """Makes `view_rays(indices [n]) -> (of_rays, places, scale)`: the rays of reduced images.

    `of_rays` are keywords of `Toolbox.curvature` for all N rays, `places` [N] int32 says of which
    of the n views each is, and `scale` [n] is how many pixels of the photo a ray stands for.

    Args:
      cameras: of which `indices` are; a field reads them as it does when it renders.
      image_scale: of width and height.
      table: where the cameras are those of views trained on: then a field reads each with its own
        code, and a ray counts by the share of its pixels that is not masked.
    """
    small = reduced_cameras(cameras, image_scale)
    whole_rays, small_rays = num_pixels(cameras), num_pixels(small)

    def view_rays(indices):
        num_rays = small_rays[indices]
        views = np.repeat(indices, num_rays).astype(np.int32)
        pixel_ids = np.concatenate([np.arange(num, dtype=np.int32) for num in num_rays])
        of_rays = {"rays": rays_through_pixels(small, views, pixel_ids)}
        if table is not None:
            of_rays["view_ids"] = views
            of_rays["ray_weight"] = _unmasked_shares(table, indices, np.asarray(small.sizes))
        places = np.repeat(np.arange(len(indices), dtype=np.int32), num_rays)
        return of_rays, places, whole_rays[indices] / num_rays

    return view_rays


def _unmasked_shares(table: PixelTable, view_ids, sizes: np.ndarray) -> np.ndarray | None:
    """Share of each pixel of reduced views that is trained on, [N] in [0, 1]; None where all are.

    Args:
      table: the scene's pixels.
      view_ids: [n] views.
      sizes: [V, 2] width and height of the reduced images.
    """
    if len(table.pixel_mask) == 1:
        return None
    mask, offsets = np.asarray(table.pixel_mask), np.asarray(table.offsets)
    shares = []
    for view in view_ids:
        width, height = (int(n) for n in np.asarray(table.cameras.sizes)[view])
        image = mask[offsets[view] : offsets[view + 1]].reshape(height, width, 1)
        shares.append(area_resize(image.astype(np.float64), *(int(n) for n in sizes[view])))
    return np.concatenate([share.ravel() for share in shares]).astype(np.float32)


@contextlib.contextmanager
def _clock(seconds: dict[str, float], name: str):
    """Adds the time of a block to one entry of a table."""
    start = time.perf_counter()
    yield
    seconds[name] += time.perf_counter() - start
