"""The table of uncertainty models: all that `UNCERTAINTY_MODELS` of the modules here hold."""

from bavs_jax.registry import collect
from bavs_jax.uncertainty.model import UncertaintyModel

MODELS: dict[str, UncertaintyModel] = collect(
    __name__, __path__, "UNCERTAINTY_MODELS", UncertaintyModel
)


def get_model(name: str) -> UncertaintyModel:
    """The model of that name.

    Raises:
      ValueError: there is none; names those that there are.
    """
    if name not in MODELS:
        raise ValueError(f"uncertainty model: unknown name {name!r}; known: {', '.join(MODELS)}")
    return MODELS[name]
