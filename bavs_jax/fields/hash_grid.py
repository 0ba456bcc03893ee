"""A small, quick radiance field: a hash grid and two thin networks (Eq 1), and its proposals."""

import dataclasses
import functools
import math
import operator

import flax.linen as nn
import jax
import jax.numpy as jnp

from bavs_jax.fields.base import DensityField, Field, no_inputs
from bavs_jax.fields.contraction import unit_coordinates
from bavs_jax.fields.encodings import HashEncoding, level_resolutions, spherical_harmonics
from bavs_jax.numerics import density_from_raw, point_variance


@dataclasses.dataclass(frozen=True)
class HashGridOptions:
    """Size and shape of a field on a hash grid."""

    num_levels: int = 8
    coarsest: int = 16  # cells per side of the coarsest level
    finest: int = 128
    features: int = 2  # per vertex
    log2_table_size: int = 16  # the largest table of a level has 2^log2_table_size rows
    width: int = 64  # units of each hidden layer
    geometry_features: int = 15  # handed from the density to the colour network
    direction_degree: int = 4  # spherical-harmonics bands, 1 (no view dependence) to 4
    # Of the code that each view trained on has for its exposure and white balance; 0 for none.
    # Views that are not trained on are read with the mean code.
    appearance_features: int = 0
    # Density times the box's side before training. A thick fog would hide from each ray what lies
    # behind, and fill every sample there is room for.
    initial_optical_depth: float = 0.3

    @property
    def resolutions(self) -> tuple[int, ...]:
        """Cells per side of each level."""
        return level_resolutions(self.num_levels, self.coarsest, self.finest)

    def encoding(self, name: str | None = None) -> HashEncoding:
        """The grid itself, as a module."""
        return HashEncoding(self.resolutions, self.features, self.log2_table_size, name=name)


class HashGridField(nn.Module):
    """Density from position, colour from the same features and the view direction.

    Attributes:
      options: size and shape.
      log_density: of the field before it is trained, 1 / scene unit.
      num_views, learned_variance: see `make_hash_grid_field`.
    """

    options: HashGridOptions
    log_density: float = 0.0
    num_views: int = 0
    learned_variance: bool = False

    def setup(self):
        options = self.options
        self.encoding = options.encoding()
        self.density_hidden = nn.Dense(options.width)
        self.density_out = nn.Dense(1 + options.geometry_features)
        self.colour_hidden = [nn.Dense(options.width) for _ in range(2)]
        self.colour_out = nn.Dense(3)
        if self.learned_variance:
            self.variance_out = nn.Dense(1)
        if options.appearance_features:
            # 0 to begin with, and for good where a view is never trained on.
            shape = (self.num_views, options.appearance_features)
            self.appearance = self.param("appearance", nn.initializers.zeros, shape)

    def geometry(self, unit_positions):
        hidden = nn.relu(self.density_hidden(self.encoding(unit_positions)))
        out = self.density_out(hidden)
        return density_from_raw(out[:, 0] + self.log_density), out[:, 1:]

    def codes(self, num: int, view_ids):
        """Appearance codes of `num` points: of their views, or the mean of all trained ones."""
        if view_ids is not None:
            return self.appearance[view_ids]
        num_trained = jnp.maximum((self.appearance != 0).any(-1).sum(), 1)
        mean = self.appearance.sum(0) / num_trained
        return jnp.broadcast_to(mean, (num, self.options.appearance_features))

    def __call__(self, unit_positions, directions, view_ids=None):
        density, features = self.geometry(unit_positions)
        parts = [features, spherical_harmonics(directions, self.options.direction_degree)]
        if self.options.appearance_features:
            parts.append(self.codes(len(directions), view_ids))
        hidden = jnp.concatenate(parts, axis=-1)
        for layer in self.colour_hidden:
            hidden = nn.relu(layer(hidden))
        rgb = nn.sigmoid(self.colour_out(hidden))
        if not self.learned_variance:
            return density, rgb
        # From the geometry's features alone: a point's variance has no direction (ActiveNeRF).
        beta = point_variance(self.variance_out(features)[:, 0])
        return density, rgb, {"beta": beta}


