"""Where a policy's numbers come from: fills a selection's `Context` with what the policy needs."""

import contextlib
import time
from collections.abc import Callable, Iterator
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import numpy as np

from bavs_jax.arrays import Array
from bavs_jax.cameras import Cameras, num_pixels, reduced_cameras, take
from bavs_jax.candidates import Candidates
from bavs_jax.fields.deformation import vertex_positions, vertices_in_box
from bavs_jax.pixel_table import PixelTable
from bavs_jax.progress import Track
from bavs_jax.scenes.images import area_resize
from bavs_jax.selection.directional import (
    DirectionalInformation,
    Look,
    LookFn,
    make_precision_fn,
)
from bavs_jax.selection.information import (
    DEFAULT_MAX_BYTES,
    CurvatureFn,
    DenseCurvatureFn,
    Information,
    make_cached_curvature_fn,
)
from bavs_jax.selection.policy import Policy
from bavs_jax.target_inputs import (
    GAP_TARGETS,
    INFORMATION_TARGETS,
    MakeTargets,
    evenly_spaced_cameras,
    target_information,
    view_gaps,
)
from bavs_jax.uncertainty.channel import mean_uncertainty
from bavs_jax.uncertainty.images import make_image_fn
from bavs_jax.uncertainty.measures import TrueErrorFn
from bavs_jax.uncertainty.model import Acquired, ModelFns, SceneSetup
from bavs_jax.uncertainty.models.laplace import training_curvature
from bavs_jax.uncertainty.posterior import curvature_factor, posterior_precision, prior_precision
from bavs_jax.uncertainty.streaming import CurvatureRays, rays_through_pixels

WEIGHTING = "gauss_newton"  # of candidates: the only one that needs no photo


class LookOptions(NamedTuple):
    """How candidates are looked at."""

    image_scale: float  # of width and height, for the score (Eq 15)
    chunk: int  # rays of one compiled call
    cache_bytes: int = 2**30  # most memory for curvatures of candidates; the others are made anew
    # Most target views, evenly spaced among those there are; None: what each kind can afford.
    num_targets: int | None = None


class PolicyInputs(NamedTuple):
    """What a policy may ask for."""

    fields: dict[str, Any]  # of `Context`, by name
    seconds: dict[str, float]  # spent so far on "curvature", "fit" and "score"


# What a policy needs to know of C candidates; what is missing in it is refused by name when the
# policy asks for it.
MakeInputs = Callable[[Policy, jax.Array, Acquired, Candidates], PolicyInputs]


