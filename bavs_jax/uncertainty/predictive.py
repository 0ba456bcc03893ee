"""What uncertain offsets mean for pixels: the linearised Laplace predictive variance.

Offsets theta of the deformation grid move a ray's colour and depth by `g . theta` to first order,
so under a posterior with variances v of independent offsets

    Var C_rc = sum_vd g_rcvd^2 v_vd,      Var D_r = sum_vd g_rDvd^2 v_vd,

with the same derivatives g that make the curvature (Eqs 10-13). Where the paper renders how far a
point may be displaced (Fig 4), this says what the displacement would change: nothing inside of an
even surface, much where a ray grazes an edge or ends in fog.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from bavs_jax.arrays import Array
from bavs_jax.cameras import Rays
from bavs_jax.devices import jit_over_rays, num_shards
from bavs_jax.fields.deformation import DeformationGrid
from bavs_jax.models.base import ModelState, RadianceModel
from bavs_jax.numerics import materialize
from bavs_jax.uncertainty.curvature import vertex_squares
from bavs_jax.uncertainty.streaming import bucket_sizes, bucketed_rows


def predictive_variance(
    grid: DeformationGrid, positions: jax.Array, jacobian: jax.Array, variance: jax.Array
) -> jax.Array:
    """`sum_c sum_vd g_rcvd^2 v_vd` of each ray.

    Args:
      positions: [R, S, 3] of samples, scene units.
      jacobian: [R, C, S, 3] derivatives of C quantities by each sample's offset.
      variance: v [G, 3] of the offsets, scene unit^2.

    Returns:
      [R] >= 0, summed over the C quantities, in their unit squared.

    Numerics: a sum of squares that is made in another order may fall short of 0 by its rounding,
    and is clipped.
    """
    rows, squares = jax.vmap(vertex_squares, in_axes=(None, 0, 0))(grid, positions, jacobian)
    weights = variance.at[rows].get(mode="promise_in_bounds")  # [R, S, 8, 3]
    return jnp.maximum((squares * weights).sum((1, 2, 3)), 0.0)


def make_predictive_fn(
    model: RadianceModel,
    grid: DeformationGrid,
    *,
    chunk_samples: int = 8192,
    mesh: Mesh | None = None,
) -> Callable[[ModelState, Array, Rays], dict[str, np.ndarray]]:
    """Makes the rendering of the standard deviations of colour and depth.

    Rays are put into buckets by their samples, as for the curvature, so it must not be jitted as a
    whole. A ray that meets nothing is certain.

    Args:
      model, grid: see `make_curvature_fn`.
      chunk_samples: slots of one compiled call, on each device.
      mesh: devices that share the rays (see `devices.py`).

    Returns:
      `render(state, variance [G, 3], rays)`, which gives of R rays the `basic_images`, and the
      standard deviations "uncertainty", of colour (root mean square over the channels), and
      "depth_uncertainty", scene units; all [R, ...] on the host.
    """
    buckets = bucket_sizes(model)

    def render_bucket(state, variance, rays, *, bucket):
        terms = model.ray_terms(state, rays, most_points=bucket, view_ids=None)
        positions = materialize(terms.positions)
        deviation = [
            jnp.sqrt(predictive_variance(grid, positions, jacobian, variance) / jacobian.shape[1])
            for jacobian in (terms.colour_jacobian, terms.depth_jacobian)
        ]
        return {
            "rgb": terms.rgb,
            "depth": terms.depth,
            "opacity": terms.opacity,
            "thinned": terms.thinned,
            "uncertainty": deviation[0],
            "depth_uncertainty": deviation[1],
        }

    def count_points(state, rays):
        return model.num_points(state, rays)

    count_fn = jit_over_rays(count_points, mesh, sharded=(False, True))
    bucket_fns = {
        bucket: jit_over_rays(
            partial(render_bucket, bucket=bucket), mesh, sharded=(False, False, True)
        )
        for bucket in buckets
    }

    def render(state, variance, rays: Rays) -> dict[str, np.ndarray]:
        num = len(rays.origins)
        counts = np.asarray(count_fn(state, rays))
        images, rays = _empty_images(num, model.background), jax.tree.map(np.asarray, rays)
        for bucket, rows, count in bucketed_rows(counts, buckets, chunk_samples, num_shards(mesh)):
            some = jax.tree.map(lambda x, rows=rows: x[rows], rays)
            found = bucket_fns[bucket](state, variance, some)
            for name, values in found.items():
                images[name][rows[:count]] = np.asarray(values)[:count]
        return images

    return render


def _empty_images(num: int, background) -> dict[str, np.ndarray]:
    """What `num` rays show that meet nothing."""
    images = {name: np.zeros(num, np.float32) for name in ("depth", "opacity")}
    images |= {name: np.zeros(num, np.float32) for name in ("uncertainty", "depth_uncertainty")}
    colour = np.zeros(3) if background is None else np.asarray(background)
    images["rgb"] = np.tile(colour.astype(np.float32), (num, 1))
    images["thinned"] = np.zeros(num, bool)
    return images
