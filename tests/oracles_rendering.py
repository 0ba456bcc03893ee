"""Slow references for rendering: float64 loops in numpy, one ray and one sample at a time."""

import numpy as np

from tests.oracles_curvature import trilinear_loop


def weights_loop(density, deltas):
    """Rendering weights of one ray by the recursion `T_{i+1} = T_i exp(-sigma_i delta_i)`."""
    light, weights = 1.0, []
    for sigma, delta in zip(np.asarray(density, np.float64), np.asarray(deltas, np.float64)):
        left = light * np.exp(-sigma * delta)
        weights.append(light - left)
        light = left
    return np.array(weights)


def render_loop(field_fn, origin, direction, t_mids, deltas, background):
    """Colour, depth and opacity of one ray, its samples evaluated one by one."""
    density, rgb = [], []
    for t in t_mids:
        point = (np.asarray(origin) + t * np.asarray(direction))[None]
        sigma, colour = field_fn(point, np.asarray(direction)[None])
        density.append(float(sigma[0]))
        rgb.append(np.asarray(colour[0], np.float64))
    weights = weights_loop(density, deltas)
    opacity = weights.sum()
    colour = weights @ np.array(rgb) + (1.0 - opacity) * np.asarray(background)
    depth = weights @ np.asarray(t_mids) / opacity if opacity > 0 else 0.0
    return colour, depth, opacity


def march_loop(origin, direction, occupied, box, near, far, step_size, num_steps):
    """Distances of the occupied steps of one ray; `occupied` is [G, G, G]."""
    origin, direction = np.asarray(origin, np.float64), np.asarray(direction, np.float64)
    to_faces = (np.asarray(box, np.float64) - origin) / direction
    enter = max(np.minimum(*to_faces).max(), near)
    leave = min(np.maximum(*to_faces).min(), far)
    side = occupied.shape[0]
    kept = []
    for i in range(num_steps):
        t = enter + (i + 0.5) * step_size
        if t >= leave:
            break
        unit = (origin + t * direction - box[0]) / (box[1] - box[0])
        cell = np.clip(np.floor(unit * side).astype(int), 0, side - 1)
        if occupied[tuple(cell)]:
            kept.append(t)
    return np.array(kept)


def dense_row(vertex, side):
    """Row of a vertex [3] of a level that has one for each, `side` of them along an axis."""
    i, j, k = vertex
    return (i * side + j) * side + k


def hashed_row(vertex, table_size):
    """Row of a vertex [3] by the spatial hash of Mueller et al. 2022, Eq 4, in whole numbers."""
    i, j, k = (int(n) for n in vertex)
    product = [i, (j * 2654435761) % 2**32, (k * 805459861) % 2**32]
    return (product[0] ^ product[1] ^ product[2]) % table_size


def interpolate_level_loop(table, unit_position, resolution):
    """Trilinear interpolation of a level at one point in [0, 1]^3."""
    box, side = np.array([[0.0] * 3, [1.0] * 3]), resolution + 1
    total = 0.0
    for vertex, weight in trilinear_loop(box, resolution, unit_position).items():
        is_dense = side**3 <= len(table)
        row = dense_row(vertex, side) if is_dense else hashed_row(vertex, len(table))
        total = total + weight * np.asarray(table, np.float64)[row]
    return total
