"""Curvature over any number of rays in bounded memory: rays are grouped by their samples."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from bavs_jax.cameras import Cameras, Rays
from bavs_jax.devices import gather_rays, jit_over_rays, num_shards, over_rays, spread_rays
from bavs_jax.fields.base import Field
from bavs_jax.fields.deformation import DeformationGrid
from bavs_jax.rendering.samplers import Sampler
from bavs_jax.rendering.sampling import first_slots
from bavs_jax.training.batches import PixelTable, view_pixel_rays
from bavs_jax.uncertainty.curvature import add_jac_sq_sum

RAY_CHUNK = 8192  # rays of one compiled call that makes them, or counts their samples
# Views whose curvatures are made at once, and the most memory that they may take.
MAX_GROUP, MAX_GROUP_BYTES = 8, 2**26


def table_rays(table: PixelTable, view_ids, pixel_ids, weighting: str) -> dict:
    """Pixels [N] of views that are trained on, as keywords of `make_curvature_fn`'s `curvature`.

    Args:
      table: the scene's pixels.
      view_ids, pixel_ids: [N] int, from `training_pixels`.
      weighting: one of `curvature.WEIGHTINGS`; true colours are read where it needs them.
    """
    targets = None
    if weighting != "eq13":
        rows = np.asarray(table.offsets)[view_ids] + pixel_ids
        targets = np.asarray(table.pixels)[rows].astype(np.float32) / np.float32(255.0)
    rays = rays_through_pixels(table.cameras, view_ids, pixel_ids)
    return {"rays": rays, "targets": targets, "view_ids": view_ids}


def rays_through_pixels(cameras: Cameras, view_ids, pixel_ids) -> Rays:
    """`view_pixel_rays` of any number of pixels [N] on the host, made in compiled chunks."""
    cameras = jax.tree.map(np.asarray, cameras)
    # Converted at the end, so that no chunk waits for the one before.
    parts = [
        (_view_pixel_rays(cameras, view_ids[rows], pixel_ids[rows]), num)
        for rows, num in _chunks(np.arange(len(view_ids)), RAY_CHUNK)
    ]
    return Rays(
        *(
            np.concatenate([np.asarray(getattr(rays, name))[:num] for rays, num in parts])
            for name in ("origins", "directions")
        )
    )


_view_pixel_rays = jax.jit(view_pixel_rays)


def curvature_group_size(num_vertices: int, num_views: int) -> int:
    """How many views' curvatures [G, 3] to make at once: few enough for `MAX_GROUP_BYTES`."""
    fitting = MAX_GROUP_BYTES // (num_vertices * 3 * 4)
    return max(1, min(MAX_GROUP, fitting, num_views))


def bucket_sizes(sampler: Sampler, sizes: tuple[int, ...] = (8, 16, 32, 64)) -> tuple[int, ...]:
    """Sample slots of each compiled shape: those below the sampler's `num_slots`, and that.

    A dense sampler, all of whose slots are filled, has one bucket.
    """
    slots = sampler.num_slots
    return (*(() if sampler.dense else sorted(b for b in sizes if b < slots)), slots)


