"""A distribution over radiance fields: CF-NeRF (Shen et al. 2022).

One draw from a Gaussian base, the same for all of space, is one radiance field: at each point
flows carry it to a density and a colour, and what is known about the point steers the flows.
"""

import dataclasses
from typing import NamedTuple, Protocol

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.arrays import Array
from bavs_jax.fields.base import Field, FieldDensity, InitParams, Params, ParamsTerm
from bavs_jax.fields.contraction import unit_coordinates
from bavs_jax.fields.encodings import spherical_harmonics
from bavs_jax.fields.flows import apply_flows, flow_from_raw, num_flow_parameters
from bavs_jax.fields.hash_grid import HashGridOptions, table_penalty
from bavs_jax.fields.nerf_mlp import NerfMlpOptions, Trunk, make_position_encoding
from bavs_jax.fields.positional import positional_encoding

NOISE_DIM = 4  # one number for the density, three for the colour


@dataclasses.dataclass(frozen=True)
class FlowOptions:
    """Size and shape of the flows."""

    condition_features: int = 32  # units that steer each of the two stacks, 64 in the paper
    num_flows: int = 4  # of each stack
    # See `flow_from_raw`. The paper has 1, which holds every density within e^4 of a common one,
    # and many colours away from black and white.
    amplitude: float = 2.0
    # See `positive_density`, 1 / scene unit; None: an optical depth of 1 over a 128th of the box's
    # longest side.
    density_scale: float | None = None


class ApplyFlow(Protocol):
    """Density [N], rgb [N, 3] and {"log_prob": [N]} of the field that `noise` [4] draws, at
    positions [N, 3] along directions [N, 3]: `log q(density, rgb | x, d)`, nats."""

    def __call__(
        self, params: Params, positions: Array, directions: Array, noise: Array
    ) -> tuple[jax.Array, jax.Array, dict[str, jax.Array]]: ...


class FlowField(NamedTuple):
    """A distribution over radiance fields as pure functions of parameters, N points and one draw.

    `noise` is standard normal, see `base_draws`; at 0 it is the base's mean. `jax.vmap` over
    `noise` alone reads the network once for all draws. Units are those of `Field`.
    """

    init: InitParams
    apply: ApplyFlow
    density: FieldDensity  # of the base's mean, for samplers
    penalty: ParamsTerm = lambda params: 0.0  # what training adds to the loss, times a weight


def base_draws(key, num_draws: int, *, with_mean: bool = False) -> jax.Array:
    """Standard normal draws of the base [num_draws, 4]; `with_mean` makes the last one 0."""
    draws = jax.random.normal(key, (num_draws, NOISE_DIM))
    return draws.at[-1].set(0.0) if with_mean else draws


def mean_field(flow: FlowField) -> Field:
    """The field of the base's mean: one that can be sampled and rendered like any other."""

    def apply(params, positions, directions):
        return flow.apply(params, positions, directions, jnp.zeros(NOISE_DIM))

    return Field(flow.init, apply, flow.density, flow.penalty)


def positive_density(raw: jax.Array, scale) -> tuple[jax.Array, jax.Array]:
    """Density `scale * softplus(raw - 4)` and the logarithm of its derivative, [...] each.

    Not `exp`: its log-derivative is `raw` itself, without bound, so that the reward for entropy
    would make everything unseen ever denser; here it is `log(scale)` at most. The shift makes a
    field thin to begin with (0.018 scale), while the base stays centred at 0.

    Args:
      raw: [...] any.
      scale: > 0, 1 / scene unit.
    """
    shifted = raw - 4.0
    soft = nn.softplus(shifted)
    return scale * soft, shifted - soft + jnp.log(scale)


