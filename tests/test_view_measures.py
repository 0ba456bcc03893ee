"""Measures that compare a candidate with the training cameras: coverage and warping."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.cameras import Rays, look_at, make_cameras
from bavs_jax.rendering.compositing import composite
from bavs_jax.uncertainty.measures import at_nearest_pixel, direction_novelty, look_at_points
from bavs_jax.uncertainty.warp import WarpSources, sample_bilinear, warp_disagreement
from tests import oracles_pixel as oracles
from tests.traces import count_traces

SIZE = (12, 10)  # width, height
NUM = 6
novelty_fn = jax.jit(direction_novelty)
warp_fn = jax.jit(warp_disagreement, static_argnames=("quantity", "combine"))


def orbit(num=NUM, seed=0):
    """Cameras on a sphere of radius 3 that look roughly at its centre."""
    rng = np.random.default_rng(seed)
    positions = rng.normal(size=(num, 3))
    positions *= 3.0 / np.linalg.norm(positions, axis=1, keepdims=True)
    poses = [look_at(p, rng.uniform(-0.4, 0.4, 3)) for p in positions]
    return make_cameras(np.stack(poses), [[14.0, 15.0, 6.0, 5.0]] * num, [SIZE] * num)


def maps(seed, num=NUM):
    """Colours [V, H, W, 3] and depths [V, H, W], a fifth of it empty."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(2.0, 4.0, (num, SIZE[1], SIZE[0]))
    depth *= rng.uniform(size=depth.shape) > 0.2
    rgb = rng.uniform(size=(num, SIZE[1], SIZE[0], 3))
    return rgb.astype(np.float32), depth.astype(np.float32)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def points_and_directions(seed, num=80):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.5, 1.5, (num, 3)).astype(np.float32)
    return points, unit(rng.normal(size=(num, 3))).astype(np.float32)


def facing(position, *, target=(0.0, 0.0, 0.0)):
    """One camera whose middle pixel looks from `position` at `target`."""
    return make_cameras([look_at(position, target)], [[12.0, 12.0, 6.0, 5.0]], [SIZE])


# --- visibility ------------------------------------------------------------------------------


def test_the_nearest_pixel_holds_the_point():
    image = jnp.arange(120.0).reshape(10, 12)
    pixels = jnp.array(
        [[0.0, 0.0], [0.99, 0.5], [1.0, 0.5], [3.2, 7.9], [12.0, 10.0], [-4.0, 99.0]]
    )
    np.testing.assert_array_equal(at_nearest_pixel(image, pixels), [0, 0, 1, 87, 119, 108])


def test_a_camera_sees_what_is_on_its_surface_and_in_front_but_not_behind():
    camera = jax.tree.map(lambda x: x[0], facing([0.0, -4.0, 0.0]))
    distances = np.array([2.0, 3.0, 3.14, 3.2, 4.0], np.float32)
    points = np.array([0.0, -4.0, 0.0]) + distances[:, None] * np.array([0.0, 1.0, 0.0])
    depth = jnp.full((10, 12), 3.0)
    is_seen, pixels = look_at_points(camera, points, depth)
    np.testing.assert_array_equal(is_seen, [True, True, True, False, False])  # 5 % of tolerance
    np.testing.assert_allclose(pixels[0], [6.0, 5.0], atol=1e-5)  # float32
    exact, _ = look_at_points(camera, points, depth, tolerance=0.0)
    np.testing.assert_array_equal(exact[1:], [True, False, False, False])
    for through in (
        look_at_points(camera, points)[0],
        look_at_points(camera, points, depth, tolerance=1.0)[0],
        look_at_points(camera, points, jnp.zeros_like(depth))[0],
    ):
        np.testing.assert_array_equal(through, True)


# --- coverage --------------------------------------------------------------------------------


@pytest.mark.parametrize("with_depth", [True, False])
def test_novelty_against_the_slow_reference(with_depth):
    cameras, mask = orbit(), np.array([True, True, False, True, False, True])
    points, directions = points_and_directions(0)
    depth = maps(1)[1] if with_depth else None
    value = novelty_fn(points, directions, cameras, mask, depth)
    expected = [
        oracles.novelty(
            p, d, cameras.world_from_cam, cameras.intrinsics, cameras.sizes, mask, depth
        )
        for p, d in zip(points, directions)
    ]
    np.testing.assert_allclose(value, expected, atol=1e-6)  # float32
    assert 0.02 < np.mean(np.equal(value, 1.0)) < 0.9  # both kinds are there


@pytest.mark.parametrize("degrees, expected", [(0, 0.0), (60, 0.25), (90, 0.5), (180, 1.0)])
def test_novelty_of_a_known_angle(degrees, expected):
    angle = np.deg2rad(degrees)
    directions = jnp.array([[np.sin(angle), np.cos(angle), 0.0]], jnp.float32)
    value = novelty_fn(jnp.zeros((1, 3)), directions, facing([0.0, -4.0, 0.0]), jnp.ones(1, bool))
    np.testing.assert_allclose(value, [expected], atol=1e-6)  # float32


