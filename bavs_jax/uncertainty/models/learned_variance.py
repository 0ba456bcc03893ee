"""ActiveNeRF (Pan et al. 2022): a variance of colour that is trained with the field."""

import jax

from bavs_jax.rendering.compositing import rendered_variance
from bavs_jax.rendering.render import RayRendering
from bavs_jax.uncertainty.images import make_image_fn
from bavs_jax.uncertainty.measures import variance_reduction
from bavs_jax.uncertainty.model import VARIANCE, ModelFns, SceneSetup, UncertaintyModel


def _measures(rendering: RayRendering) -> dict[str, jax.Array]:
    beta = rendering.values["beta"]
    return {
        "uncertainty": rendered_variance(rendering.weights, beta),
        "gain": variance_reduction(rendering.weights, beta),
    }


def make_fns(setup: SceneSetup) -> ModelFns:
    """A run whose own field has the variance needs no other; else one is trained beside it.

    "gain" is how much of the variance along the ray its observation would remove.
    """
    images = make_image_fn(setup, VARIANCE, _measures)

    def fit(key, acquired):
        if setup.kind == VARIANCE:
            return None
        return setup.train(VARIANCE, key, acquired)

    def render(fitted, train, rays):
        return images(train if fitted is None else fitted, rays)

    return ModelFns(fit, render)


UNCERTAINTY_MODELS = (
    UncertaintyModel(
        name="learned_variance",
        summary="Variance of colour that the field learns by likelihood (ActiveNeRF).",
        make_fns=make_fns,
    ),
)