def make_hash_grid_field(
    box,
    options: HashGridOptions = HashGridOptions(),
    *,
    contracted: bool = False,
    num_views: int = 0,
    learned_variance: bool = False,
) -> Field:
    """Makes a hash-grid field over a box, or over contracted space around it.

    Args:
      box: [2, 3] lower and upper corner, scene units.
      options: size and shape.
      contracted: see `unit_coordinates`.
      num_views: views of the scene; needed with appearance codes.
      learned_variance: `apply` also returns `{"beta": [K]}`, `softplus(.) + 0.01`, the variance of
        a point's colour (ActiveNeRF); trained by `make_variance_objective`.
    """
    box = jnp.asarray(box, jnp.float32)
    module = HashGridField(
        options,
        log_density=math.log(options.initial_optical_depth / float((box[1] - box[0]).mean())),
        num_views=num_views,
        learned_variance=learned_variance,
    )

    def to_unit(positions):
        return unit_coordinates(box, positions, contracted=contracted)

    def init(key):
        point = jnp.full((1, 3), 0.5)
        return module.init(key, point, jnp.array([[0.0, 0.0, 1.0]]))["params"]

    def apply(params, positions, directions, view_ids=None):
        return module.apply({"params": params}, to_unit(positions), directions, view_ids)

    def density(params, positions, view_ids=None):
        del view_ids
        unit = to_unit(positions)
        return module.apply({"params": params}, unit, method=HashGridField.geometry)[0]

    def inputs(rays, samples, view_ids=None):
        del rays
        if view_ids is None:
            return {}
        return {"view_ids": jnp.broadcast_to(view_ids[:, None], samples.t_mids.shape)}

    def penalty(params):
        return table_penalty(params["encoding"])

    has_codes = options.appearance_features > 0
    return Field(
        init,
        apply,
        density,
        penalty,
        inputs if has_codes else no_inputs,
        reads_views=has_codes,
        roughness=lambda params: table_roughness(params["encoding"], options.resolutions),
    )


def table_penalty(tables: dict) -> jax.Array:
    """Mean square of each level's entries, summed: entries that few rays see stay smooth.

    A mean per level, so that the few entries of a coarse level weigh as much as the many of a
    fine one (Barron et al. 2023, section 5).
    """
    return functools.reduce(operator.add, (jnp.square(x).mean() for x in tables.values()))


def table_roughness(tables: dict, resolutions: tuple[int, ...]) -> jax.Array:
    """Squared total variation, `sum_level sum_axis mean (e(vertex + axis) - e(vertex))^2`.

    Only of levels that are stored densely; a hashed table has no neighbours. What no ray has seen
    is then filled in from around it, instead of with whatever training left there.

    Args:
      tables: of `HashEncoding`, `{"level_0": [T, F], ...}`.
      resolutions: cells per side of each level.
    """
    total = jnp.float32(0.0)
    for level, resolution in enumerate(resolutions):
        table, side = tables[f"level_{level}"], resolution + 1
        if len(table) == side**3:
            grid = table.reshape(side, side, side, -1)
            total += sum(jnp.square(jnp.diff(grid, axis=axis)).mean() for axis in range(3))
    return total


class HashGridDensity(nn.Module):
    """Density alone, by one hidden layer over the grid."""

    options: HashGridOptions

    @nn.compact
    def __call__(self, unit_positions):
        encoded = self.options.encoding("encoding")(unit_positions)
        hidden = nn.relu(nn.Dense(self.options.width)(encoded))
        return density_from_raw(nn.Dense(1)(hidden)[:, 0])


def make_hash_grid_density(
    box, options: HashGridOptions, *, contracted: bool = False
) -> DensityField:
    """Makes a proposal of a grid and one hidden layer; see `make_hash_grid_field`."""
    box = jnp.asarray(box, jnp.float32)
    module = HashGridDensity(options)

    def density(params, positions):
        unit = unit_coordinates(box, positions, contracted=contracted)
        return module.apply({"params": params}, unit)

    return DensityField(
        init=lambda key: module.init(key, jnp.full((1, 3), 0.5))["params"],
        density=density,
        penalty=lambda params: table_penalty(params["encoding"]),
    )
