"""Slow references for curvature: the whole Jacobian, and loops in numpy."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.fields.deformation import displace
from bavs_jax.rendering.compositing import composite_colour, render_weights


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
