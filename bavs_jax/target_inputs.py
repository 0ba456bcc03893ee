"""Target views: which they are, and what policies may ask about them.

That is the variance of their colours (`selection/targets.py`), or from how near by they are seen
(`selection/gaps.py`).
"""

from collections.abc import Callable

import jax
import numpy as np

from bavs_jax.cameras import (
    Cameras,
    num_pixels,
    pixel_rays,
    reduced_cameras,
    take,
    view_pixels,
)
from bavs_jax.fields.deformation import cell_sides, vertex_positions
from bavs_jax.rendering.images import RenderChunk
from bavs_jax.selection.directional import Look, LookFn, make_precision_fn
from bavs_jax.selection.distances import uniform_ranks
from bavs_jax.selection.gaps import ViewGaps
from bavs_jax.selection.targets import TargetInformation
from bavs_jax.uncertainty.gaps import UNSEEN, TargetPixels, closeness_of_views, target_shares
from bavs_jax.uncertainty.images import render_stack
from bavs_jax.uncertainty.model import Acquired, SceneSetup
from bavs_jax.uncertainty.posterior import NOISE_VARIANCE, curvature_factor
from bavs_jax.uncertainty.surface import Lookers

CHANNELS = 3  # of colour
MOST_PIXELS = 400  # of a target, that views are asked about
INFORMATION_TARGETS = 32  # whose curvatures are made; seconds for a hundred candidates
GAP_TARGETS = 128  # which need one render each

# Views to ask about, from a key; None: candidates stand for them.
MakeTargets = Callable[[jax.Array], Cameras | None]

_ranks_fn = jax.jit(uniform_ranks)


def evenly_spaced_cameras(positions, num: int, *, view_ids=None) -> np.ndarray:
    """The first `num` cameras of the farthest-point order of all, in that order; [<= num] int.

    Args:
      positions: [C, 3] scene units.
      num: how many; all where there are fewer.
      view_ids: [C] int, distinct, so that the order of cameras does not matter; default 0 .. C - 1.
    """
    view_ids = np.arange(len(positions)) if view_ids is None else np.asarray(view_ids)
    return np.argsort(np.asarray(_ranks_fn(np.asarray(positions), view_ids)))[:num]


def target_information(
    setup: SceneSetup,
    num_rays: int,
    looks: tuple[Look, ...],
    look_fn: LookFn,
    target_fn: LookFn,
    targets: Cameras,
    *,
    max_bytes: int,
) -> TargetInformation:
    """What training views have told about N target views, and what candidates would add.

    Curvatures come in the unit of the posterior's precision, `(2 / R) jac_sq_sum`, and are put into
    that of `offset_variance`, `jac_sq_sum / noise^2`: offsets are `LaplaceOptions.offset_cells` a
    priori, and colours known up to `NOISE_VARIANCE`.

    Args:
      setup: the field's grid and options.
      num_rays: R of Eq 13.
      looks: of the training views.
      look_fn, target_fn: of candidates and of the N targets.
      targets: the N cameras, of whose pixels all count.
      max_bytes: of host memory for precisions that are kept from pick to pick.
    """
    scale = np.float32(1.0 / (curvature_factor(num_rays) * NOISE_VARIANCE))
    offset_std = setup.laplace.offset_cells * cell_sides(setup.grid)
    vertices = vertex_positions(setup.grid)

    def rescaled(fn: LookFn) -> LookFn:
        return lambda indices: (look._replace(h=scale * look.h) for look in fn(indices))

    return TargetInformation(
        looks=tuple(look._replace(h=scale * look.h) for look in looks),
        look_fn=rescaled(look_fn),
        target_fn=rescaled(target_fn),
        precision_fn=make_precision_fn(
            rescaled(target_fn),
            vertices,
            prior=np.asarray(1.0 / np.square(offset_std), np.float32),
            max_bytes=max_bytes,
        ),
        num_values=CHANNELS * num_pixels(targets),
        vertices=vertices,
    )


def view_gaps(
    render: RenderChunk,
    acquired: Acquired,
    candidates: Cameras,
    targets: Cameras,
    *,
    image_scale: float,
    chunk: int,
) -> ViewGaps:
    """How near by training views see what T target views show, and candidates would.

    Where surfaces are, and what hides what, is read from reduced renders of all of them.

    Args:
      render: depth and opacity of `chunk` rays.
      acquired: the views trained on.
      candidates: [C].
      targets: [T].
      image_scale: of width and height; targets are reduced further where they would have more than
        `MOST_PIXELS`.
      chunk: rays of one call of `render`.

    Raises:
      ValueError: views of different sizes (see `render_stack`).
    """

    def look(cameras, mask, scale=image_scale):
        names = ("depth", "opacity")
        small, *maps = render_stack(render, cameras, mask, scale=scale, chunk=chunk, names=names)
        return Lookers(small, mask, *maps)

    as_views = reduced_cameras(targets, image_scale)
    most = int(num_pixels(as_views).max())
    scale = image_scale * min(1.0, float(np.sqrt(MOST_PIXELS / most)))
    wanted = look(targets, np.ones(len(targets), bool), scale)
    view_ids, pixels = view_pixels(wanted.cameras, np.arange(len(targets)))
    rays = jax.tree.map(np.asarray, pixel_rays(wanted.cameras, view_ids, pixels))
    points = rays.origins + wanted.depth_maps.reshape(-1, 1) * rays.directions
    shown = TargetPixels(
        points=points.reshape(len(targets), -1, 3),
        cameras=np.asarray(wanted.cameras.positions),
        focal=np.asarray(as_views.intrinsics[:, 0]),
        weight=wanted.opacity_maps.reshape(len(targets), -1),
    )
    trained_on = take(acquired.table.cameras, np.flatnonzero(acquired.is_training_view))
    before, offered = (look(x, np.ones(len(x), bool)) for x in (trained_on, candidates))
    return ViewGaps(
        known=UNSEEN + np.asarray(closeness_of_views(shown, before)).sum(0),
        closeness=np.asarray(closeness_of_views(shown, offered)),
        pixel_weight=shown.weight,
        target_weight=np.asarray(target_shares(shown)),
    )
