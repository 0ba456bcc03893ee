"""Coverage (CONVERGE): from how new a direction does a ray look at what it meets?"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.cameras import Cameras
from bavs_jax.devices import jit_over_rays
from bavs_jax.rendering.render import Channel, basic_images
from bavs_jax.uncertainty.images import make_image_fn, render_stack
from bavs_jax.uncertainty.measures import direction_novelty
from bavs_jax.uncertainty.model import ModelFns, SceneSetup, UncertaintyModel


class Covered(NamedTuple):
    """Who has seen the scene: V views and C candidates, of which only the marked ones count."""

    cameras: Cameras  # [V + C]
    mask: np.ndarray  # [V + C] bool
    depth_maps: np.ndarray  # [V + C, H, W] scene units, 0 where empty


def make_fns(setup: SceneSetup) -> ModelFns:
    """Depth maps of the training views are fitted, so that a view covers only what it sees."""
    depth_images = make_image_fn(setup, setup.kind)

    def images(state, covered, rays):
        novelty = partial(
            direction_novelty,
            cameras=covered.cameras,
            mask=covered.mask,
            depth_maps=covered.depth_maps,
        )
        channels = {"uncertainty": Channel(novelty)}
        rendering = setup.model.render(state, rays, channels=channels)
        return {**basic_images(rendering), **rendering.channels}

    compiled = jit_over_rays(images, setup.mesh, sharded=(False, False, True))

    def look(train, cameras, mask, scale):
        depth_fn = partial(depth_images, train)
        return render_stack(
            depth_fn, cameras, mask, scale=scale, chunk=setup.chunk, names=("depth",)
        )

    def fit(key, acquired):
        del key
        cameras = jax.tree.map(
            lambda a, b: jnp.concatenate([a, b]), acquired.table.cameras, acquired.candidates
        )
        unused = np.zeros(len(acquired.candidates), bool)
        mask = np.concatenate([np.asarray(acquired.is_training_view), unused])
        small, depth_maps = look(acquired.train, cameras, mask, setup.image_scale)
        return Covered(small, mask, depth_maps)

    def condition(covered, train, picked):
        mask = covered.mask.copy()
        mask[-len(picked) :] = picked
        new = mask & ~covered.mask
        if not new.any():
            return covered
        _, more = look(train, covered.cameras, new, 1.0)  # already reduced: as they are
        return covered._replace(mask=mask, depth_maps=covered.depth_maps + more)

    def render(covered, train, rays):
        return compiled(train.model, covered, rays)

    return ModelFns(fit, render, condition)


UNCERTAINTY_MODELS = (
    UncertaintyModel(
        name="coverage",
        summary="How new the direction is from which each point is looked at.",
        make_fns=make_fns,
    ),
)