def test_a_point_that_no_camera_sees_is_all_new():
    cameras = facing([0.0, -4.0, 0.0])
    directions = jnp.array([[0.0, 1.0, 0.0]] * 3)
    points = jnp.array([[0.0, 0.0, 0.0], [0.0, -6.0, 0.0], [9.0, 0.0, 0.0]])
    value = novelty_fn(points, directions, cameras, jnp.ones(1, bool))
    np.testing.assert_allclose(value, [0.0, 1.0, 1.0], atol=1e-6)  # seen, behind, outside
    nobody = novelty_fn(points, directions, cameras, jnp.zeros(1, bool))
    np.testing.assert_array_equal(nobody, 1.0)
    hidden = novelty_fn(points, directions, cameras, jnp.ones(1, bool), jnp.full((1, 10, 12), 2.0))
    np.testing.assert_array_equal(hidden, 1.0)


def test_every_camera_more_makes_it_less_new():
    points, directions = points_and_directions(2)
    before = np.ones(len(points))
    cameras = orbit()
    for num in range(1, NUM + 1):
        value = np.asarray(novelty_fn(points, directions, cameras, np.arange(NUM) < num))
        assert (value <= before).all() and (value >= 0.0).all()
        before = value


def test_a_ray_that_meets_nothing_has_no_novelty():
    points, directions = points_and_directions(3, num=24)
    value = novelty_fn(points, directions, orbit(), np.ones(NUM, bool)).reshape(3, 8)
    weights = jnp.zeros((3, 8)).at[1].set(0.1)
    rendered = composite(weights, value[..., None], 0.0)[:, 0]
    np.testing.assert_allclose(rendered, [0.0, 0.1 * value[1].sum(), 0.0], rtol=1e-6)


# --- warping ---------------------------------------------------------------------------------


def candidate_rays(seed, num=60):
    """Rays of a camera among the others, with colours, depths and opacities of their own."""
    rng = np.random.default_rng(seed)
    origin = np.array([1.0, -2.5, 0.8])
    targets = rng.uniform(-1.0, 1.0, (num, 3))
    rays = Rays(
        np.tile(origin, (num, 1)).astype(np.float32), unit(targets - origin).astype(np.float32)
    )
    depth = np.linalg.norm(targets - origin, axis=1).astype(np.float32)
    return rays, rng.uniform(size=(num, 3)).astype(np.float32), depth


@pytest.mark.parametrize("quantity", ["colour", "depth"])
@pytest.mark.parametrize("combine", ["min", "mean"])
def test_warping_against_the_slow_reference(quantity, combine):
    cameras, (images, depth_maps) = orbit(), maps(4)
    mask = np.array([True, False, True, True, False, True])
    rays, rgb, depth = candidate_rays(5)
    opacity = np.random.default_rng(6).uniform(size=len(rgb)).astype(np.float32)
    value = warp_fn(
        rays,
        rgb,
        depth,
        opacity,
        WarpSources(cameras, images, depth_maps, mask),
        quantity=quantity,
        combine=combine,
    )
    expected = [
        oracles.warp(
            o + t * d,
            c,
            cameras.world_from_cam,
            cameras.intrinsics,
            cameras.sizes,
            images,
            depth_maps,
            mask,
            quantity=quantity,
            combine=combine,
        )
        for o, d, t, c in zip(rays.origins, rays.directions, depth, rgb)
    ]
    np.testing.assert_allclose(value, opacity * np.array(expected), atol=2e-5)  # float32 pixels
    assert 0.0 < np.mean(np.equal(expected, 1.0)) < 0.9


def test_bilinear_samples_are_exact_at_centres_and_linear_between():
    image = np.random.default_rng(7).uniform(size=(10, 12, 3)).astype(np.float32)
    pixels = np.random.default_rng(8).uniform([0, 0], [12, 10], (50, 2)).astype(np.float32)
    expected = [oracles.bilinear(image, p) for p in pixels]
    np.testing.assert_allclose(sample_bilinear(image, pixels), expected, atol=1e-5)  # float32
    np.testing.assert_allclose(
        sample_bilinear(image, np.array([[3.5, 2.5]])), image[2, 3][None], atol=1e-6
    )


def plane_view(position, colour_fn):
    """What a camera sees of the plane y = 0: its camera, colours [1, H, W, 3], depths."""
    camera = facing(position)
    pose = np.asarray(camera.world_from_cam[0], np.float64)
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    local = np.stack([(x - 6.0) / 12.0, -(y - 5.0) / 12.0, -np.ones_like(x)], axis=-1)
    directions = unit(local @ pose[:, :3].T)
    t = -pose[1, 3] / directions[..., 1]
    points = pose[:, 3] + t[..., None] * directions
    return camera, directions, colour_fn(points)[None], t[None], points


