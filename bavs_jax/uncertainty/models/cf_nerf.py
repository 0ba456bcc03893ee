"""CF-NeRF (Shen et al. 2022): a distribution over fields, by conditional flows."""

import dataclasses
from functools import partial

import jax

from bavs_jax.devices import jit_over_rays
from bavs_jax.fields.flow_field import base_draws
from bavs_jax.models.ray_field import RayField
from bavs_jax.rendering.render import basic_images
from bavs_jax.uncertainty.measures import colour_variance
from bavs_jax.uncertainty.model import FLOW, ModelFns, SceneSetup, UncertaintyModel

DRAWS_SEED = 0  # the same draws for every image of every run


def make_fns(setup: SceneSetup) -> ModelFns:
    """The flows are trained beside the run's own field; K fixed draws are rendered.

    The last draw is the base's mean. "uncertainty" is the variance of colour over the draws,
    "depth_uncertainty" that of depth; "rgb" and "depth" are the means over the draws.
    """
    model = setup.models[FLOW]
    if not isinstance(model, RayField):
        raise TypeError(f"{FLOW}: must be a RayField, whose field is drawn anew")
    noise = base_draws(jax.random.key(DRAWS_SEED), setup.num_draws, with_mean=True)

    def images(state, rays):
        def render(noise):
            drawn = model.field._replace(apply=partial(setup.flow.apply, noise=noise))
            return basic_images(dataclasses.replace(model, field=drawn).render(state, rays))

        draws = jax.vmap(render)(noise)
        return {
            **jax.tree.map(lambda x: x.mean(0), draws),
            "uncertainty": colour_variance(draws["rgb"]),
            "depth_uncertainty": draws["depth"].var(0),
        }

    compiled = jit_over_rays(images, setup.mesh, sharded=(False, True))

    def fit(key, acquired):
        if setup.kind == FLOW:
            return None
        return setup.train(FLOW, key, acquired)

    def render(fitted, train, rays):
        state = train if fitted is None else fitted
        return compiled(state.model, rays)

    return ModelFns(fit, render)


UNCERTAINTY_MODELS = (
    UncertaintyModel(
        name="cf_nerf",
        summary="Variance over draws of a distribution over fields, by conditional flows.",
        make_fns=make_fns,
    ),
)
