"""References for curvature: the whole Jacobian, its definition by samples, loops in numpy."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.fields.deformation import displace
from bavs_jax.models.base import RayTerms
from bavs_jax.rendering.compositing import composite_colour, render_weights
from bavs_jax.rendering.sampling import sample_positions
from bavs_jax.rendering.slopes import colour_jacobian, field_slopes


def trilinear_loop(box, cells, point):
    """Vertices around one point and their weights by plain loops: {(i, j, k): weight}."""
    unit = np.clip((np.asarray(point) - box[0]) / (box[1] - box[0]), 0.0, 1.0) * cells
    base = np.minimum(np.floor(unit).astype(int), cells - 1)
    weights = {}
    for corner in itertools.product((0, 1), repeat=3):
        weight = 1.0
        for axis in range(3):
            along = unit[axis] - base[axis]
            weight *= along if corner[axis] else 1.0 - along
        weights[tuple(base + corner)] = weight
    return weights


def colours_with_offsets(field_fn, grid, rays, samples, background, theta):
    """Colours [R, 3] of all rays as one function of the whole offset table theta [G, 3]."""
    positions = rays.origins[:, None] + samples.t_mids[..., None] * rays.directions[:, None]
    directions = jnp.broadcast_to(rays.directions[:, None], positions.shape)
    density, rgb = field_fn(positions + displace(grid, theta, positions), directions)
    return composite_colour(render_weights(density, samples.deltas), rgb, background)


def dense_jacobian(field_fn, grid, rays, samples, background):
    """The full Jacobian dC_rc / dtheta_vd, [R, 3, G, 3]."""

    def colours(theta):
        return colours_with_offsets(field_fn, grid, rays, samples, background, theta)

    return jax.jacrev(colours)(jnp.zeros((grid.num_vertices, 3)))


def dense_depth_jacobian(field_fn, grid, rays, samples):
    """The full derivative of expected depths dD_r / dtheta_vd, [R, G, 3]."""
    positions = rays.origins[:, None] + samples.t_mids[..., None] * rays.directions[:, None]
    directions = jnp.broadcast_to(rays.directions[:, None], positions.shape)

    def depths(theta):
        density, _ = field_fn(positions + displace(grid, theta, positions), directions)
        weights = render_weights(density, samples.deltas)
        return (weights * samples.t_mids).sum(-1) / weights.sum(-1)

    return jax.jacrev(depths)(jnp.zeros((grid.num_vertices, 3)))


def defined_jacobian(field_fn, rays, samples, *, background, inputs=None):
    """The definition of `slopes.colour_jacobian`: jacobian [R, 3, S, 3] and colours [R, 3].

    `dC_rc / dx_id` by `jax.vmap(jax.jacrev(...))` over rays of the whole way from offsets to
    colour, at offset 0. Sample positions are held fixed: what moves is where the field is read.
    """

    def ray_colour(offsets, origin, direction, t_mids, deltas, more):
        positions = origin + t_mids[:, None] * direction + offsets
        directions = jnp.broadcast_to(direction, positions.shape)
        density, rgb, *_ = field_fn(positions, directions, **more)
        colour = composite_colour(render_weights(density, deltas), rgb, background)
        return colour, colour

    zero = jnp.zeros((*samples.t_mids.shape, 3), samples.t_mids.dtype)
    # Invalid slots have deltas of 0, so their weight and derivative vanish.
    return jax.vmap(jax.jacrev(ray_colour, has_aux=True))(
        zero, rays.origins, rays.directions, samples.t_mids, samples.deltas, inputs or {}
    )


def split_jacobian(field_fn, rays, samples, *, background, inputs=None):
    """The library's own way to what `defined_jacobian` gives."""
    slopes = field_slopes(field_fn, rays, samples, inputs=inputs)
    return colour_jacobian(slopes, samples.deltas, background=background)


def colour_terms(jacobian_fn, field_fn, rays, samples, *, background):
    """The colour part of `RayTerms`, by one of the two functions above."""
    jacobian, rgb = jacobian_fn(field_fn, rays, samples, background=background)
    return RayTerms(
        positions=sample_positions(rays, samples),
        colour_jacobian=jacobian,
        depth_jacobian=None,
        rgb=rgb,
        depth=None,
        opacity=None,
        thinned=None,
    )
