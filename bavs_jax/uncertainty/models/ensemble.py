"""Density-aware ensembles (Sünderhauf et al. 2022): fields from other starts that disagree."""

import jax
import jax.numpy as jnp

from bavs_jax.uncertainty.images import make_image_fn
from bavs_jax.uncertainty.measures import ensemble_uncertainty
from bavs_jax.uncertainty.model import ModelFns, SceneSetup, UncertaintyModel


def make_fns(setup: SceneSetup) -> ModelFns:
    """Further fields are trained like the run's own, which is the first member."""
    images = make_image_fn(setup, setup.kind)
    known_background = setup.model.background is not None

    def fit(key, acquired):
        keys = jax.random.split(key, setup.ensemble_size - 1)
        return [setup.train(setup.kind, k, acquired) for k in keys]

    def render(fitted, train, rays):
        members = [images(state, rays) for state in (train, *fitted)]
        rgb, opacity = (jnp.stack([m[name] for m in members]) for name in ("rgb", "opacity"))
        uncertainty = ensemble_uncertainty(rgb, opacity, known_background=known_background)
        return {**members[0], "uncertainty": uncertainty}

    return ModelFns(fit, render)


UNCERTAINTY_MODELS = (
    UncertaintyModel(
        name="ensemble",
        summary="Variance of colour over several fields, and what they miss of the ray.",
        make_fns=make_fns,
    ),
)