class InputMaker:
    """Makes the inputs of any policy; a `MakeInputs`."""

    def __init__(
        self,
        setup: SceneSetup,
        model_fns: Callable[[str], ModelFns],
        options: LookOptions,
        *,
        track: Track,
        true_error_fn: TrueErrorFn | None = None,
        make_targets: MakeTargets = lambda key: None,
    ):
        """Makes nothing yet.

        Args:
          setup: the scene's models and grid.
          model_fns: from the name of an uncertainty model.
          options: how candidates are looked at.
          track: shows progress.
          true_error_fn: of a training state; None where candidates have no photos.
          make_targets: the views that policies by target information ask about.
        """
        self.setup, self.model_fns, self.options = setup, model_fns, options
        self.track, self.true_error_fn = track, true_error_fn
        self.make_targets = make_targets
        self._kept: dict[str, tuple[Any, Any, Any]] = {}

    def __call__(
        self, policy: Policy, key, acquired: Acquired, candidates: Candidates
    ) -> PolicyInputs:
        """What is missing here is refused by name when the policy asks for it."""
        seconds = dict.fromkeys(("curvature", "fit", "score"), 0.0)
        makers: dict[str, Callable[..., Any]] = {
            "mean_uncertainty_fn": self._mean_uncertainty,
            "information": self._information,
            "directional": self._directional,
            "targets": self._targets,
            "gaps": self._gaps,
        }
        if self.true_error_fn is not None:
            makers["true_error_fn"] = partial(self._true_error, self.true_error_fn)
        fields = {
            name: makers[name](policy, key, acquired, candidates, seconds)
            for name in sorted(policy.needs)
            if name in makers
        }
        return PolicyInputs(fields, seconds)

    def _once(self, name: str, acquired: Acquired, make: Callable[[], Any]):
        """What depends on field and photos alone; asked again with other candidates, it is kept."""
        train, views, made = self._kept.get(name, (None, None, None))
        if train is not acquired.train or views is not acquired.is_training_view:
            made = make()
            self._kept[name] = acquired.train, acquired.is_training_view, made
        return made

    def _mean_uncertainty(self, policy, key, acquired, candidates, seconds):
        fns, options = self.model_fns(policy.uncertainty), self.options
        with _clock(seconds, "fit" if policy.uncertainty != "laplace" else "curvature"):
            if fns.condition is None:
                fitted = self._once(policy.uncertainty, acquired, partial(fns.fit, key, acquired))
            else:  # it knows the candidates
                fitted = fns.fit(key, acquired)

        def mean_fn(indices, picked):
            with _clock(seconds, "score"):
                known = fitted
                if fns.condition is not None:
                    known = fns.condition(fitted, acquired.train, picked)
                small = reduced_cameras(take(candidates.cameras, indices), options.image_scale)
                num_rays = int(num_pixels(small).sum())
                label = f"{acquired.label}: score {len(indices)} views"
                with self.track(num_rays, label, "rays") as bar:
                    return mean_uncertainty(
                        lambda rays: fns.render(known, acquired.train, rays),
                        small,
                        measure=policy.measure,
                        chunk=options.chunk,
                        progress_fn=bar.advance,
                    )

        return mean_fn

    def _information(self, policy, key, acquired, candidates, seconds):
        with _clock(seconds, "curvature"):
            jac_sq_sum = self._once(
                "curvature",
                acquired,
                partial(training_curvature, key, self.setup, acquired, WEIGHTING),
            )
            precision = posterior_precision(
                jac_sq_sum,
                num_rays=acquired.num_rays,
                prior_weight=self.setup.laplace.prior_weight,
                weighting=WEIGHTING,
            )
        return Information(precision, self._candidate_curvature(acquired, candidates, seconds))

    def _directional(self, policy, key, acquired, candidates, seconds):
        curvature_fn = self._candidate_curvature(acquired, candidates, seconds)
        with _clock(seconds, "curvature"):
            looks = self._training_looks(acquired)
            return directional_information(
                self.setup,
                looks,
                candidates.cameras,
                curvature_fn,
                max_bytes=self.options.cache_bytes,
            )

    def _targets(self, policy, key, acquired, candidates, seconds):
        options = self.options
        look_fn = target_fn = make_look_fn(
            candidates.cameras, self._candidate_curvature(acquired, candidates, seconds)
        )
        cameras, rows = self._target_cameras(key, acquired, candidates, INFORMATION_TARGETS)
        if cameras is not candidates.cameras:
            curvature_fn = self._candidate_curvature(
                acquired, candidates._replace(cameras=cameras), seconds
            )
            target_fn = make_look_fn(cameras, curvature_fn)
        with _clock(seconds, "curvature"):
            return target_information(
                self.setup,
                acquired.num_rays,
                self._training_looks(acquired),
                look_fn,
                lambda numbers: target_fn(rows[numbers]),
                take(cameras, rows),
                max_bytes=options.cache_bytes,
            )

    def _target_cameras(self, key, acquired, candidates, most):
        """Cameras that may be asked about, and which of them [N] are: `most` at most by default."""
        cameras, view_ids = self.make_targets(key), None
        if cameras is None:
            cameras = candidates.cameras if acquired.candidates is None else acquired.candidates
            view_ids = candidates.view_ids[: len(cameras)]
        num = self.options.num_targets or most
        return cameras, evenly_spaced_cameras(cameras.positions, num, view_ids=view_ids)

    def _gaps(self, policy, key, acquired, candidates, seconds):
        cameras, rows = self._target_cameras(key, acquired, candidates, GAP_TARGETS)
        with _clock(seconds, "score"):
            return view_gaps(
                partial(self._plain_images, acquired.train),
                acquired,
                candidates.cameras,
                take(cameras, rows),
                image_scale=self.options.image_scale,
                chunk=self.options.chunk,
            )

    @cached_property
    def _plain_images(self):
        return make_image_fn(self.setup, self.setup.kind)

    def _training_looks(self, acquired):
        make = partial(training_looks, self.setup, acquired, self.options.image_scale)
        return self._once("looks", acquired, make)

    def _true_error(self, true_error_fn, policy, key, acquired, candidates, seconds):
        return lambda indices: true_error_fn(acquired.train, candidates.view_ids[indices])

    def _candidate_curvature(self, acquired, candidates, seconds):
        dense = make_candidate_curvature_fn(
            self.setup, acquired, candidates.cameras, self.options.image_scale
        )

        def timed(indices):
            with _clock(seconds, "score"):
                return jax.block_until_ready(dense(indices))

        return make_cached_curvature_fn(
            timed,
            num_vertices=self.setup.grid.num_vertices,
            max_bytes=self.options.cache_bytes,
            group_size=self.setup.curvature.group_size,
        )


