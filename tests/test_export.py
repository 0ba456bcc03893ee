"""Point queries, and exported files read back by the libraries that people open them with."""

import dataclasses
import io
import sys

import jax.numpy as jnp
import nrrd
import numpy as np
import pytest
import trimesh

from bavs_jax.cameras import Rays
from bavs_jax.export.field import (
    geometry_error,
    grid_axes,
    ray_end_points,
    sample_grid,
    sample_mesh,
    seen_by_any,
)
from bavs_jax.export.formats import ExportError, import_extra, nrrd_bytes, ply_bytes
from bavs_jax.export.mesh import default_threshold, extract_mesh, without_small_parts
from bavs_jax.fields.deformation import DeformationGrid
from bavs_jax.pixel_table import make_pixel_table, view_pixel_rays
from bavs_jax.rendering.render import render_rays
from bavs_jax.rendering.sampling import Samples
from bavs_jax.scenes.poses import user_points, user_units
from bavs_jax.uncertainty.channel import make_uncertainty_channel
from bavs_jax.uncertainty.points import make_point_fn
from tests.toy_fields import NOTHING_LEARNT, even_sampler, ray_model, smooth_field, smooth_field_fn
from tests.toy_scenes import toy_scene

BOX = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 0.5]])
RNG = np.random.default_rng(0)
TURNED = np.array(  # 2 times a quarter turn about z, and a shift
    [[0.0, -2.0, 0.0, 10.0], [2.0, 0.0, 0.0, 20.0], [0.0, 0.0, 2.0, 30.0], [0.0, 0.0, 0.0, 1.0]]
)
SAMPLER = even_sampler(near=1.0, far=2.0, num=1)
MODEL = ray_model(smooth_field(), SAMPLER, None, box=BOX)


# --- point queries ---


@pytest.fixture(scope="module")
def grid():
    return DeformationGrid(jnp.asarray(BOX, jnp.float32), 2)


@pytest.fixture(scope="module")
def variance(grid):
    return jnp.asarray(RNG.uniform(0.1, 2.0, grid.num_vertices), jnp.float32)


def in_box(num):
    return RNG.uniform(BOX[0], BOX[1], (num, 3)).astype(np.float32)


@pytest.mark.parametrize("variant", ["posterior", "bayesrays"])
def test_a_point_is_what_the_renderer_composites(grid, variance, variant):
    """Rays that stop at their only sample show just the colour and the channel of that point."""
    points, num = in_box(7), 7
    directions = RNG.normal(size=(num, 3)).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    samples = Samples(
        t_mids=jnp.full((num, 1), 1.5),
        deltas=jnp.full((num, 1), 1e3),  # opaque: no density of the field is below 0.5
        sample_mask=jnp.ones((num, 1), bool),
        thinned=jnp.zeros(num, bool),
    )
    channel = make_uncertainty_channel(grid, variance, variant=variant, scale="sigma")
    rendered = render_rays(
        Rays(jnp.asarray(points - 1.5 * directions), jnp.asarray(directions)),
        samples,
        smooth_field_fn,
        background=jnp.zeros(3),
        capacity=16,
        exact=True,
        channels={"uncertainty": channel},
    )
    point_fn = make_point_fn(MODEL, grid, variant=variant, chunk=4)
    got = point_fn(NOTHING_LEARNT, variance, points, directions=directions)
    # The renderer's positions are origin + 1.5 direction, off by float32 rounding.
    np.testing.assert_allclose(got["sigma"], rendered.channels["uncertainty"], rtol=1e-5)
    np.testing.assert_allclose(got["rgb"], rendered.rgb, atol=1e-5)
    np.testing.assert_allclose(got["density"], rendered.density[:, 0], rtol=1e-5)


