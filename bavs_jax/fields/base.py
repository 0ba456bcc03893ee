"""What a radiance field is: pure functions of parameters and points (Eq 1)."""

from typing import Any, NamedTuple, Protocol

import jax

from bavs_jax.arrays import Array
from bavs_jax.cameras import Rays
from bavs_jax.rendering.sampling import Samples

Params = Any  # a pytree, each field's own


class InitParams(Protocol):
    """Parameters before any training; others for each key."""

    def __call__(self, key: jax.Array, /) -> Params: ...


class ApplyField(Protocol):
    """Density [K] and rgb [K, 3] at positions [K, 3] along directions [K, 3], and as a third a dict
    of whatever else the field says of each point, such as a variance; `inputs` are those of
    `Field.inputs`, [K, ...]."""

    def __call__(
        self, params: Params, positions: Array, directions: Array, /, *args: Any, **inputs: Any
    ) -> tuple: ...


class FieldDensity(Protocol):
    """Density [K] at positions [K, 3]; `inputs` as in `ApplyField`."""

    def __call__(
        self, params: Params, positions: Array, /, *args: Any, **inputs: Any
    ) -> jax.Array: ...


class ParamsTerm(Protocol):
    """A term [] of the loss that is of the parameters alone."""

    def __call__(self, params: Params, /) -> jax.Array | float: ...


class InputsFn(Protocol):
    """What more a field reads at each sample than its position and direction, [R, S, ...] by name:
    the size of a pixel's cone there, or the view it belongs to. `view_ids` [R] are given only where
    the views are trained on."""

    def __call__(
        self, rays: Rays, samples: Samples, view_ids: Array | None = None, /
    ) -> dict[str, jax.Array]: ...


def no_inputs(rays, samples, view_ids=None) -> dict[str, jax.Array]:
    """The `inputs` of a field that reads positions and directions alone."""
    del rays, samples, view_ids
    return {}


class Field(NamedTuple):
    """A radiance field as pure functions; nothing in it holds state.

    Positions are in scene units, directions are unit vectors, density is in 1 / scene unit and
    colour is sRGB in [0, 1].
    """

    init: InitParams
    apply: ApplyField
    density: FieldDensity
    penalty: ParamsTerm = lambda params: 0.0  # what training adds to the loss, times a weight
    inputs: InputsFn = no_inputs
    reads_views: bool = False  # whether `inputs` depend on `view_ids`, as with appearance codes
    # How much the field varies from place to place, another such term.
    roughness: ParamsTerm = lambda params: 0.0


class DensityField(NamedTuple):
    """A field of density alone, such as a proposal; the functions are those of `Field`."""

    init: InitParams
    density: FieldDensity
    penalty: ParamsTerm = lambda params: 0.0
    inputs: InputsFn = no_inputs
