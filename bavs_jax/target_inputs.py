"""Target views: which they are, and what a policy may ask about them (`selection/targets.py`)."""

from collections.abc import Callable

import jax
import numpy as np

from bavs_jax.cameras import Cameras, num_pixels
from bavs_jax.fields.deformation import cell_sides, vertex_positions
from bavs_jax.selection.directional import Look, LookFn, make_precision_fn
from bavs_jax.selection.distances import uniform_ranks
from bavs_jax.selection.targets import TargetInformation
from bavs_jax.uncertainty.model import SceneSetup
from bavs_jax.uncertainty.posterior import NOISE_VARIANCE, curvature_factor

CHANNELS = 3  # of colour

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
