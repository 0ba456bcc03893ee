"""CF-NeRF (Shen et al. 2022): a distribution over fields, by conditional flows."""

from __future__ import annotations

from functools import partial

import jax

from bavs_jax.devices import jit_over_rays
from bavs_jax.fields.flow_field import base_draws
from bavs_jax.rendering.pixels import basic_images, render_pixels
from bavs_jax.uncertainty.measures import colour_variance
from bavs_jax.uncertainty.model import FLOW, ModelFns, Toolbox, UncertaintyModel

DRAWS_SEED = 0  # the same draws for every image of every run


def make_fns(toolbox: Toolbox) -> ModelFns:
    """The flows are trained beside the run's own field; K fixed draws are rendered.

    The last draw is the base's mean. "uncertainty" is the variance of colour over the draws,
    "depth_uncertainty" that of depth; "rgb" and "depth" are the means over the draws.
    """
    field, sampler = toolbox.fields[FLOW]
    noise = base_draws(jax.random.key(DRAWS_SEED), toolbox.num_draws, with_mean=True)

    def images(params, sampler_state, rays):
        def render(noise):
            drawn = field._replace(apply=partial(toolbox.flow.apply, noise=noise))
            rendering, samples = render_pixels(
                drawn,
                sampler,
                params,
                sampler_state,
                rays,
                background=toolbox.background,
                capacity=toolbox.capacity,
            )
            return basic_images(rendering, samples)

        draws = jax.vmap(render)(noise)
        return {
            **jax.tree.map(lambda x: x.mean(0), draws),
            "uncertainty": colour_variance(draws["rgb"]),
            "depth_uncertainty": draws["depth"].var(0),
        }

    compiled = jit_over_rays(images, toolbox.mesh, spread=(False, False, True))

    def fit(key, situation):
        if toolbox.kind == FLOW:
            return None
        return toolbox.train(FLOW, key, situation)

    def render(fitted, train, rays):
        state = train if fitted is None else fitted
        return compiled(state.params, state.sampler_state, rays)

    return ModelFns(fit, render)


UNCERTAINTY_MODELS = (
    UncertaintyModel(
        name="cf_nerf",
        summary="Variance over draws of a distribution over fields, by conditional flows.",
        make_fns=make_fns,
    ),
)