def directional_information(
    setup: SceneSetup,
    looks: tuple[Look, ...],
    cameras: Cameras,
    curvature_fn: CurvatureFn,
    *,
    max_bytes: int = DEFAULT_MAX_BYTES,
) -> DirectionalInformation:
    """What the training views have told about each side, and what C cameras would add.

    Args:
      setup: the scene's grid and prior.
      looks: of the training views, at the candidates' image scale.
      cameras: the candidates.
      curvature_fn: theirs, as in `Information`.
      max_bytes: of host memory for precisions that are kept from pick to pick.
    """
    look_fn = make_look_fn(cameras, curvature_fn)
    precision_fn = make_precision_fn(
        look_fn,
        vertex_positions(setup.grid),
        prior=prior_precision(setup.laplace.prior_weight),
        max_bytes=max_bytes,
    )
    return DirectionalInformation(looks, look_fn, precision_fn)


def make_look_fn(cameras: Cameras, curvature_fn: CurvatureFn) -> LookFn:
    """Makes the looks of cameras, one after another, from their curvatures."""
    positions = np.asarray(cameras.positions)

    def look_fn(indices):
        for index, (rows, h) in zip(indices, curvature_fn(indices)):
            yield Look(rows, h, positions[index])

    return look_fn


def training_looks(setup: SceneSetup, acquired: Acquired, image_scale: float) -> tuple[Look, ...]:
    """The curvature that each training view by itself has brought, at a reduced size.

    Of the same field and by the same rule as that of candidates, so that both can be compared; but
    a view that was trained on is read with its own code, and without its masked pixels.
    """
    views = np.flatnonzero(acquired.is_training_view)
    view_rays = _make_view_rays_fn(acquired.table.cameras, image_scale, acquired.table)
    curvature_fn = make_cached_curvature_fn(
        _make_curvature_fn(setup, acquired, view_rays),
        num_vertices=setup.grid.num_vertices,
        max_bytes=0,
        group_size=setup.curvature.group_size,
    )
    positions = np.asarray(acquired.table.cameras.positions)[views]
    return tuple(Look(rows, h, place) for (rows, h), place in zip(curvature_fn(views), positions))


def make_candidate_curvature_fn(
    setup: SceneSetup, acquired: Acquired, cameras: Cameras, image_scale: float
) -> DenseCurvatureFn:
    """Makes the curvatures of candidates: what photos would add to the precision.

    Eq 13 knows no colours, so a pose is enough. The sum runs over the pixels of a reduced image and
    is scaled up to the pixels that the photo would have; it is in the unit of the posterior's
    precision, `(2 / R) jac_sq_sum` with the run's own R, and 0 outside of what counts
    (`LaplaceOptions.extent`). Rays of all n cameras share compiled calls; n is at most
    `setup.curvature.group_size`.
    """
    return _make_curvature_fn(setup, acquired, _make_view_rays_fn(cameras, image_scale))


# The rays of reduced images: all N rays of n views, which view each is of [N] int32 from 0 on, and
# how many pixels of the photo a ray stands for [n].
ViewRays = Callable[[np.ndarray], tuple[CurvatureRays, np.ndarray, np.ndarray]]


def _make_curvature_fn(
    setup: SceneSetup, acquired: Acquired, view_rays: ViewRays
) -> DenseCurvatureFn:
    """`make_candidate_curvature_fn` of the cameras of `view_rays`."""
    counts: Array | float = 1.0
    if setup.laplace.extent == "box":
        counts = vertices_in_box(setup.grid)[:, None]

    def curvature(indices):
        of_rays, places, scale = view_rays(indices)
        of_rays["group_ids"] = places
        added = setup.curvature(acquired.train.model, label=None, weighting=WEIGHTING, **of_rays)
        scale = (curvature_factor(acquired.num_rays, WEIGHTING) * scale).astype(np.float32)
        return counts * scale[:, None, None] * added[: len(indices)]

    return curvature


def _make_view_rays_fn(
    cameras: Cameras, image_scale: float, table: PixelTable | None = None
) -> ViewRays:
    """Makes the rays of reduced images.

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
        of_rays: CurvatureRays = {"rays": rays_through_pixels(small, views, pixel_ids)}
        if table is not None:
            of_rays["view_ids"] = views
            of_rays["ray_weight"] = _unmasked_shares(table, indices, np.asarray(small.sizes))
        places = np.repeat(np.arange(len(indices), dtype=np.int32), num_rays)
        return of_rays, places, whole_rays[indices] / num_rays

    return view_rays


def _unmasked_shares(table: PixelTable, view_ids, sizes: np.ndarray) -> np.ndarray | None:
    """Share of each pixel of reduced views that is trained on, [N] in [0, 1]; None where all are.

    Args:
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
def _clock(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Adds the time of a block to one entry of a table."""
    start = time.perf_counter()
    yield
    seconds[name] += time.perf_counter() - start
