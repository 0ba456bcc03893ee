"""Pixels drawn for training: of which views, with which rays, colours, backgrounds and weights."""

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax import pixel_table
from bavs_jax.cameras import project
from bavs_jax.pixel_table import make_pixel_table, pixel_colours, training_pixels, view_pixel_rays
from tests.toy_scenes import toy_scene

sample_pixels = jax.jit(
    pixel_table.sample_pixels,
    static_argnames=("num_rays", "rays_per_pixel", "random_background"),
)


def test_sampled_pixels_come_from_training_views_alone_and_from_all_of_them():
    scene = toy_scene()
    table = make_pixel_table(scene)
    mask = np.zeros(scene.num_views, bool)
    mask[[1, 4, 7]] = True
    batch = sample_pixels(jax.random.key(0), table, jnp.asarray(mask), num_rays=3000)
    rays = batch.rays
    positions = np.asarray(scene.cameras.positions)
    owner = np.linalg.norm(rays.origins[:, None] - positions, axis=-1).argmin(1)
    counts = np.bincount(owner, minlength=scene.num_views)
    assert set(np.flatnonzero(counts)) == {1, 4, 7} and (batch.pixel_weight == 1).all()
    np.testing.assert_array_equal(owner, batch.view_ids)
    # Binomial with p = 1/3: standard deviation 26; four of them.
    np.testing.assert_allclose(counts[[1, 4, 7]], 1000, atol=104)


def test_a_sampled_pixel_has_its_own_ray_colour_and_weight():
    scene = toy_scene()
    table = make_pixel_table(scene)
    num, rng = len(scene.pixels), np.random.default_rng(0)
    rgb = rng.permutation(256**3)[:num, None] // np.array([1, 256, 65536]) % 256  # no two alike
    keep = rng.uniform(size=num) < 0.7
    table = table.replace(pixels=jnp.asarray(rgb, jnp.uint8), pixel_mask=jnp.asarray(keep))
    is_training = np.isin(np.arange(scene.num_views), [0, 4, 7])
    batch = sample_pixels(jax.random.key(0), table, jnp.asarray(is_training), num_rays=3000)
    packed = np.round(np.asarray(batch.rgb, np.float64) * 255).astype(int) @ [1, 256, 65536]
    row_of = {int(c): row for row, c in enumerate(rgb @ [1, 256, 65536])}
    rows = np.array([row_of[int(c)] for c in packed])
    # 192 pixels, each drawn 16 times on average; that one of them is left out has 3e-5.
    view_of = np.searchsorted(scene.offsets, np.arange(num), side="right") - 1
    np.testing.assert_array_equal(np.unique(rows), np.flatnonzero(is_training[view_of]))
    np.testing.assert_array_equal(batch.view_ids, view_of[rows])
    np.testing.assert_array_equal(batch.pixel_weight, keep[rows])
    rays = view_pixel_rays(table.cameras, view_of[rows], rows - scene.offsets[view_of[rows]])
    np.testing.assert_allclose(batch.rays.origins, rays.origins, atol=1e-6)
    np.testing.assert_allclose(batch.rays.directions, rays.directions, atol=1e-6)


def test_rays_and_colours_belong_together():
    """The ray of a pixel numbered in row order points where the picture shows that colour."""
    scene = toy_scene()
    table = make_pixel_table(scene)
    pixel_ids = jnp.arange(64)
    view = jnp.full(64, 5)
    rays = view_pixel_rays(table.cameras, view, pixel_ids)
    colours = np.asarray(pixel_colours(table, view, pixel_ids)).reshape(8, 8, 3)
    np.testing.assert_allclose(colours, scene.image(5) / 255.0, atol=1e-6)
    along = -(rays.directions * rays.origins).sum(-1)
    closest = rays.origins + along[:, None] * rays.directions
    is_ball = np.linalg.norm(closest, axis=-1) < 0.7
    assert (is_ball.reshape(8, 8) == (colours < 1).any(-1)).all()


