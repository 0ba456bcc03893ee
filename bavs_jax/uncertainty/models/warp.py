"""WarpRF (Safadoust et al. 2025): does a render agree with training views warped into it?"""

from functools import partial

import numpy as np

from bavs_jax.devices import jit_over_rays
from bavs_jax.uncertainty.images import make_image_fn, render_stack
from bavs_jax.uncertainty.model import ModelFns, SceneSetup, UncertaintyModel
from bavs_jax.uncertainty.warp import WarpSources, warp_disagreement


def make_fns(setup: SceneSetup) -> ModelFns:
    """Renders of the training views are fitted."""
    images = make_image_fn(setup, setup.kind)

    sharded = (True, True, True, True, False)
    disagreement = jit_over_rays(warp_disagreement, setup.mesh, sharded=sharded)

    def fit(key, acquired):
        del key
        mask = np.asarray(acquired.is_training_view)
        cameras, rgb, depth = render_stack(
            partial(images, acquired.train),
            acquired.table.cameras,
            mask,
            scale=setup.image_scale,
            chunk=setup.chunk,
        )
        return WarpSources(cameras, rgb, depth, mask)

    def render(sources, train, rays):
        out = images(train, rays)
        uncertainty = disagreement(rays, out["rgb"], out["depth"], out["opacity"], sources)
        return {**out, "uncertainty": uncertainty}

    return ModelFns(fit, render)


UNCERTAINTY_MODELS = (
    UncertaintyModel(
        name="warp",
        summary="Disagreement of a render with training views warped into it by depth.",
        make_fns=make_fns,
    ),
)
