"""What XLA compiles as one is what its operations give one by one, at every number of rows.

jaxlib 0.10.2 gives a rotation by `(R * x[:, None, :]).sum(-1)` that is divided by its norm the rows
of other points, on CPUs and between 10,923 and some 43,680 points. Every function that turns or
normalises vectors, or divides by a sum along an axis, stands here, by itself and where it meets
the next one. That release does so at every level of optimisation, fused or not; in the slow suite
all is compiled as users do.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax import cameras as cams
from bavs_jax.cameras import project
from bavs_jax.fields import contraction, deformation, encodings, positional
from bavs_jax.pixel_table import view_pixel_rays
from bavs_jax.rendering import compositing, histograms, sampling
from bavs_jax.scenes import photographs, sculpture, sdf, sdf_surface
from bavs_jax.selection.directional import same_side
from bavs_jax.selection.distances import pairwise_distances
from bavs_jax.selection.policies.distance import great_circle
from bavs_jax.uncertainty import curvature, measures, warp

SIZES = (1_000, 10_923, 16_384, 20_000, 32_768, 43_680, 50_000)
FEW_SIZES = (1_000, 20_000)  # one within what was wrong
NUM_VIEWS, NUM_SAMPLES = 5, 6
BOX = np.array([[-1.0] * 3, [1.0] * 3], np.float32)
DISTORTION = {
    "pinhole": np.zeros(6),
    "opencv": [-0.05, 0.01, -0.002, 0.0004, 0.003, -0.002],
    "fisheye": [-0.03, 0.004, -0.001, 0.0, 0.0, 0.0],
}


@functools.cache
def rows() -> dict[str, np.ndarray]:
    """Inputs of as many rows as the largest size."""
    rng = np.random.default_rng(0)
    num = max(SIZES)
    unit = rng.normal(size=(num, 3))
    weights = rng.uniform(size=(num, NUM_SAMPLES))
    values = {
        "points": rng.uniform(-2.0, 2.0, (num, 3)),
        "more_points": rng.uniform(-2.0, 2.0, (num, 3)),
        "directions": unit / np.linalg.norm(unit, axis=-1, keepdims=True),
        "pixels": rng.uniform(size=(num, 2)) * [64.0, 48.0],
        "xy": rng.uniform(-1.0, 1.0, (num, 2)),
        "weights": weights / NUM_SAMPLES,
        "widths": rng.uniform(0.1, 0.5, (num, NUM_SAMPLES)),
        "colours": rng.uniform(size=(num, 3)),
        "jacobian": rng.normal(size=(num, 3, NUM_SAMPLES, 3)),
    }
    values = {name: array.astype(np.float32) for name, array in values.items()}
    values["view_ids"] = rng.integers(0, NUM_VIEWS, num).astype(np.int32)
    values["pixel_ids"] = rng.integers(0, 64 * 48, num).astype(np.int32)
    return values


@functools.cache
def some_cameras(lens: str, num: int = NUM_VIEWS) -> cams.Cameras:
    rng = np.random.default_rng(1)
    poses = [cams.look_at(rng.normal(size=3) * 3.0, rng.normal(size=3)) for _ in range(num)]
    intrinsics = [[40.0 + i, 42.0, 31.0, 25.0 + i] for i in range(num)]
    sizes, distortion = [[64, 48]] * num, [DISTORTION[lens]] * num
    cameras = cams.make_cameras(poses, intrinsics, sizes, distortion=distortion, lens=lens)
    return jax.tree.map(jnp.asarray, cameras)


def edges(widths):
    return jnp.concatenate([jnp.zeros_like(widths[:, :1]), jnp.cumsum(widths, axis=-1)], axis=-1)


# --- functions of cameras that stay the same, and of rows ------------------------------------


def look(cameras, view_ids, pixels):
    return cams.pixel_rays(cameras, view_ids, pixels).directions


def look_of_one(cameras, pixels):
    """Where there is one camera, XLA sees that all rays are turned alike."""
    return look(cameras, jnp.zeros(len(pixels), int), pixels)


def look_by_number(cameras, pixel_ids):
    return view_pixel_rays(cameras, jnp.zeros(len(pixel_ids), int), pixel_ids).directions


def look_into_contracted_space(cameras, pixels):
    rays = cams.pixel_rays(cameras, jnp.zeros(len(pixels), int), pixels)
    points = rays.origins + 4.0 * rays.directions
    return contraction.unit_coordinates(BOX, points, contracted=True)


def look_with_harmonics(cameras, pixels):
    return encodings.spherical_harmonics(look_of_one(cameras, pixels), 4)


def look_into_box(cameras, pixels):
    rays = cams.pixel_rays(cameras, jnp.zeros(len(pixels), int), pixels)
    return jnp.clip(jnp.stack(sampling.box_interval(rays, BOX, 0.05, 9.0), axis=-1), 0.0, 9.0)


def look_from_elsewhere(cameras, pixels):
    """A point on a ray, seen by another camera."""
    rays = cams.pixel_rays(cameras, jnp.zeros(len(pixels), int), pixels)
    return projected(cams.take(cameras, slice(1, 2)), rays.origins + 2.0 * rays.directions)


def cones(cameras, pixels):
    """As the procedural scene traces them: one camera a row."""
    each = cams.take(cameras, jnp.zeros(len(pixels), int))
    _, directions, spread = photographs.pixel_cones(each, pixels)
    return jnp.stack([*directions, spread], axis=-1)


def projected(cameras, points):
    return project(cams.take(cameras, 0), points)[0]


def seen(cameras, points):
    return measures.look_at_points(cams.take(cameras, 0), points, jnp.full((48, 64), 2.0))[1]


def novelty(cameras, points, directions):
    return measures.direction_novelty(points, directions, cameras, jnp.ones(len(cameras), bool))


def warped_depth(cameras, points, directions, colours):
    num = len(cameras)
    maps = jnp.full((num, 48, 64), 2.0)
    sources = warp.WarpSources(cameras, maps[..., None], maps, jnp.ones(num, bool))
    rays, depth, opacity = cams.Rays(points, directions), 1.0 + colours[:, 0], colours[:, 1]
    return warp.warp_disagreement(
        rays, colours, depth, opacity, sources, quantity="depth", combine="mean"
    )


# --- functions of rows alone -----------------------------------------------------------------


def displaced(points, *, contracted):
    grid = deformation.DeformationGrid(BOX, 2, contracted)
    offsets = jnp.sin(jnp.arange(grid.num_vertices * 3.0)).reshape(-1, 3)
    moved = points + deformation.displace(grid, offsets, points)
    return contraction.unit_coordinates(BOX, moved, contracted=contracted)


def interpolated(points, *, contracted):
    grid = deformation.DeformationGrid(BOX, 2, contracted)
    return deformation.interpolate(grid, jnp.sin(jnp.arange(grid.num_vertices * 1.0)), points)


def by_components(fn):
    return lambda *vectors: jnp.stack(fn(*(photographs.components(v) for v in vectors)), axis=-1)


def surface(points):
    return sdf_surface.project_to_surface(
        lambda p: jnp.linalg.norm(p, axis=-1) - 1.0, points, step=1e-2
    )[0]


def seen_from_the_same_side(points):
    return same_side(points, jnp.ones(3), jnp.array([1.0, -2.0, 0.5]))


def cone(directions, widths):
    samples = sampling.Samples(edges(widths)[:, 1:], widths, widths > 0.0, widths[:, 0] < 0.0)
    return positional.cone_variance(cams.Rays(directions, directions), samples, 1e-2)


def composited(widths, weights, colours):
    rgb = weights[..., None] * colours[:, None]
    return compositing.composite_colour(compositing.render_weights(9.0 * weights, widths), rgb, 1.0)


def resampled(widths, weights):
    places = histograms.stratified_quantiles(None, len(widths), 4)
    return histograms.sample_histogram(edges(widths), weights, places)


def weighted_jacobian(jacobian, colours):
    return curvature.weight_jacobian(jacobian, colours, "residual_weighted").sum((1, 2))


CASES = {
    # name: (function, what it reads: cameras as "lens of number", or one of `rows`)
    **{f"look of one, {lens}": (look_of_one, f"{lens} of 1", "pixels") for lens in DISTORTION},
    **{f"project, {lens}": (projected, f"{lens} of 1", "points") for lens in DISTORTION},
    "look": (look, "pinhole of 5", "view_ids", "pixels"),
    "look by number": (look_by_number, "pinhole of 1", "pixel_ids"),
    "look into contracted space": (look_into_contracted_space, "pinhole of 1", "pixels"),
    "look with harmonics": (look_with_harmonics, "pinhole of 1", "pixels"),
    "look into the box": (look_into_box, "pinhole of 1", "pixels"),
    "look from elsewhere": (look_from_elsewhere, "pinhole of 2", "pixels"),
    "cones": (cones, "pinhole of 1", "pixels"),
    "look at points": (seen, "pinhole of 1", "points"),
    "direction novelty": (novelty, "pinhole of 5", "points", "directions"),
    "warped depth": (warped_depth, "pinhole of 5", "points", "directions", "colours"),
    "contract": (contraction.contract, "points"),
    "uncontract": (contraction.uncontract, "directions"),
    "displace": (functools.partial(displaced, contracted=False), "points"),
    "displace, contracted": (functools.partial(displaced, contracted=True), "points"),
    "interpolate": (functools.partial(interpolated, contracted=False), "points"),
    "interpolate, contracted": (functools.partial(interpolated, contracted=True), "points"),
    "harmonics": (functools.partial(encodings.spherical_harmonics, degree=4), "directions"),
    "cone variance": (cone, "directions", "widths"),
    "normals": (by_components(functools.partial(sdf.normals, sculpture.distance)), "points"),
    "shade": (by_components(sculpture.shade), "points", "directions"),
    "project to surface": (surface, "points"),
    "same side": (seen_from_the_same_side, "points"),
    "great circle": (lambda a: great_circle(a, jnp.eye(3), 0.3 * jnp.ones(3)), "points"),
    "distances": (lambda a: pairwise_distances(a, jnp.eye(3)), "points"),
    "composite": (composited, "widths", "weights", "colours"),
    "expected depth": (compositing.expected_depth, "weights", "widths"),
    "ray entropy": (functools.partial(measures.ray_entropy, by_opacity=False), "weights"),
    "variance reduction": (measures.variance_reduction, "weights", "widths"),
    "resample": (resampled, "widths", "weights"),
    "weigh by the residual": (weighted_jacobian, "jacobian", "colours"),
}
# Normals are differences over 1e-3 of a scene unit, of distances rounded to some 1e-7.
TOLERANCES = {"normals": 2e-3, "shade": 5e-3}


# What takes long to compile, or has no sum over an axis before it divides.
SLOW = (
    *("normals", "shade", "project to surface", "displace", "interpolate", "harmonics"),
    *("interpolate, contracted", "cone variance", "resample", "project, opencv"),
    "look of one, opencv",
)


def arguments(name: str, num: int) -> list:
    """What a case reads, of `num` rows."""
    read = []
    for what in CASES[name][1:]:
        lens, _, views = what.partition(" of ")
        read.append(some_cameras(lens, int(views)) if views else jnp.asarray(rows()[what][:num]))
    return read


@pytest.mark.parametrize("name", [name for name in CASES if name not in SLOW])
def test_compiled_is_as_one_by_one(name):
    check_sizes(name, FEW_SIZES)


@pytest.mark.slow
@pytest.mark.usefixtures("users_compilation")
@pytest.mark.parametrize("name", CASES)
def test_compiled_as_users_do_it_is_as_one_by_one_at_every_size(name):
    check_sizes(name, SIZES, compiler_options={"xla_cpu_use_fusion_emitters": True})


def check_sizes(name: str, sizes: tuple[int, ...], **options) -> None:
    fn = CASES[name][0]
    with jax.disable_jit():
        expected = np.asarray(fn(*arguments(name, max(sizes))))
    compiled = jax.jit(fn, **options)
    for num in sizes:
        np.testing.assert_allclose(
            compiled(*arguments(name, num)),
            expected[:num],
            rtol=0.0,
            atol=TOLERANCES.get(name, 1e-4),  # rounding; a wrong row is off by its whole size
            err_msg=f"{name} of {num} rows",
        )