def bucketed_rows(
    counts: np.ndarray, buckets: tuple[int, ...], chunk_samples: int, num_shards: int = 1
):
    """Rays by bucket: yields (bucket, rows, how many of them are true).

    There are `chunk_samples // bucket` rows for each of the shards.

    Rays of no samples are left out; the last rows of a bucket are filled up with copies.

    Args:
      counts: [N] samples of each ray.
      buckets: ascending, from `bucket_sizes`.
      chunk_samples: slots of one compiled call, on each device.
      num_shards: devices that share the rows.
    """
    smaller = 0
    for bucket in buckets:
        members = np.flatnonzero((counts > smaller) & (counts <= bucket))
        smaller = bucket
        for rows, num in _chunks(members, num_shards * max(chunk_samples // bucket, 1)):
            yield bucket, rows, num


class _Rows(NamedTuple):
    """What one compiled call is told of each of its rays."""

    rays: Rays
    target: Any  # [R, 3] or None
    view_ids: Any  # [R] or None
    group_ids: Any  # [R]
    ray_weight: Any  # [R], 0 for padding


def make_curvature_fn(
    field: Field,
    sampler: Sampler,
    grid: DeformationGrid,
    *,
    background,
    weighting: str = "eq13",
    buckets: tuple[int, ...] = (8, 16, 32, 64),
    chunk_samples: int = 8192,
    mesh: Mesh | None = None,
) -> Callable:
    """Makes the streamed raw Jacobian sum (Eqs 10-13) over given rays.

    `vmap(jacrev)` needs a fixed number of samples a ray. Rays are sorted into buckets by how many
    occupied samples they have, so that short ones are not padded to the longest; rays that meet
    nothing have no curvature and are not evaluated. A dense sampler makes one bucket of all rays.

    Args:
      field: the radiance field.
      sampler: how rays are sampled; its samples are held fixed.
      grid: the deformation grid.
      background: [3] colour behind everything, or None (see `composite_colour`).
      weighting: one of `curvature.WEIGHTINGS`.
      buckets: sample slots of each compiled shape; the sampler's `num_slots` is added if larger.
      chunk_samples: slots of one compiled call, on each device.
      mesh: devices that share the rays (see `devices.py`); each has a sum of its own, and these are
        added at the end.

    Returns:
      `curvature(params, sampler_state, rays [N], progress_fn=None, *, targets=None, view_ids=None,
      ray_weight=None, group_ids=None, num_groups=1) -> jac_sq_sum [num_groups, G, 3]`, a sum for
      each group of rays, for any N.
      - `targets` [N, 3]: true colours; needed by `eq11` and `empirical`.
      - `view_ids` [N] int: views trained on that the rays belong to, for the field's `inputs`.
        None for rays of any other camera, which a field reads as it does when it renders.
      - `ray_weight` [N]: factor of each ray's contribution; 1 when None.
      - `group_ids` [N] int: which ray is of which group; when None all are of group 0.
      - `progress_fn(n)` is called with the number of rays done.
    """
    slots, buckets = sampler.num_slots, bucket_sizes(sampler, buckets)
    background = None if background is None else jnp.asarray(background, jnp.float32)
    shards = num_shards(mesh)
    count_chunk = RAY_CHUNK * shards

    def count_rays(params, sampler_state, rays):
        samples, _ = sampler.sample(None, params["sampler"], sampler_state, rays)
        return samples.sample_mask.sum(-1)

    count_samples = jit_over_rays(count_rays, mesh, spread=(False, False, True))

    def add_part(totals, params, sampler_state, rows, *, bucket):
        samples, _ = sampler.sample(None, params["sampler"], sampler_state, rows.rays)
        samples = first_slots(samples, bucket)
        total = add_jac_sq_sum(
            totals[0],
            partial(field.apply, params["field"]),
            grid,
            rows.rays,
            samples,
            background=background,
            target=rows.target,
            ray_weight=rows.ray_weight,
            first_row=rows.group_ids * grid.num_vertices,
            weighting=weighting,
            inputs=field.inputs(rows.rays, samples, rows.view_ids),
        )
        return total[None]

    @partial(jax.jit, static_argnames="bucket", donate_argnums=0)
    def add_chunk(totals, *args, bucket):
        spread = (True, False, False, True)
        return over_rays(partial(add_part, bucket=bucket), mesh, spread=spread)(totals, *args)

    @partial(jax.jit, static_argnames="num_groups")
    def fresh_totals(num_groups):
        return spread_rays(jnp.zeros((shards, num_groups * grid.num_vertices, 3)), mesh)

    @jax.jit
    def add_shards(totals):
        return gather_rays(totals.sum(0), mesh)

    def all_counts(params, sampler_state, rays):
        num_rays = len(rays.origins)
        if sampler.dense:
            return np.full(num_rays, slots)
        counts = []
        for rows, num in _chunks(np.arange(num_rays), count_chunk):
            some = jax.tree.map(lambda x, rows=rows: x[rows], rays)
            counts.append(np.asarray(count_samples(params, sampler_state, some))[:num])
        return np.concatenate(counts)

    def curvature(
        params,
        sampler_state,
        rays,
        progress_fn=None,
        *,
        targets=None,
        view_ids=None,
        ray_weight=None,
        group_ids=None,
        num_groups=1,
    ):
        num_rays = len(rays.origins)
        everything = _Rows(
            rays,
            target=None if weighting == "eq13" else targets,
            # So that fields without appearance codes have one compilation, not two.
            view_ids=view_ids if field.reads_views else None,
            group_ids=np.zeros(num_rays, np.int32) if group_ids is None else group_ids,
            ray_weight=np.ones(num_rays, np.float32) if ray_weight is None else ray_weight,
        )
        everything = jax.tree.map(np.asarray, everything)
        totals = fresh_totals(num_groups)
        counts = all_counts(params, sampler_state, everything.rays)
        report = progress_fn or (lambda num: None)
        report(int((counts == 0).sum()))
        for bucket, rows, num in bucketed_rows(counts, buckets, chunk_samples, shards):
            some = jax.tree.map(lambda x, rows=rows: x[rows], everything)
            some.ray_weight[num:] = 0.0
            totals = add_chunk(totals, params, sampler_state, some, bucket=bucket)
            # The host would otherwise run ahead and queue every chunk's buffers at once.
            jax.block_until_ready(totals)
            report(num)
        total = totals[0] if mesh is None else add_shards(totals)
        return total.reshape(num_groups, grid.num_vertices, 3)

    return curvature


def _chunks(rows: np.ndarray, size: int):
    """Pieces of `rows` of exactly `size`, the last filled up, with their true lengths."""
    for start in range(0, len(rows), size):
        piece = rows[start : start + size]
        yield np.pad(piece, (0, size - len(piece)), mode="edge"), len(piece)