def test_the_rays_of_a_pixel_are_side_by_side_on_an_even_grid_within_it():
    scene = toy_scene()
    table, mask = make_pixel_table(scene), jnp.ones(scene.num_views, bool)
    args, background = (jax.random.key(0), table, mask), scene.background
    batch = sample_pixels(*args, num_rays=400, rays_per_pixel=4, background=background)
    alone = sample_pixels(*args, num_rays=100, background=background)  # the same pixels
    np.testing.assert_array_equal(batch.rgb, alone.rgb)
    np.testing.assert_array_equal(
        batch.view_ids.reshape(100, 4), np.repeat(alone.view_ids, 4).reshape(100, 4)
    )
    cameras = jax.tree.map(lambda x: x[batch.view_ids], table.cameras)
    places = np.asarray(
        jax.vmap(lambda c, o, d: project(c, o + d)[0])(
            cameras, batch.rays.origins, batch.rays.directions
        )
    ).reshape(100, 4, 2)
    within = places - np.floor(places[:, :1])
    corners = [[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]]
    np.testing.assert_allclose(within, np.tile(corners, (100, 1, 1)), atol=1e-3)
    np.testing.assert_allclose(batch.background, np.ones((400, 3)) * scene.background)


def test_masked_pixels_have_no_weight():
    scene = toy_scene(num_views=4, num_test=1)
    keep = np.arange(len(scene.pixels)) % 2 == 0
    table = make_pixel_table(scene).replace(pixel_mask=jnp.asarray(keep))
    batch = sample_pixels(jax.random.key(0), table, jnp.ones(4, bool), num_rays=400)
    assert 120 < int(batch.pixel_weight.sum()) < 280  # half of 400, many standard deviations wide
    view_ids, pixel_ids = training_pixels(table, np.ones(4, bool))
    assert len(view_ids) == keep.sum()
    assert (keep[scene.offsets[view_ids] + pixel_ids]).all()


def test_random_background_shows_the_same_photos_over_other_colours():
    scene = toy_scene(num_views=4, num_test=1)
    rng = np.random.default_rng(0)
    straight = rng.random((len(scene.pixels), 3))  # colours before anything lies behind them
    alpha = rng.choice([0, 77, 255], len(straight)).astype(np.uint8)
    share = (alpha / 255.0)[:, None]
    over = share * straight + (1.0 - share) * scene.background
    table = make_pixel_table(scene).replace(
        pixels=jnp.asarray(np.rint(255.0 * over), jnp.uint8), alpha=jnp.asarray(alpha)
    )
    args = (jax.random.key(0), table, jnp.ones(4, bool))
    plain = sample_pixels(*args, num_rays=500, background=scene.background)
    drawn = sample_pixels(*args, num_rays=500, background=scene.background, random_background=True)
    np.testing.assert_array_equal(plain.rays.directions, drawn.rays.directions)  # the same pixels
    assert np.ptp(drawn.background, axis=0).min() > 0.9  # a colour of its own for each ray
    # alpha of these pixels, from how far the colours moved with the background
    moved = np.asarray(drawn.rgb - plain.rgb) / np.asarray(drawn.background - plain.background)
    seen = np.isin(np.rint(255.0 * (1.0 - moved.mean(-1))), [0, 77, 255])
    assert seen.all() and len(np.unique(np.rint(255.0 * moved.mean(-1)))) == 3
    np.testing.assert_array_equal(plain.background, np.ones((500, 3)) * scene.background)


def test_opaque_photos_have_no_random_background():
    scene = toy_scene(num_views=4, num_test=1)
    table = make_pixel_table(scene)
    args = (jax.random.key(0), table, jnp.ones(4, bool))
    plain = sample_pixels(*args, num_rays=50, background=scene.background)
    drawn = sample_pixels(*args, num_rays=50, background=scene.background, random_background=True)
    np.testing.assert_array_equal(plain.rgb, drawn.rgb)
    np.testing.assert_array_equal(plain.background, drawn.background)
    nothing = sample_pixels(*args, num_rays=50, background=None, random_background=True)
    assert nothing.background is None
