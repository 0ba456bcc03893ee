
from typing import Any, NamedTuple
import os
from functools import partial
import jax, jax.numpy as jnp, numpy as np
class Directional(NamedTuple):
    known: dict
    curvature_fn: Any
    positions: Any
    toolbox: Any
    looks: list
    done: bool = False

def vertex_positions(grid):
    n = grid.cells + 1
    lo, hi = np.asarray(grid.box)
    axes = [np.linspace(lo[i], hi[i], n) for i in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)

def unit(x):
    return x / jnp.linalg.norm(x, axis=-1, keepdims=True)

@jax.jit
def _add(known, rows, points, centre, dense, other, power):
    p = points[rows]
    k = jnp.maximum((1 + (unit(p - centre) * unit(p - other)).sum(-1)) / 2, 0.0) ** power
    return known + k[:, None] * dense[rows]

@jax.jit
def _dense(rows, h, like):
    return jnp.zeros_like(like).at[rows].add(h)

@jax.jit
def _gain(h, known, prior):
    return jnp.log1p(h / (prior + known)).sum()

def absorb(dr, looks, power):
    pts = jnp.asarray(vertex_positions(dr.toolbox.grid)); known = dict(dr.known)
    for rows, h, pos in looks:
        dense = _dense(rows, h, pts)
        for i in known:
            ((r, _),) = dr.curvature_fn([i])
            known[i] = _add(known[i], r, pts, dr.positions[i], dense, pos, power)
    return dr._replace(known=known, done=True)

def first(dr, power):
    return dr if dr.done else absorb(dr, dr.looks, power)

def gains(dr, indices, *, power, prior):
    return np.array([float(_gain(h, dr.known[int(i)], prior)) for i, (_, h) in zip(indices, dr.curvature_fn(indices))], np.float32)

def add(dr, index, power):
    ((rows, h),) = dr.curvature_fn([index])
    return absorb(dr, [(rows, h, dr.positions[index])], power)
