"""Ray entropy (Lee et al. 2022): where along the ray is the surface?"""

from bavs_jax.uncertainty.images import make_image_fn
from bavs_jax.uncertainty.measures import ray_entropy
from bavs_jax.uncertainty.model import ModelFns, SceneSetup, UncertaintyModel


def make_fns(setup: SceneSetup) -> ModelFns:
    """Read off the rendering weights: nothing is fitted."""
    images = make_image_fn(setup, setup.kind, lambda out: {"uncertainty": ray_entropy(out.weights)})
    return ModelFns(
        fit=lambda key, acquired: None, render=lambda fitted, train, rays: images(train, rays)
    )


UNCERTAINTY_MODELS = (
    UncertaintyModel(
        name="entropy",
        summary="Entropy of where each ray ends, times its opacity.",
        make_fns=make_fns,
    ),
)
