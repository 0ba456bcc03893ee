"""What a radiance field is: pure functions of parameters and points (Eq 1)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

Params = Any


class Field(NamedTuple):
    """A radiance field as pure functions; nothing in it holds state.

    `init(key) -> params`
    `apply(params, positions [K, 3], directions [K, 3]) -> (density [K], rgb [K, 3])`
    `density(params, positions [K, 3]) -> density [K]`
    `penalty(params) -> []`, what training adds to the loss, times a weight

    Positions are in scene units, directions are unit vectors, density is in 1 / scene unit and
    colour is sRGB in [0, 1].
    """

    init: Callable[..., Params]
    apply: Callable[..., tuple]
    density: Callable[..., Any]
    penalty: Callable[[Params], Any] = lambda params: 0.0