@pytest.mark.parametrize("num", [0, 1, 4, 9])
def test_any_number_of_points_with_progress(grid, variance, num):
    done, points = [], in_box(num)
    point_fn = make_point_fn(MODEL, grid, variant="posterior", chunk=4)
    got = point_fn(
        NOTHING_LEARNT, variance, points, directions=[0.0, 0.0, 1.0], progress_fn=done.append
    )
    assert sum(done) == num and got["rgb"].shape == (num, 3)
    expected = smooth_field_fn(points, np.tile(np.float32([0.0, 0.0, 1.0]), (num, 1)))
    np.testing.assert_allclose(got["density"], expected[0], rtol=1e-5)
    np.testing.assert_allclose(got["rgb"], expected[1], rtol=1e-5)
    assert point_fn(NOTHING_LEARNT, variance, points).keys() == {"density", "sigma"}


def test_colour_over_several_directions_is_their_mean(grid, variance):
    point_fn = make_point_fn(MODEL, grid, variant="posterior", chunk=4)
    points, looks = in_box(6), np.eye(3)
    got = point_fn(NOTHING_LEARNT, variance, points, directions=looks[:, None])["rgb"]
    single = [point_fn(NOTHING_LEARNT, variance, points, directions=look)["rgb"] for look in looks]
    np.testing.assert_allclose(got, np.mean(single, axis=0), rtol=1e-5)


def test_outside_of_a_bounded_scene_there_is_nothing(grid, variance):
    points = np.array([[0.0, 0.0, 0.6], [0.0, 0.0, 0.4]])
    point_fn = make_point_fn(MODEL, grid, variant="posterior")
    assert (point_fn(NOTHING_LEARNT, variance, points)["density"] > 0).tolist() == [False, True]
    unbounded = dataclasses.replace(MODEL, box=None)
    everywhere = make_point_fn(unbounded, grid.replace(contracted=True), variant="posterior")
    assert (everywhere(NOTHING_LEARNT, variance, points)["density"] > 0).all()


def test_wrong_arguments_of_point_queries(grid, variance):
    with pytest.raises(ValueError, match="use one of posterior, bayesrays"):
        make_point_fn(MODEL, grid, variant="x")
    point_fn = make_point_fn(MODEL, grid, variant="posterior")
    with pytest.raises(ValueError, match=r"positions: have the shape \(3,\)"):
        point_fn(NOTHING_LEARNT, variance, np.zeros(3))
    with pytest.raises(ValueError, match=r"directions: have the shape \(2, 3\)"):
        point_fn(NOTHING_LEARNT, variance, np.zeros((4, 3)), directions=np.zeros((2, 3)))


def test_points_to_the_users_coordinates():
    scene = dataclasses.replace(toy_scene(), user_from_scene=TURNED)
    np.testing.assert_allclose(user_points(scene, [[1.0, 2.0, 3.0]]), [[6.0, 22.0, 36.0]])
    np.testing.assert_allclose(user_units(scene), 2.0)


# --- grids and volumes ---


def test_grid_covers_the_box_with_near_cubes_and_holds_each_points_value():
    axes = grid_axes(BOX, 9)
    assert [len(axis) for axis in axes] == [9, 9, 7]
    for axis, lower, upper in zip(axes, *BOX):
        np.testing.assert_allclose(np.diff(axis), 0.25, rtol=1e-9)
        assert (axis[0], axis[-1]) == (lower, upper)
    done = []
    values = sample_grid(
        lambda p: {"sum": p @ [1.0, 10.0, 100.0]}, axes, block=50, progress_fn=done.append
    )["sum"]
    x, y, z = np.meshgrid(*axes, indexing="ij")
    np.testing.assert_allclose(values, x + 10 * y + 100 * z, rtol=1e-5, atol=1e-5)
    assert sum(done) == 9 * 9 * 7
    with pytest.raises(ExportError, match="resolution: is 1"):
        grid_axes(BOX, 1)


