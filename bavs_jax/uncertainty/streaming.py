"""Curvature over any number of rays in bounded memory: rays are grouped by their samples."""

import contextlib
from collections.abc import Iterator
from functools import partial
from typing import NamedTuple, Protocol, TypedDict, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from bavs_jax.arrays import Array
from bavs_jax.cameras import Cameras, Rays
from bavs_jax.devices import gather_rays, jit_over_rays, num_shards, over_rays, shard_rays
from bavs_jax.fields.deformation import DeformationGrid
from bavs_jax.models.base import ModelState, RadianceModel
from bavs_jax.pixel_table import PixelTable, view_pixel_rays
from bavs_jax.progress import Bar, Progress, Track, map_chunks
from bavs_jax.uncertainty.curvature import add_jac_sq_sum

RAY_CHUNK = 8192  # rays of one compiled call that makes them, or counts their samples
# Views whose curvatures are made at once, and the most memory that they may take.
MAX_GROUP, MAX_GROUP_BYTES = 8, 2**26


class RayFacts(TypedDict, total=False):
    """What is known of each of N rays beside the ray itself; what is left out is None."""

    targets: Array | None  # [N, 3] true colours; `gauss_newton` needs none
    # [N] int: views trained on that the rays belong to, which a model may read in a way of their
    # own. None for rays of any other camera, read as when it renders.
    view_ids: Array | None
    ray_weight: Array | None  # [N] factor of each ray's contribution; 1 when None
    group_ids: Array | None  # [N] int: which ray is of which group; when None all are of group 0


class CurvatureRays(RayFacts):
    """N rays as keywords of `CurvatureOfRays`."""

    rays: Rays


class CurvatureOver(Protocol):
    """See `make_curvature_fn`."""

    def __call__(
        self,
        state: ModelState,
        rays: Rays,
        progress_fn: Progress | None = None,
        *,
        num_groups: int = 1,
        **of_rays: Unpack[RayFacts],
    ) -> jax.Array: ...


def table_rays(table: PixelTable, view_ids, pixel_ids, weighting: str) -> CurvatureRays:
    """Pixels [N] of views that are trained on, as keywords of `CurvatureOfRays`.

    Args:
      view_ids, pixel_ids: [N] int, from `training_pixels`.
      weighting: one of `curvature.WEIGHTINGS`; true colours are read where it needs them.
    """
    targets = None
    if weighting != "gauss_newton":
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


def bucket_sizes(model: RadianceModel, sizes: tuple[int, ...] = (8, 16, 32, 64)) -> tuple[int, ...]:
    """Points a ray of each compiled shape: those below the model's `most_points`, and that.

    Where every ray has the most points there is one bucket.
    """
    most = model.most_points
    return (*(() if model.always_most else sorted(b for b in sizes if b < most)), most)


