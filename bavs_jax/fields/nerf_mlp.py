"""The paper's own radiance field (Eq 1): a deep network over encoded position and direction.

With `pixel_radius` it reads the mean encoding over the piece of a pixel's cone that a sample stands
for, as in Mip-NeRF.
"""

import dataclasses
from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp

from bavs_jax.fields.base import DensityField, Field, InputsFn, no_inputs
from bavs_jax.fields.contraction import unit_coordinates
from bavs_jax.fields.positional import cone_variance, integrated_encoding, positional_encoding
from bavs_jax.numerics import point_variance


@dataclasses.dataclass(frozen=True)
class NerfMlpOptions:
    """Size and shape of a NeRF network; those of the paper by default."""

    depth: int = 8
    width: int = 256
    skip: int = 5  # hidden layers before the encoding comes in again
    position_degree: int = 10  # octaves of the encodings
    direction_degree: int = 4


class Trunk(nn.Module):
    """Hidden layers over an encoded position; the encoding comes in again after `skip` of them.

    Attributes:
      depth, width: number of layers and units of each.
      skip: layers before the encoding is put beside the activations again.
    """

    depth: int
    width: int
    skip: int

    @nn.compact
    def __call__(self, encoded):
        hidden = encoded
        for layer in range(self.depth):
            hidden = nn.relu(nn.Dense(self.width)(hidden))
            if layer + 1 == self.skip and layer + 1 < self.depth:
                hidden = jnp.concatenate([hidden, encoded], axis=-1)
        return hidden


def raw_to_density(raw: jax.Array) -> jax.Array:
    """`softplus(raw - 1)`, 1 / scene unit: thin at first and never dead, as in Mip-NeRF.

    Differs from the paper's lineage: NeRF has a ReLU, whose gradient vanishes on empty space.
    """
    return nn.softplus(raw - 1.0)


class NerfMlp(nn.Module):
    """Density from the trunk; colour from its features and the encoded direction."""

    options: NerfMlpOptions
    learned_variance: bool = False

    def setup(self):
        options = self.options
        self.trunk = Trunk(options.depth, options.width, options.skip)
        self.density_out = nn.Dense(1)
        self.features = nn.Dense(options.width)
        self.colour_hidden = nn.Dense(options.width // 2)
        self.colour_out = nn.Dense(3)
        if self.learned_variance:
            self.variance_out = nn.Dense(1)

    def geometry(self, encoded):
        hidden = self.trunk(encoded)
        return raw_to_density(self.density_out(hidden)[:, 0]), hidden

    def __call__(self, encoded, encoded_directions):
        density, trunk = self.geometry(encoded)
        hidden = jnp.concatenate([self.features(trunk), encoded_directions], axis=-1)
        rgb = nn.sigmoid(self.colour_out(nn.relu(self.colour_hidden(hidden))))
        if not self.learned_variance:
            return density, rgb
        return density, rgb, {"beta": point_variance(self.variance_out(trunk)[:, 0])}


class MlpDensity(nn.Module):
    """Density alone."""

    depth: int
    width: int

    @nn.compact
    def __call__(self, encoded):
        hidden = Trunk(self.depth, self.width, skip=0)(encoded)
        return raw_to_density(nn.Dense(1)(hidden)[:, 0])


def make_position_encoding(
    box, *, degree: int, contracted: bool, pixel_radius: float | None
) -> tuple[Callable[..., jax.Array], InputsFn]:
    """How a network reads positions, and what it needs to know of each sample for that.

    Args:
      box: [2, 3] scene units.
      degree: octaves.
      contracted: see `unit_coordinates`.
      pixel_radius: radius of a pixel's cone at distance 1; None reads points.

    Returns:
      The encoding `encode(positions [K, 3], variance=None) -> [K, E]`, of cones that are about
      there where a variance [K, 3] along each axis is given; and the field's `inputs`.

    Raises:
      ValueError: a cone in contracted space, whose shape is not followed through the contraction.
    """
    box = jnp.asarray(box, jnp.float32)
    if contracted and pixel_radius is not None:
        raise ValueError("pixel_radius: integrated encodings are for bounded scenes; leave it out")

    def encode(positions, variance=None):
        centred = 2.0 * unit_coordinates(box, positions, contracted=contracted) - 1.0
        if pixel_radius is None or variance is None:
            return positional_encoding(centred, degree)
        half_sides = 0.5 * (box[1] - box[0])
        return integrated_encoding(centred, variance / jnp.square(half_sides), degree)

    def inputs(rays, samples, view_ids=None):
        del view_ids
        return {"variance": cone_variance(rays, samples, pixel_radius)}

    return encode, no_inputs if pixel_radius is None else inputs


def make_nerf_mlp_field(
    box,
    options: NerfMlpOptions = NerfMlpOptions(),
    *,
    contracted: bool = False,
    pixel_radius: float | None = None,
    learned_variance: bool = False,
) -> Field:
    """Makes a NeRF network over a box, or over contracted space around it.

    Args:
      box: [2, 3] lower and upper corner, scene units.
      options: size and shape.
      contracted: see `unit_coordinates`.
      pixel_radius: of a pixel's cone at distance 1, for the integrated encoding; None for points.
      learned_variance: see `make_hash_grid_field`.
    """
    encode, inputs = make_position_encoding(
        box, degree=options.position_degree, contracted=contracted, pixel_radius=pixel_radius
    )
    module = NerfMlp(options, learned_variance)

    def encode_directions(directions):
        return positional_encoding(directions, options.direction_degree)

    def init(key):
        point, direction = jnp.zeros((1, 3)), jnp.array([[0.0, 0.0, 1.0]])
        return module.init(key, encode(point), encode_directions(direction))["params"]

    def apply(params, positions, directions, variance=None):
        encoded = encode(positions, variance), encode_directions(directions)
        return module.apply({"params": params}, *encoded)

    def density(params, positions, variance=None):
        encoded = encode(positions, variance)
        return module.apply({"params": params}, encoded, method=NerfMlp.geometry)[0]

    return Field(init=init, apply=apply, density=density, inputs=inputs)


def make_mlp_density(
    box,
    *,
    depth: int = 4,
    width: int = 256,
    position_degree: int = 10,
    contracted: bool = False,
    pixel_radius: float | None = None,
) -> DensityField:
    """Makes a proposal network; see `NerfMlpOptions` and `make_nerf_mlp_field`."""
    encode, inputs = make_position_encoding(
        box, degree=position_degree, contracted=contracted, pixel_radius=pixel_radius
    )
    module = MlpDensity(depth, width)

    def density(params, positions, variance=None):
        return module.apply({"params": params}, encode(positions, variance))

    return DensityField(
        init=lambda key: module.init(key, encode(jnp.zeros((1, 3))))["params"],
        density=density,
        inputs=inputs,
    )