def test_volume_read_back_has_its_values_at_the_users_places(tmp_path):
    scene = dataclasses.replace(toy_scene(), user_from_scene=TURNED)
    axes = grid_axes(BOX, 4)
    values = RNG.random([len(axis) for axis in axes]).astype(np.float32)
    path = tmp_path / "v.nrrd"
    path.write_bytes(nrrd_bytes(values, axes, user_from_scene=TURNED, content="test, 1 / m"))
    got, header = nrrd.read(str(path))
    np.testing.assert_array_equal(got, values)
    assert header["content"] == "test, 1 / m"
    index = np.stack(np.indices(values.shape), -1)
    places = header["space origin"] + index @ header["space directions"]
    corners = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    np.testing.assert_allclose(places, user_points(scene, corners), rtol=1e-9)


# --- clouds and meshes ---


def read_vertices(data):
    """The vertices of a PLY file as a structured array, and the shape that trimesh makes of it."""
    shape = trimesh.load(io.BytesIO(data), file_type="ply", process=False)
    return shape.metadata["_ply_raw"]["vertex"]["data"], shape


@pytest.mark.parametrize("faces", [None, np.array([[0, 1, 2], [2, 3, 0]])])
def test_ply_read_back_has_positions_colours_and_numbers(faces):
    positions, rgb, numbers = RNG.normal(size=(5, 3)), RNG.random((5, 3)), RNG.random(5)
    data = ply_bytes(positions, rgb, {"uncertainty": numbers, "sigma": 2 * numbers}, faces)
    vertices, shape = read_vertices(data)
    got = np.stack([vertices[name] for name in "xyz"], -1)
    np.testing.assert_allclose(got, positions, rtol=1e-6)
    colours = np.stack([vertices[name] for name in ("red", "green", "blue")], -1)
    np.testing.assert_allclose(colours / 255, rgb, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(vertices["uncertainty"], numbers, rtol=1e-6)
    np.testing.assert_allclose(vertices["sigma"], 2 * numbers, rtol=1e-6)
    if faces is not None:
        np.testing.assert_array_equal(shape.faces, faces)


def ball_density(axes, radius, *, middle=(0.0, 0.0, 0.0), steepness=60.0, most=2000.0):
    """A ball whose density rises from 0 to `most` within a few voxels; half of it at `radius`."""
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1) - middle
    return most / (1.0 + np.exp(steepness * (np.linalg.norm(points, axis=-1) - radius)))


def test_mesh_of_a_ball_has_its_radius_to_a_fraction_of_a_voxel():
    axes = grid_axes(BOX, 41)
    threshold = default_threshold(BOX)
    np.testing.assert_allclose(np.exp(-threshold * 0.01 * 2.0), 0.5)
    mesh = extract_mesh(ball_density(axes, 0.4), axes, threshold=threshold, closed=True)
    # The density is the threshold where most / (1 + exp(s (r - R))) = threshold.
    radius = 0.4 + np.log(2000.0 / threshold - 1.0) / 60.0
    radii = np.linalg.norm(mesh.vertices, axis=-1)
    np.testing.assert_allclose(radii, radius, atol=0.25 * 0.05)
    assert mesh.is_watertight
    # Positive: normals look outwards. A polyhedron in a ball has a little less volume.
    np.testing.assert_allclose(mesh.volume, 4 / 3 * np.pi * radius**3, rtol=0.03)


def test_what_reaches_the_border_is_closed_there_or_left_open():
    axes = grid_axes(BOX, 21)
    density = ball_density(axes, 0.8)  # higher than the box
    closed = extract_mesh(density, axes, threshold=1000.0, closed=True)
    open_ = extract_mesh(density, axes, threshold=1000.0, closed=False)
    assert closed.is_watertight and not open_.is_watertight
    for mesh in (closed, open_):
        np.testing.assert_allclose(mesh.bounds[1, 2], 0.5, atol=1e-6)