def affine_colour(points):
    return 0.5 + np.stack([0.1 * points[..., 0], 0.1 * points[..., 2], 0.0 * points[..., 0]], -1)


def test_views_of_one_true_scene_agree():
    """A plane with linear colours, which bilinear samples reproduce up to perspective."""
    source, _, images, depths, _ = plane_view([0.5, -4.0, 0.3], affine_colour)
    _, directions, colours, t, points = plane_view([-0.4, -3.0, 0.2], affine_colour)
    inside = (np.abs(points[..., 0] - 0.5) < 1.2) & (np.abs(points[..., 2] - 0.3) < 1.0)
    rays = Rays(jnp.full((120, 3), jnp.array([-0.4, -3.0, 0.2])), directions.reshape(-1, 3))
    sources = WarpSources(source, images, depths, np.ones(1, bool))
    arguments = rays, colours.reshape(-1, 3), t.reshape(-1), jnp.ones(120), sources
    by_colour = warp_fn(*arguments).reshape(10, 12)
    # Colours differ by 0.03 from pixel to pixel; perspective bends a hundredth of that.
    assert inside.sum() > 20 and by_colour[inside].max() < 1e-3
    by_depth = warp_fn(*arguments, quantity="depth").reshape(10, 12)
    assert by_depth[inside].max() < 0.03  # the depth within half a pixel of a slanted plane


def test_a_floater_disagrees():
    """The candidate sees a red thing in mid-air where the training view sees through."""
    sources = WarpSources(
        facing([0.0, -4.0, 0.0]), np.ones((1, 10, 12, 3)), np.zeros((1, 10, 12)), np.ones(1, bool)
    )
    rays = Rays(jnp.array([[3.0, 0.0, 0.0]]), jnp.array([[-1.0, 0.0, 0.0]]))
    arguments = rays, jnp.array([[1.0, 0.0, 0.0]]), jnp.array([3.0]), jnp.ones(1), sources
    np.testing.assert_allclose(warp_fn(*arguments), 2.0 / 3.0, rtol=1e-6)
    np.testing.assert_allclose(warp_fn(*arguments, quantity="depth"), 1.0)


def test_hidden_points_are_unknown_unless_views_look_through_everything():
    sources = WarpSources(
        facing([0.0, -4.0, 0.0]),
        np.full((1, 10, 12, 3), 0.5),
        np.full((1, 10, 12), 2.0),
        np.ones(1, bool),
    )
    rays = Rays(jnp.array([[3.0, 0.0, 0.0]]), jnp.array([[-1.0, 0.0, 0.0]]))
    arguments = rays, jnp.full((1, 3), 0.5), jnp.array([3.0]), jnp.ones(1), sources
    np.testing.assert_array_equal(warp_fn(*arguments), 1.0)
    np.testing.assert_allclose(warp_fn(*arguments, tolerance=1.0), 0.0, atol=1e-6)


@pytest.mark.parametrize("combine", ["min", "mean"])
def test_an_empty_image_is_certain_and_an_unseen_surface_is_not(combine):
    images, depth_maps = maps(9)
    rays, rgb, depth = candidate_rays(10)
    for mask in (np.ones(NUM, bool), np.zeros(NUM, bool)):
        sources = WarpSources(orbit(), images, depth_maps, mask)
        empty = warp_fn(
            rays, jnp.ones_like(rgb), 0.0 * depth, 0.0 * depth, sources, combine=combine
        )
        np.testing.assert_array_equal(empty, 0.0)
    unseen = warp_fn(rays, rgb, depth, jnp.ones(60), sources, combine=combine)
    np.testing.assert_array_equal(unseen, 1.0)


def test_unknown_options_are_errors():
    images, depth_maps = maps(11)
    sources = WarpSources(orbit(), images, depth_maps, np.ones(NUM, bool))
    rays, rgb, depth = candidate_rays(12)
    with pytest.raises(ValueError, match="quantity: 'color' is unknown; use one of colour, depth"):
        warp_fn(rays, rgb, depth, depth, sources, quantity="color")
    with pytest.raises(ValueError, match="combine: 'max' is unknown; use one of min, mean"):
        warp_fn(rays, rgb, depth, depth, sources, combine="max")


def test_nothing_is_traced_anew_while_views_are_added():
    cameras, (images, depth_maps) = orbit(), maps(13)
    points, directions = points_and_directions(14)
    rays, rgb, depth = candidate_rays(15)

    @jax.jit
    def coverage(mask):
        return direction_novelty(points, directions, cameras, mask, depth_maps)

    @jax.jit
    def warping(mask):
        sources = WarpSources(cameras, images, depth_maps, mask)
        return warp_disagreement(rays, rgb, depth, jnp.ones_like(depth), sources)

    with count_traces() as traces:
        for num in (1, 2, 5):
            coverage(np.arange(NUM) < num)
            warping(np.arange(NUM) < num)
    assert traces.count("coverage") == traces.count("warping") == 1
