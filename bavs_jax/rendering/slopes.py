"""How what a ray sees changes when the places change at which its field is read (Eq 10)."""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp

from bavs_jax.cameras import Rays
from bavs_jax.rendering.compositing import composite_colour, expected_depth, render_weights
from bavs_jax.rendering.render import FieldFn
from bavs_jax.rendering.sampling import Samples, flatten_inputs, sample_positions


class FieldSlopes(NamedTuple):
    """A field at the samples of R rays, and its derivatives by their positions."""

    density: jax.Array  # [R, S]
    rgb: jax.Array  # [R, S, 3]
    density_slope: jax.Array  # [R, S, 3 axes]
    rgb_slope: jax.Array  # [R, S, 3 channels, 3 axes]


def field_slopes(
    field_fn: FieldFn,
    rays: Rays,
    samples: Samples,
    *,
    inputs: Mapping[str, jax.Array] | None = None,
) -> FieldSlopes:
    """Reads a field at samples and differentiates it there.

    The field has three inputs per sample and is differentiated forwards, all samples of all rays
    at once, for which it is evaluated three times rather than differentiated four times in reverse.

    Args:
      field_fn: what is differentiated; it is given `inputs` by name.
      rays: R rays.
      samples: [R, S].
      inputs: what more the field reads at each sample, by name, [R, S, ...].
    """
    positions = sample_positions(rays, samples)
    directions = jnp.broadcast_to(rays.directions[:, None], positions.shape)
    flat_directions = directions.reshape(-1, 3)
    flat_inputs = flatten_inputs(inputs or {})

    def field_at(flat_positions):
        return field_fn(flat_positions, flat_directions, **flat_inputs)[:2]

    def along(axis):
        tangent = jnp.broadcast_to(axis, flat_directions.shape)
        return jax.jvp(field_at, (positions.reshape(-1, 3),), (tangent,))

    values, slopes = zip(*(along(axis) for axis in jnp.eye(3, dtype=positions.dtype)))
    shape = samples.t_mids.shape
    return FieldSlopes(
        density=values[0][0].reshape(shape),
        rgb=values[0][1].reshape(*shape, 3),
        density_slope=jnp.stack([d for d, _ in slopes], -1).reshape(*shape, 3),
        rgb_slope=jnp.stack([c for _, c in slopes], -1).reshape(*shape, 3, 3),
    )


def colour_jacobian(
    slopes: FieldSlopes, deltas: jax.Array, *, background
) -> tuple[jax.Array, jax.Array]:
    """Derivative of each ray's colour by an offset of each of its samples (Eq 10).

    `dC / dx_i = dC / dsigma_i dsigma_i / dx_i + dC / dc_i dc_i / dx_i`. Compositing has three
    outputs and is differentiated for each ray by `jax.vmap(jax.jacrev(...))`. Sample positions are
    held fixed: what moves is where the field is read, as under `D_theta`.

    Args:
      slopes: from `field_slopes`.
      deltas: [R, S] lengths that samples stand for, scene units. An invalid slot has 0, so its
        weight and derivative vanish.
      background: [3] colour behind everything, or None (see `composite_colour`).

    Returns:
      jacobian [R, 3, S, 3] (channel, sample, axis), 1 / scene unit, and the colours [R, 3].
    """

    def ray_colour(density, rgb, deltas):
        colour = composite_colour(render_weights(density, deltas), rgb, background)
        return colour, colour

    (by_density, by_rgb), colour = jax.vmap(jax.jacrev(ray_colour, argnums=(0, 1), has_aux=True))(
        slopes.density, slopes.rgb, deltas
    )
    jacobian = by_density[..., None] * slopes.density_slope[:, None]
    return jacobian + jnp.einsum("rcsk,rskd->rcsd", by_rgb, slopes.rgb_slope), colour


def depth_jacobian(slopes: FieldSlopes, samples: Samples) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Derivative of each ray's expected depth by an offset of each of its samples.

    `dD_r / dx_id = dD_r / dsigma_i dsigma_i / dx_id`. Sample positions are held fixed.

    Args:
      slopes: from `field_slopes`.
      samples: [R, S].

    Returns:
      jacobian [R, 1, S, 3], without unit, the depths [R], scene units, and the opacities [R].
    """

    def ray_depth(density, deltas, t_mids):
        weights = render_weights(density, deltas)
        depth = expected_depth(weights, t_mids)
        return depth, (depth, weights.sum(-1))

    by_density, (depth, opacity) = jax.vmap(jax.grad(ray_depth, has_aux=True))(
        slopes.density, samples.deltas, samples.t_mids
    )
    return (by_density[..., None] * slopes.density_slope)[:, None], depth, opacity