def test_small_parts_are_kept_unless_asked_to_go():
    axes = grid_axes(BOX, 41)
    density = ball_density(axes, 0.4) + ball_density(axes, 0.1, middle=(0.8, 0.8, 0.2))
    mesh = extract_mesh(density, axes, threshold=1000.0, closed=True)
    assert mesh.body_count == 2 and without_small_parts(mesh, min_share=0.0).body_count == 2
    large = without_small_parts(mesh, min_share=0.2)  # the small one has about 0.06
    assert large.body_count == 1
    assert np.linalg.norm(large.vertices, axis=-1).max() < 0.5
    assert without_small_parts(mesh, min_share=0.01).body_count == 2


@pytest.mark.parametrize("threshold", [1e9, 0.0, -1.0])
def test_thresholds_without_a_surface_are_errors(threshold):
    axes = grid_axes(BOX, 5)
    with pytest.raises(ExportError, match=r"density threshold: .* give a"):
        extract_mesh(ball_density(axes, 0.4), axes, threshold=threshold, closed=True)


def test_a_missing_library_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ExportError, match=r"trimesh: is not installed .*bavs_jax\[export\]"):
        import_extra("trimesh")


def test_cloud_holds_the_ends_of_rays_that_are_not_empty():
    table, num = make_pixel_table(toy_scene()), 10
    pixel_ids = np.arange(num, dtype=np.int32)
    views = 4 * (pixel_ids % 3)  # three sides of the ring

    def render(rays):
        depth = jnp.linalg.norm(rays.origins, axis=-1)
        return {"rgb": 1.1 * rays.directions**2, "depth": depth, "opacity": rays.directions[:, 0]}

    rays = view_pixel_rays(table.cameras, views, pixel_ids)
    keep = np.asarray(rays.directions[:, 0] >= 0.2)
    assert 0 < keep.sum() < num
    positions, rgb = ray_end_points(render, table, views, pixel_ids, chunk=4, min_opacity=0.2)
    depth = np.linalg.norm(rays.origins, axis=-1, keepdims=True)
    expected = np.asarray(rays.origins) + depth * np.asarray(rays.directions)
    np.testing.assert_allclose(positions, expected[keep], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(rgb, np.minimum(1.1 * rays.directions**2, 1.0)[keep], rtol=1e-5)
    empty, _ = ray_end_points(render, table, views, pixel_ids, chunk=4, min_opacity=2.0)
    assert empty.shape == (0, 3)


# --- geometry error ---


def test_geometry_error_of_a_ball_of_another_size():
    """One camera sees the front of a ball of radius 0.5, the mesh being one of 0.6."""
    scene = toy_scene(num_views=1, num_test=0, size=64)
    eye = np.asarray(scene.cameras.world_from_cam)[0, :, 3]
    away = np.linalg.norm(eye)
    ahead, depth = -eye / away, away - 0.3  # of every pixel: what lies on this side of it is seen
    scene = dataclasses.replace(scene, depth=np.full(64 * 64, depth, np.float32))
    seen = seen_by_any(scene, eye + depth * np.array([[0.5], [1.008], [1.02]]) * ahead)
    assert seen.tolist() == [True, True, False]  # in front, within the tolerance of 1 %, behind
    assert not seen_by_any(scene, eye - ahead[None]).any()

    points = [
        sample_mesh(trimesh.creation.icosphere(subdivisions=4, radius=r), 4000, seed=seed)
        for seed, r in enumerate((0.6, 0.5, 0.5))
    ]
    error = geometry_error(scene, *points, distance=0.05)
    # 4000 points on an area of pi: their spacing of about 0.5 sqrt(pi / 4000) = 0.014 adds to the
    # distance of 0.1 by no more than sqrt(0.1^2 + 0.028^2) - 0.1 = 0.004.
    np.testing.assert_allclose(error["whole"]["chamfer"], 0.1, atol=0.004)
    assert error["whole"]["f_score"] == 0.0 and error["floor"]["f_score"] > 0.99
    np.testing.assert_allclose(error["floor"]["chamfer"], 0.014, rtol=0.2)
    assert error["seen"]["accuracy"] > 0.09
    with pytest.raises(ValueError, match="has no true depth"):
        seen_by_any(toy_scene(), points[0])
