"""A small, quick radiance field: a hash grid and two thin networks (Eq 1)."""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp

from bavs_jax.fields.base import Field
from bavs_jax.fields.encodings import HashEncoding, level_resolutions, spherical_harmonics
from bavs_jax.numerics import density_from_raw


class HashGridField(nn.Module):
    """Density from position, colour from the same features and the view direction.

    Attributes:
      resolutions, features, log2_table_size: see `HashEncoding`.
      width: units of each hidden layer.
      geometry_features: what the density network hands to the colour network.
      direction_degree: spherical-harmonics bands of the view direction.
    """

    resolutions: tuple[int, ...]
    features: int
    log2_table_size: int
    width: int
    geometry_features: int
    direction_degree: int

    def setup(self):
        self.encoding = HashEncoding(self.resolutions, self.features, self.log2_table_size)
        self.density_hidden = nn.Dense(self.width)
        self.density_out = nn.Dense(1 + self.geometry_features)
        self.colour_hidden = [nn.Dense(self.width) for _ in range(2)]
        self.colour_out = nn.Dense(3)

    def geometry(self, unit_positions):
        hidden = nn.relu(self.density_hidden(self.encoding(unit_positions)))
        out = self.density_out(hidden)
        return density_from_raw(out[:, 0]), out[:, 1:]

    def __call__(self, unit_positions, directions):
        density, features = self.geometry(unit_positions)
        harmonics = spherical_harmonics(directions, self.direction_degree)
        hidden = jnp.concatenate([features, harmonics], axis=-1)
        for layer in self.colour_hidden:
            hidden = nn.relu(layer(hidden))
        return density, nn.sigmoid(self.colour_out(hidden))


def make_hash_grid_field(
    box,
    *,
    num_levels: int = 8,
    coarsest: int = 16,
    finest: int = 128,
    features: int = 2,
    log2_table_size: int = 16,
    width: int = 64,
    geometry_features: int = 15,
    direction_degree: int = 4,
) -> Field:
    """Makes a hash-grid field over a box.

    Args:
      box: [2, 3] lower and upper corner, scene units. Points outside read the nearest face.
      num_levels, coarsest, finest: levels of the grid and their cells per side.
      features: features per vertex.
      log2_table_size: largest table of a level is `2^log2_table_size` rows.
      width: units of each hidden layer.
      geometry_features: features handed from the density to the colour network.
      direction_degree: spherical-harmonics bands, 1 (no view dependence) to 4.

    Returns:
      A `Field`.
    """
    box = jnp.asarray(box, jnp.float32)
    module = HashGridField(
        resolutions=level_resolutions(num_levels, coarsest, finest),
        features=features,
        log2_table_size=log2_table_size,
        width=width,
        geometry_features=geometry_features,
        direction_degree=direction_degree,
    )

    def to_unit(positions):
        return jnp.clip((positions - box[0]) / (box[1] - box[0]), 0.0, 1.0)

    def init(key):
        point = jnp.full((1, 3), 0.5)
        return module.init(key, point, jnp.array([[0.0, 0.0, 1.0]]))["params"]

    def apply(params, positions, directions):
        return module.apply({"params": params}, to_unit(positions), directions)

    def density(params, positions):
        unit = to_unit(positions)
        return module.apply({"params": params}, unit, method=HashGridField.geometry)[0]

    def penalty(params):
        # Mean per level, so that the few entries of a coarse level weigh as much as the many of a
        # fine one (Barron et al. 2023, section 5): entries that few rays see stay smooth.
        return sum(jnp.square(table).mean() for table in params["encoding"].values())

    return Field(init=init, apply=apply, density=density, penalty=penalty)