def bucketed_rows(
    counts: np.ndarray, buckets: tuple[int, ...], chunk_samples: int, num_shards: int = 1
) -> Iterator[tuple[int, np.ndarray, int]]:
    """Rays by bucket: yields (bucket, rows, how many of them are true).

    There are `chunk_samples // bucket` rows for each of the shards.

    Rays of no points are left out; the last rows of a bucket are filled up with copies.

    Args:
      counts: [N] points of each ray.
      buckets: ascending, from `bucket_sizes`.
      chunk_samples: points of one compiled call, on each device.
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
    target: Array | None  # [R, 3]
    view_ids: Array | None  # [R]
    group_ids: Array  # [R]
    ray_weight: Array  # [R], 0 for padding


def make_curvature_fn(
    model: RadianceModel,
    grid: DeformationGrid,
    *,
    weighting: str = "gauss_newton",
    buckets: tuple[int, ...] = (8, 16, 32, 64),
    chunk_samples: int = 8192,
    mesh: Mesh | None = None,
) -> CurvatureOver:
    """Makes the streamed raw Jacobian sum (Eqs 10-13) over given rays.

    `vmap(jacrev)` needs a fixed number of points a ray. Rays are sorted into buckets by how many
    can move their colour, so that short ones are not padded to the longest; rays that meet nothing
    have no curvature and are not evaluated.

    Args:
      weighting: one of `curvature.WEIGHTINGS`.
      buckets: points a ray of each compiled shape; the model's `most_points` is added if larger.
      chunk_samples: points of one compiled call, on each device.
      mesh: devices that share the rays (see `devices.py`); each has a sum of its own, and these are
        added at the end.

    Returns:
      `curvature(state, rays, **of_rays)`, which gives `jac_sq_sum` [num_groups, G, 3], a sum for
      each group of rays (see `RayFacts`); each number of groups compiles.
    """
    buckets = bucket_sizes(model, buckets)
    shards = num_shards(mesh)

    def count_points(state, rays):
        return model.num_points(state, rays)

    count_fn = jit_over_rays(count_points, mesh, sharded=(False, True))

    def add_part(totals, state, rows, *, bucket):
        terms = model.ray_terms(state, rows.rays, most_points=bucket, view_ids=rows.view_ids)
        total = add_jac_sq_sum(
            totals[0],
            terms,
            grid,
            target=rows.target,
            ray_weight=rows.ray_weight,
            first_row=rows.group_ids * grid.num_vertices,
            weighting=weighting,
        )
        return total[None]

    @partial(jax.jit, static_argnames="bucket", donate_argnums=0)
    def add_chunk(totals, *args, bucket):
        sharded = (True, False, True)
        return over_rays(partial(add_part, bucket=bucket), mesh, sharded=sharded)(totals, *args)

    @partial(jax.jit, static_argnames="num_groups")
    def fresh_totals(num_groups):
        return shard_rays(jnp.zeros((shards, num_groups * grid.num_vertices, 3)), mesh)

    @jax.jit
    def add_shards(totals):
        return gather_rays(totals.sum(0), mesh)

    def all_counts(state, rays):
        num_rays = len(rays.origins)
        if model.always_most:
            return np.full(num_rays, model.most_points)

        def count(rows):
            return count_fn(state, jax.tree.map(lambda x: x[rows], rays))

        return map_chunks(count, num_rays, RAY_CHUNK * shards)

    def curvature(
        state,
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
            target=None if weighting == "gauss_newton" else targets,
            # So that models which do not read them have one compilation, not two.
            view_ids=view_ids if model.reads_views else None,
            group_ids=np.zeros(num_rays, np.int32) if group_ids is None else group_ids,
            ray_weight=np.ones(num_rays, np.float32) if ray_weight is None else ray_weight,
        )
        everything = jax.tree.map(np.asarray, everything)
        totals = fresh_totals(num_groups)
        counts = all_counts(state, everything.rays)
        report = progress_fn or (lambda num: None)
        report(int((counts == 0).sum()))
        for bucket, rows, num in bucketed_rows(counts, buckets, chunk_samples, shards):
            some = jax.tree.map(lambda x, rows=rows: x[rows], everything)
            some.ray_weight[num:] = 0.0
            totals = add_chunk(totals, state, some, bucket=bucket)
            # The host would otherwise run ahead and queue every chunk's buffers at once.
            jax.block_until_ready(totals)
            report(num)
        total = totals[0] if mesh is None else add_shards(totals)
        return total.reshape(num_groups, grid.num_vertices, 3)

    return curvature


class CurvatureOfRays:
    """Curvature of a model over rays, with progress; compiles once for each weighting."""

    def __init__(
        self,
        model: RadianceModel,
        grid: DeformationGrid,
        *,
        group_size: int,
        track: Track,
        mesh: Mesh | None = None,
    ):
        """Compiles nothing yet.

        Args:
          model, grid, mesh: see `make_curvature_fn`.
          group_size: most groups of rays; all calls share its compilations.
          track: shows progress.
        """
        self.group_size = group_size
        self._track = track
        self._make = partial(make_curvature_fn, model, grid, mesh=mesh)
        self._made: dict[str, CurvatureOver] = {}

    def __call__(
        self,
        state: ModelState,
        rays: Rays,
        label: str | None,
        *,
        weighting: str,
        **of_rays: Unpack[RayFacts],
    ) -> jax.Array:
        """`jac_sq_sum` [G, 3], or with `group_ids` [N] that of each group, [group_size, G, 3].

        The label is that of the progress; None shows none. For the rest, see `make_curvature_fn`.
        """
        if weighting not in self._made:
            self._made[weighting] = self._make(weighting=weighting)
        shown: contextlib.AbstractContextManager[Bar | None] = contextlib.nullcontext(None)
        if label is not None:
            shown = self._track(len(rays.origins), label, "rays")
        with shown as bar:
            sums = self._made[weighting](
                state,
                rays,
                progress_fn=None if bar is None else bar.advance,
                num_groups=self.group_size,
                **of_rays,
            )
        return sums[0] if of_rays.get("group_ids") is None else sums


def _chunks(rows: np.ndarray, size: int) -> Iterator[tuple[np.ndarray, int]]:
    """Pieces of `rows` of exactly `size`, the last filled up, with their true lengths."""
    for start in range(0, len(rows), size):
        piece = rows[start : start + size]
        yield np.pad(piece, (0, size - len(piece)), mode="edge"), len(piece)
