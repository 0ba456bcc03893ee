"""Compositing, marching, packing and the renderer against loops and closed forms."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.cameras import Rays, pixel_rays, subpixel_offsets, view_pixels
from bavs_jax.rendering.compositing import (
    composite,
    expected_depth,
    render_weights,
    transmittance,
)
from bavs_jax.rendering.images import render_pixels, render_views
from bavs_jax.rendering.occupancy import (
    WARMUP_UPDATES,
    cell_index,
    init_occupancy,
    update_occupancy,
)
from bavs_jax.rendering.packing import evaluate_all_passes, evaluate_one_pass
from bavs_jax.rendering.render import Channel, render_rays
from bavs_jax.rendering.sampling import (
    box_interval,
    make_march_options,
    march,
    nth_hit,
    pack_hits,
    visible_samples,
)
from tests.oracles_rendering import march_loop, render_loop, weights_loop
from tests.toy_fields import rays_through, smooth_field_fn
from tests.toy_scenes import toy_scene

BOX = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]], np.float32)
WHITE = jnp.ones(3)


def random_occupancy(key, share=0.3, resolution=8):
    occupancy = init_occupancy(BOX, resolution=resolution)
    return occupancy.replace(occupied=jax.random.uniform(key, (resolution**3,)) < share)


def options(num_steps=48, num_slots=48):
    return make_march_options(BOX, near=0.5, far=8.0, num_steps=num_steps, num_slots=num_slots)


# --- compositing -----------------------------------------------------------------------------


def test_weights_agree_with_the_recursion():
    density = jax.random.exponential(jax.random.key(0), (5, 20)) * 10.0
    deltas = jax.random.uniform(jax.random.key(1), (5, 20)) * 0.1
    got = render_weights(density, deltas)
    want = [weights_loop(s, d) for s, d in zip(density, deltas)]
    np.testing.assert_allclose(got, want, atol=1e-6)  # float32 against float64


def test_homogeneous_fog_has_its_closed_form():
    """Constant sigma over a length L: opacity 1 - exp(-sigma L), however it is cut up."""
    for num in (1, 7, 100):
        weights = render_weights(jnp.full(num, 0.7), jnp.full(num, 2.0 / num))
        np.testing.assert_allclose(weights.sum(), 1.0 - np.exp(-1.4), rtol=1e-5)


def test_small_opacities_are_exact():
    # 1 - exp(-x) would be 0 below x = 6e-8, and of one digit at 1e-7.
    optical = np.array([1e-10, 1e-7, 1e-4], np.float32)
    for x in optical:
        weights = render_weights(jnp.array([x]), jnp.ones(1))
        np.testing.assert_allclose(weights, -np.expm1(-np.float64(x)), rtol=1e-6)


@pytest.mark.parametrize("density", [0.0, 1e-12, 1e5])
def test_weights_and_gradients_are_finite_at_extremes(density):
    def loss(sigma):
        weights = render_weights(sigma, jnp.full(8, 0.1))
        return expected_depth(weights, jnp.arange(8.0)) + weights.sum()

    value, grad = jax.value_and_grad(loss)(jnp.full(8, density))
    assert np.isfinite(value) and np.isfinite(grad).all()


def test_empty_ray_shows_the_background_and_depth_zero():
    weights = render_weights(jnp.zeros(6), jnp.ones(6))
    np.testing.assert_array_equal(composite(weights, jnp.ones((6, 3)) * 0.3, WHITE), WHITE)
    assert expected_depth(weights, jnp.ones(6)) == 0.0


# --- marching --------------------------------------------------------------------------------


def test_march_agrees_with_a_loop():
    occupancy = random_occupancy(jax.random.key(0))
    rays = rays_through(jax.random.key(1), 40)
    opts = options()
    samples = march(rays, occupancy, opts)
    grid = np.asarray(occupancy.occupied).reshape(8, 8, 8)
    differing = 0
    for ray in range(40):
        want = march_loop(
            rays.origins[ray], rays.directions[ray], grid, BOX, 0.5, 8.0, opts.step_size, 48
        )
        got = samples.t_mids[ray][samples.sample_mask[ray]]
        if len(got) != len(want):  # a sample within rounding of a cell's face
            differing += 1
            continue
        np.testing.assert_allclose(got, want, atol=1e-5)
    assert differing <= 2


@pytest.mark.parametrize("num_columns", [1, 31, 32, 33, 192])
def test_nth_hit_is_that_of_flatnonzero(num_columns):
    rng = np.random.default_rng(num_columns)
    hit = rng.random((60, num_columns)) < np.linspace(0.0, 1.0, 60)[:, None]  # none to all
    hits = pack_hits(jnp.asarray(hit))
    np.testing.assert_array_equal(hits.total, hit.sum(1))
    columns = nth_hit(hits, jnp.tile(jnp.arange(num_columns), (60, 1)))
    for row, found in zip(hit, np.asarray(columns)):
        np.testing.assert_array_equal(found[: row.sum()], np.flatnonzero(row))


def test_valid_slots_come_first_and_cover_what_is_occupied():
    occupancy = random_occupancy(jax.random.key(2), share=0.7)
    rays = rays_through(jax.random.key(3), 50)
    full = march(rays, occupancy, options())
    thin = march(rays, occupancy, options(num_slots=8))
    for samples in (full, thin):
        mask = np.asarray(samples.sample_mask)
        assert (np.diff(mask.astype(int), axis=1) <= 0).all()
        assert (np.asarray(samples.deltas)[~mask] == 0).all()
    counts = np.asarray(full.sample_mask.sum(-1))
    assert not full.thinned.any() and thin.thinned.any()
    for slots in (8, counts.max() - 1, counts.max()):
        samples = march(rays, occupancy, options(num_slots=int(slots)))
        np.testing.assert_array_equal(samples.thinned, counts > slots)
    # A thinned ray still stands for its whole way.
    np.testing.assert_allclose(full.deltas.sum(-1), thin.deltas.sum(-1), atol=1e-5)


@pytest.mark.parametrize("slots", [48, 6])
def test_rays_end_on_a_closed_box_whatever_is_occupied(slots):
    """The last step is there and opaque in thin fog; all others are those of an open box."""
    limits = {"near": 0.5, "far": 8.0, "num_steps": 48, "num_slots": slots}
    shut, open_ = (make_march_options(BOX, **limits, closed=closed) for closed in (True, False))
    rays = rays_through(jax.random.key(1), 40)
    enter, leave = box_interval(rays, jnp.asarray(BOX), 0.5, 8.0)
    for share in (0.0, 0.3, 1.0):
        occupancy = random_occupancy(jax.random.key(0), share)
        samples, before = march(rays, occupancy, shut), march(rays, occupancy, open_)
        num = np.asarray(samples.sample_mask.sum(-1))
        is_long = np.asarray(leave - enter) > 2.0 * shut.step_size
        assert is_long.sum() > 30 and (num[is_long] > 0).all() and num.max() <= slots
        last = np.asarray(samples.t_mids)[np.arange(40), np.maximum(num - 1, 0)]
        steps_off = np.asarray(samples.thinned) * (-(-48 // slots)) + 1.0
        gap = (np.asarray(leave) - last)[is_long]
        assert gap.min() > -1e-5 and (gap <= shut.step_size * steps_off[is_long] + 1e-5).all()
        thin = 0.3 / float(BOX[1][0] - BOX[0][0])
        opacity = render_weights(jnp.full(samples.deltas.shape, thin), samples.deltas).sum(-1)
        np.testing.assert_allclose(opacity[is_long], 1.0, atol=1e-5)
        if slots == 48:  # no ray is thinned
            both = np.asarray(before.sample_mask)
            np.testing.assert_array_equal(before.t_mids[both], samples.t_mids[both])
            assert (num - both.sum(-1) <= 1).all()


def test_thinned_rays_look_everywhere_in_turn():
    """A sample's place is uniform over the steps it stands for: of a straight line over the way,
    the mean over jitters is the integral over all of it."""
    occupancy = init_occupancy(BOX, resolution=4)
    rays = rays_through(jax.random.key(5), 20)
    opts = options(num_slots=6)

    def mean_place(options):
        found = [march(rays, occupancy, options, jitter=jnp.full(20, j)) for j in jitters]
        places = [(s.deltas * s.t_mids).sum(-1) / s.deltas.sum(-1) for s in found]
        return np.mean(places, axis=0), np.asarray(found[0].thinned)

    jitters = (np.arange(60) + 0.5) / 60  # evenly divided by groups of up to 6 steps
    place, thinned = mean_place(opts)
    assert thinned.sum() > 10
    # The number of steps differs by one with the jitter; always the first step of a group would
    # be off by half a step and more.
    np.testing.assert_allclose(place, mean_place(options())[0], atol=0.2 * opts.step_size)


def test_rays_that_miss_the_box_have_no_samples():
    rays = Rays(jnp.array([[3.0, 0.0, 0.0], [0.0, 3.0, 0.0]]), jnp.array([[0.0, 0, 1], [0, 1, 0]]))
    samples = march(rays, init_occupancy(BOX, resolution=4), options())
    assert not samples.sample_mask.any()


def test_axis_parallel_rays_cross_the_whole_box():
    rays = Rays(jnp.array([[-3.0, 0.1, 0.2]]), jnp.array([[1.0, 0.0, 0.0]]))
    samples = march(rays, init_occupancy(BOX, resolution=4), options())
    np.testing.assert_allclose(samples.deltas.sum(), 2.0, atol=options().step_size)


def test_occupancy_finds_a_ball_and_forgets_what_is_gone():
    occupancy = init_occupancy(BOX, resolution=16)

    def ball(x):
        return jnp.where(jnp.linalg.norm(x, axis=-1) < 0.5, 50.0, 0.0)

    def nothing(x):
        return jnp.zeros(len(x))

    update = partial(update_occupancy, num_samples=16**3, step_size=0.05)
    for i in range(8):
        occupancy = update(jax.random.key(i), occupancy, ball)
    inside = jnp.array([[0.0, 0, 0], [0.3, 0, 0]])
    outside = jnp.array([[0.8, 0, 0], [0.6, 0.6, 0.6]])
    assert occupancy.occupied[cell_index(occupancy, inside)].all()
    assert not occupancy.occupied[cell_index(occupancy, outside)].any()
    # Sampled cells cover the ball's volume share (pi / 48) up to one layer of border cells.
    assert 0.05 < float(occupancy.occupied.mean()) < 0.13
    for i in range(60):
        occupancy = update(jax.random.key(100 + i), occupancy, nothing)
    assert not occupancy.occupied[cell_index(occupancy, inside)].any()


@pytest.mark.parametrize("num_updates", [WARMUP_UPDATES - 1, WARMUP_UPDATES])
@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_an_update_agrees_with_a_loop_over_the_samples(scale, num_updates):
    """`scale` 1 is above the threshold on average, 1e-3 is below; some cells are drawn twice."""
    before = scale * jax.random.exponential(jax.random.key(0), (27,))
    occupancy = init_occupancy(BOX, resolution=3).replace(
        density=before, num_updates=jnp.int32(num_updates)
    )
    seen = []

    def density_fn(x):
        seen.append((x, scale * (x[:, 0] + 1.5) ** 4))
        return seen[0][1]

    options = {"num_samples": 15, "step_size": 0.1, "decay": 0.5, "threshold": 0.05}
    after = update_occupancy(jax.random.key(1), occupancy, density_fn, **options)
    want, cells = np.array(before), np.asarray(cell_index(occupancy, seen[0][0]))
    assert 5 < len(set(cells)) < 15
    for cell in set(cells):
        want[cell] = max(0.5 * want[cell], *np.asarray(seen[0][1])[cells == cell])
    np.testing.assert_allclose(after.density, want, rtol=1e-6)
    is_thick = 0.1 * want > min(0.05, 0.1 * want.mean())
    assert 0 < is_thick.sum() < 27
    np.testing.assert_array_equal(after.occupied, is_thick | (num_updates < WARMUP_UPDATES))
    assert after.num_updates == num_updates + 1


def test_fresh_occupancy_keeps_everything_at_first():
    occupancy = init_occupancy(BOX, resolution=8)
    occupancy = update_occupancy(
        jax.random.key(0), occupancy, lambda x: jnp.zeros(len(x)), num_samples=99, step_size=0.1
    )
    assert occupancy.occupied.all()


# --- hidden samples --------------------------------------------------------------------------


def wall_density(positions):
    """Thin air before the plane x = 0.2, and a wall of 60 / unit behind it."""
    return jnp.where(positions[..., 0] > 0.2, 60.0, 0.1)


def test_hidden_samples_are_those_that_the_closed_form_says():
    """Along x: 1.2 units of air, then a wall that light leaves at 1 % after ln(100) / 60 units."""
    rays = Rays(jnp.array([[-3.0, 0.1, 0.2]]), jnp.array([[1.0, 0.0, 0.0]]))
    samples = march(rays, init_occupancy(BOX, resolution=4), options(num_steps=400, num_slots=400))
    least = 0.01 * np.exp(-0.1 * 1.2)
    kept, fits = visible_samples(wall_density, rays, samples, capacity=400, least=least)
    assert fits.all() and samples.sample_mask.sum() > 200
    depth_in_wall = np.log(100.0) / 60.0
    last = kept.t_mids[0][kept.sample_mask[0]].max()
    step = samples.deltas[0, 0]
    np.testing.assert_allclose(last, 3.0 + 0.2 + depth_in_wall, atol=1.5 * step)
    assert kept.deltas[~kept.sample_mask].sum() == 0.0


@pytest.mark.parametrize("least", [0.3, 0.01])
def test_colours_and_their_gradients_change_by_less_than_the_light_that_is_left(least):
    rays = rays_through(jax.random.key(7), 60)
    occupancy = random_occupancy(jax.random.key(8), share=0.8)
    samples = march(rays, occupancy, options())

    def field_fn(scale, x, d):
        density, rgb = smooth_field_fn(x, d)
        return scale * 4.0 * density, rgb

    kept, fits = visible_samples(
        lambda x: field_fn(1.0, x, x)[0], rays, samples, capacity=4000, least=least
    )
    mask, before = np.asarray(kept.sample_mask), np.asarray(samples.sample_mask)
    assert fits.all() and 0.1 < mask.sum() / before.sum() < 0.95
    assert (np.diff(mask.astype(int), axis=1) <= 0).all() and not (mask & ~before).any()

    @jax.jit
    def colours(scale, samples):
        return render_rays(
            rays, samples, partial(field_fn, scale), background=WHITE, capacity=4000, exact=False
        ).rgb

    np.testing.assert_allclose(colours(1.0, kept), colours(1.0, samples), atol=least)
    slopes = jax.jit(jax.jacrev(lambda scale, s: colours(scale, s)[jnp.array([0, 20, 40]), 0]))
    # d T / d scale is -tau exp(-tau), with tau = -log(least) where samples end.
    atol = 2.0 * least * (1.0 - np.log(least))
    np.testing.assert_allclose(slopes(1.0, kept), slopes(1.0, samples), atol=atol)
    again, _ = jax.jit(visible_samples, static_argnums=0, static_argnames=("capacity", "least"))(
        lambda x: field_fn(1.0, x, x)[0], rays, samples, capacity=4000, least=least
    )
    np.testing.assert_array_equal(again.sample_mask, mask)


def test_what_is_not_a_number_is_not_hidden():
    rays = rays_through(jax.random.key(7), 3)
    samples = march(rays, init_occupancy(BOX, resolution=4), options())
    kept, _ = visible_samples(
        lambda x: jnp.full(len(x), jnp.nan), rays, samples, capacity=200, least=0.01
    )
    np.testing.assert_array_equal(kept.sample_mask, samples.sample_mask)


def test_rays_that_were_not_looked_at_have_no_samples():
    rays = rays_through(jax.random.key(7), 60)
    samples = march(rays, random_occupancy(jax.random.key(8), share=0.8), options())
    count = np.asarray(samples.sample_mask.sum(-1))
    capacity = int(count[:20].sum())
    kept, fits = visible_samples(wall_density, rays, samples, capacity=capacity, least=0.0)
    np.testing.assert_array_equal(fits, np.cumsum(count) <= capacity)
    np.testing.assert_array_equal(kept.sample_mask.sum(-1), np.where(fits, count, 0))
    slope = jax.grad(
        lambda scale: visible_samples(
            lambda x: scale * wall_density(x), rays, samples, capacity=capacity, least=0.5
        )[0].deltas.sum()
    )(1.0)
    assert slope == 0.0


def test_transmittance_is_what_weights_have_left_over():
    density = jax.random.exponential(jax.random.key(0), (5, 20)) * 10.0
    deltas = jax.random.uniform(jax.random.key(1), (5, 20)) * 0.1
    left = 1.0 - jnp.cumsum(render_weights(density, deltas), axis=-1)
    np.testing.assert_allclose(transmittance(density, deltas)[:, 1:], left[:, :-1], atol=1e-6)


# --- packing ---------------------------------------------------------------------------------


def ragged_mask(key, num_rows=30, num_slots=12):
    count = jax.random.randint(key, (num_rows,), 0, num_slots + 1)
    return jnp.arange(num_slots) < count[:, None]


@pytest.mark.parametrize("capacity", [7, 64, 1000])
def test_all_passes_equal_dense_evaluation_for_any_capacity(capacity):
    mask = ragged_mask(jax.random.key(0))
    table = jax.random.normal(jax.random.key(1), (*mask.shape, 3))
    got = evaluate_all_passes(lambda row, slot, valid: table[row, slot], mask, capacity=capacity)
    np.testing.assert_array_equal(got, jnp.where(mask[..., None], table, 0.0))


def test_one_pass_keeps_whole_rays_or_none():
    mask = ragged_mask(jax.random.key(2))
    table = jax.random.normal(jax.random.key(3), mask.shape)
    capacity = int(mask.sum()) // 2
    got, ray_mask = evaluate_one_pass(lambda r, s, v: table[r, s], mask, capacity=capacity)
    assert 0 < int(ray_mask.sum()) < len(mask)
    assert int(mask.sum(-1)[ray_mask].sum()) <= capacity
    want = jnp.where(mask & ray_mask[:, None], table, 0.0)
    np.testing.assert_array_equal(got, want)


@pytest.mark.parametrize("spare, whole_rays", [(0, 3), (-1, 2), (1, 3)])
def test_one_pass_takes_a_ray_that_just_fits(spare, whole_rays):
    mask = jnp.arange(12) < jnp.array([5, 0, 12, 4])[:, None]
    got, ray_mask = evaluate_one_pass(lambda r, s, v: s + 1.0, mask, capacity=17 + spare)
    assert ray_mask.tolist() == [row < whole_rays for row in range(4)]
    want = jnp.where(mask & ray_mask[:, None], jnp.arange(1.0, 13.0), 0.0)
    np.testing.assert_array_equal(got, want)


# --- the renderer ----------------------------------------------------------------------------


def render(rays, samples, **kwargs):
    settings = {"background": WHITE, "capacity": 64, "exact": True} | kwargs
    return jax.jit(partial(render_rays, field_fn=smooth_field_fn, **settings))(rays, samples)


def test_renderer_agrees_with_a_loop():
    rays = rays_through(jax.random.key(0), 12)
    samples = march(rays, random_occupancy(jax.random.key(1)), options())
    got = render(rays, samples)
    for ray in range(12):
        keep = np.asarray(samples.sample_mask[ray])
        colour, depth, opacity = render_loop(
            smooth_field_fn,
            rays.origins[ray],
            rays.directions[ray],
            np.asarray(samples.t_mids[ray])[keep],
            np.asarray(samples.deltas[ray])[keep],
            np.ones(3),
        )
        np.testing.assert_allclose(got.rgb[ray], colour, atol=2e-6)  # float32 sums of 48
        np.testing.assert_allclose(got.depth[ray], depth, atol=2e-5)
        np.testing.assert_allclose(got.opacity[ray], opacity, atol=2e-6)


def test_one_pass_and_many_passes_agree_where_rays_fit():
    rays = rays_through(jax.random.key(2), 20)
    samples = march(rays, random_occupancy(jax.random.key(3)), options())
    exact = render(rays, samples, capacity=50)
    roomy = render(rays, samples, capacity=4096, exact=False)
    assert roomy.ray_mask.all()
    np.testing.assert_allclose(roomy.rgb, exact.rgb, atol=1e-6)
    small = render(rays, samples, capacity=100, exact=False)
    assert 0 < int(small.ray_mask.sum()) < 20
    np.testing.assert_allclose(small.rgb[small.ray_mask], exact.rgb[small.ray_mask], atol=1e-6)


def test_packed_gradients_equal_dense_ones():
    rays = rays_through(jax.random.key(6), 8)
    samples = march(rays, random_occupancy(jax.random.key(7)), options())
    positions = rays.origins[:, None] + samples.t_mids[..., None] * rays.directions[:, None]
    directions = jnp.broadcast_to(rays.directions[:, None], positions.shape)

    def scaled_fn(scale, x, d):
        density, rgb = smooth_field_fn(scale * x, d)
        return density, rgb

    def packed(scale):
        fn = partial(scaled_fn, scale)
        kwargs = {"background": WHITE, "capacity": 512, "exact": False}
        return jnp.square(render_rays(rays, samples, fn, **kwargs).rgb).sum()

    def dense(scale):
        density, rgb = scaled_fn(scale, positions, directions)
        weights = render_weights(density * samples.sample_mask, samples.deltas)
        return jnp.square(composite(weights, rgb, WHITE)).sum()

    slopes = jax.jit(lambda scale: (jax.grad(packed)(scale), jax.grad(dense)(scale)))
    np.testing.assert_allclose(*slopes(1.1), rtol=1e-4)


def test_displacement_by_a_constant_is_a_shift_of_the_rays():
    rays = rays_through(jax.random.key(4), 10)
    samples = march(rays, init_occupancy(BOX, resolution=4), options())
    shift = jnp.array([0.05, -0.02, 0.03])
    moved = render(rays, samples, displace_fn=lambda x: jnp.broadcast_to(shift, x.shape))
    shifted = render(Rays(rays.origins + shift, rays.directions), samples)
    np.testing.assert_allclose(moved.rgb, shifted.rgb, atol=1e-6)


def test_channels_are_composited_over_their_floor():
    rays = rays_through(jax.random.key(5), 10)
    empty_ray = Rays(jnp.array([[5.0, 5.0, 5.0]]), jnp.array([[1.0, 0.0, 0.0]]))
    rays = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), rays, empty_ray)
    samples = march(rays, init_occupancy(BOX, resolution=4), options())
    channel = Channel(lambda x, _: jnp.full(len(x), 2.0), floor=-3.0)
    got = render(rays, samples, channels={"two": channel})
    want = 2.0 * got.opacity - 3.0 * (1.0 - got.opacity)
    np.testing.assert_allclose(got.channels["two"], want, atol=1e-5)
    assert got.channels["two"][-1] == -3.0 and got.opacity[-1] == 0.0


# --- pixels of several rays --------------------------------------------------------------------


def test_a_pixel_shows_the_mean_of_its_rays_and_depth_counts_by_opacity():
    scene = toy_scene()
    ids, pixels = view_pixels(scene.cameras, [2, 5])

    def look(rays):
        x, y, z = (np.asarray(rays.directions)[:, i] for i in range(3))
        opacity = np.where(x > 0.1, np.abs(y), 0.0)  # some rays of a pixel see nothing
        return {"rgb": np.abs(np.asarray(rays.directions)), "depth": 2.0 + z, "opacity": opacity}

    got = render_pixels(look, scene.cameras, ids, pixels, chunk=50, rays_per_pixel=4)
    each = [
        look(pixel_rays(scene.cameras, jnp.asarray(ids), pixels + np.array(offset, np.float32)))
        for offset in ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))
    ]
    opacity = np.mean([rows["opacity"] for rows in each], axis=0)
    seen = sum(rows["opacity"] * rows["depth"] for rows in each) / 4.0
    np.testing.assert_allclose(got["rgb"], np.mean([r["rgb"] for r in each], axis=0), atol=1e-6)
    np.testing.assert_allclose(got["opacity"], opacity, atol=1e-6)
    expected = np.where(opacity > 0, seen / np.where(opacity > 0, opacity, 1.0), 0.0)
    assert 0 < (opacity == 0).sum() < len(ids)
    np.testing.assert_allclose(got["depth"], expected, atol=1e-5)
    images = render_views(look, scene.cameras, [2, 5], chunk=50, rays_per_pixel=4)
    np.testing.assert_array_equal(images[1]["rgb"].reshape(-1, 3), got["rgb"][64:])


def test_rays_of_a_pixel_are_an_even_grid_around_its_centre():
    np.testing.assert_array_equal(subpixel_offsets(1), [[0.0, 0.0]])
    nine = subpixel_offsets(9)
    np.testing.assert_allclose(nine.mean(0), 0.0, atol=1e-7)
    assert len(np.unique(np.round(nine, 4), axis=0)) == 9 and np.abs(nine).max() < 0.5
    for wrong in (0, 2, 8):
        with pytest.raises(ValueError, match="is no square; give 1, 4 or 9"):
            subpixel_offsets(wrong)
