"""What a radiance field is: pure functions of parameters and points (Eq 1)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

Params = Any


def no_inputs(rays, samples, view_ids=None) -> dict:
    """The `inputs` of a field that reads positions and directions alone."""
    del rays, samples, view_ids
    return {}


class Field(NamedTuple):
    """A radiance field as pure functions; nothing in it holds state.

    `init(key) -> params`
    `apply(params, positions [K, 3], directions [K, 3], **inputs) -> (density [K], rgb [K, 3])`,
      and as a third a dict of whatever else the field says of each point, such as a variance
    `density(params, positions [K, 3], **inputs) -> density [K]`
    `penalty(params) -> []`, what training adds to the loss, times a weight
    `roughness(params) -> []`, how much the field varies from place to place, another such term
    `inputs(rays, samples [R, S], view_ids [R] or None) -> {name: [R, S, ...]}`, what more the
      field reads at each sample: the size of a pixel's cone there, or the view it belongs to.
      `view_ids` are given only where the views are trained on.
    `reads_views`: whether `inputs` depend on `view_ids`, as with appearance codes

    Positions are in scene units, directions are unit vectors, density is in 1 / scene unit and
    colour is sRGB in [0, 1].
    """

    init: Callable[..., Params]
    apply: Callable[..., tuple]
    density: Callable[..., Any]
    penalty: Callable[[Params], Any] = lambda params: 0.0
    inputs: Callable[..., dict] = no_inputs
    reads_views: bool = False
    roughness: Callable[[Params], Any] = lambda params: 0.0


class DensityField(NamedTuple):
    """A field of density alone, such as a proposal; the functions are those of `Field`."""

    init: Callable[..., Params]
    density: Callable[..., Any]
    penalty: Callable[[Params], Any] = lambda params: 0.0
    inputs: Callable[..., dict] = no_inputs