def unit_colour(raw: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Colour `sigmoid(raw)`, [...] in [0, 1], and the logarithm of its derivative [...]."""
    return nn.sigmoid(raw), raw - 2.0 * nn.softplus(raw)


class GaussianBase(nn.Module):
    """A learnable Gaussian with independent components, standard to begin with."""

    dim: int

    @nn.compact
    def __call__(self, noise):
        """The draw [D] that standard normal `noise` [D] stands for, and its log-density []."""
        mean = self.param("mean", nn.initializers.zeros, (self.dim,))
        log_std = self.param("log_std", nn.initializers.zeros, (self.dim,))
        log_prob = -(0.5 * jnp.square(noise) + 0.5 * jnp.log(2.0 * jnp.pi) + log_std).sum()
        return mean + jnp.exp(log_std) * noise, log_prob


class SteeredFlows(nn.Module):
    """Flows whose parameters a network reads off the activations at each point.

    Attributes:
      dim, num_flows, amplitude: see `flow_from_raw`.
      condition_features: units of the layer between.

    Differs from the paper: a ReLU follows that layer, which else would be one with the next.
    """

    dim: int
    num_flows: int
    amplitude: float
    condition_features: int

    @nn.compact
    def __call__(self, hidden):
        condition = nn.relu(nn.Dense(self.condition_features)(hidden))
        raw = nn.Dense(self.num_flows * num_flow_parameters(self.dim))(condition)
        return flow_from_raw(raw, dim=self.dim, num_flows=self.num_flows, amplitude=self.amplitude)


class FlowNetwork(nn.Module):
    """What lies between encoded points and the density and colour of one draw.

    Attributes:
      trunk: encoded positions [N, E] -> activations [N, W].
      geometry_features: what the trunk hands to the colour's layer, beside the view direction.
      colour_width: units of that layer.
      condition_features, num_flows, amplitude: see `SteeredFlows`.
      density_scale: see `positive_density`.
    """

    trunk: nn.Module
    geometry_features: int
    colour_width: int
    condition_features: int
    num_flows: int
    amplitude: float
    density_scale: float

    def setup(self):
        flows = (self.num_flows, self.amplitude, self.condition_features)
        self.density_base, self.colour_base = GaussianBase(1), GaussianBase(3)
        self.density_flows, self.colour_flows = SteeredFlows(1, *flows), SteeredFlows(3, *flows)
        self.features = nn.Dense(self.geometry_features)
        self.colour_hidden = nn.Dense(self.colour_width)

    def geometry(self, encoded, noise):
        """Density [N], its log-density [N] and activations [N, W]; `noise` is [1]."""
        hidden = self.trunk(encoded)
        start, log_prob = self.density_base(noise)
        raw, log_det = apply_flows(self.density_flows(hidden), start[:, None])
        density, log_slope = positive_density(raw[0], self.density_scale)
        return density, log_prob - log_det - log_slope, hidden

    def __call__(self, encoded, encoded_directions, noise):
        density, density_log_prob, hidden = self.geometry(encoded, noise[:1])
        hidden = jnp.concatenate([self.features(hidden), encoded_directions], axis=-1)
        hidden = nn.relu(self.colour_hidden(hidden))
        start, log_prob = self.colour_base(noise[1:])
        raw, log_det = apply_flows(self.colour_flows(hidden), start[:, None])
        rgb, log_slope = unit_colour(raw)
        colour_log_prob = log_prob - log_det - log_slope.sum(0)
        return density, rgb.T, {"log_prob": density_log_prob + colour_log_prob}


def _flow_field(module: FlowNetwork, encode, encode_directions, penalty) -> FlowField:
    """A network behind the interface of a field, given how it reads positions and directions."""

    def init(key):
        direction = jnp.array([[0.0, 0.0, 1.0]])
        encoded = encode(jnp.zeros((1, 3))), encode_directions(direction)
        return module.init(key, *encoded, jnp.zeros(NOISE_DIM))["params"]

    def apply(params, positions, directions, noise):
        encoded = encode(positions), encode_directions(directions)
        return module.apply({"params": params}, *encoded, noise)

    def density(params, positions):
        mean = jnp.zeros(1)
        geometry = FlowNetwork.geometry
        return module.apply({"params": params}, encode(positions), mean, method=geometry)[0]

    return FlowField(init, apply, density, penalty)


def _flow_network(
    box, trunk: nn.Module, geometry_features: int, colour_width: int, flow: FlowOptions
) -> FlowNetwork:
    density_scale = flow.density_scale
    if density_scale is None:
        density_scale = float(128.0 / np.max(box[1] - box[0]))
    return FlowNetwork(
        trunk=trunk,
        geometry_features=geometry_features,
        colour_width=colour_width,
        condition_features=flow.condition_features,
        num_flows=flow.num_flows,
        amplitude=flow.amplitude,
        density_scale=density_scale,
    )


class HashTrunk(nn.Module):
    """A hash grid and one layer over it."""

    options: HashGridOptions

    @nn.compact
    def __call__(self, unit_positions):
        encoded = self.options.encoding("encoding")(unit_positions)
        return nn.relu(nn.Dense(self.options.width)(encoded))


def make_flow_field(
    box,
    grid: HashGridOptions,
    flow: FlowOptions,
    *,
    contracted: bool = False,
) -> FlowField:
    """Makes CF-NeRF on a hash grid, for two cores.

    Args:
      box: [2, 3] lower and upper corner, scene units.
      grid: of the network that steers the flows; without its codes and its initial depth.
      flow: of the distribution.
      contracted: see `unit_coordinates`.
    """
    box = np.asarray(box, np.float32)
    return _flow_field(
        _flow_network(box, HashTrunk(grid), grid.geometry_features, grid.width, flow),
        lambda positions: unit_coordinates(box, positions, contracted=contracted),
        lambda directions: spherical_harmonics(directions, grid.direction_degree),
        lambda params: table_penalty(params["trunk"]["encoding"]),
    )


def make_flow_mlp_field(
    box,
    mlp: NerfMlpOptions,
    flow: FlowOptions,
    *,
    contracted: bool = False,
) -> FlowField:
    """Makes CF-NeRF as in the paper: a deep network over encoded positions.

    Args:
      box: [2, 3] lower and upper corner, scene units.
      mlp: of the network that steers the flows, 8 x 512 in the paper.
      flow: of the distribution.
      contracted: see `unit_coordinates`.
    """
    box = np.asarray(box, np.float32)
    encode, _ = make_position_encoding(
        box, degree=mlp.position_degree, contracted=contracted, pixel_radius=None
    )
    trunk = Trunk(mlp.depth, mlp.width, mlp.skip)
    return _flow_field(
        _flow_network(box, trunk, mlp.width, mlp.width // 2, flow),
        encode,
        lambda directions: positional_encoding(directions, mlp.direction_degree),
        lambda params: 0.0,
    )
