"""Training: masks, traces, learning, checkpoints."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from bavs_jax.fields.deformation import DeformationGrid
from bavs_jax.fields.hash_grid import HashGridOptions, make_hash_grid_field, table_roughness
from bavs_jax.models.base import ModelState
from bavs_jax.models.losses import colour_loss
from bavs_jax.models.objectives import make_colour_objective
from bavs_jax.models.ray_field import RayField, RayTraining
from bavs_jax.pixel_table import (
    make_pixel_table,
    sample_pixels,
    training_pixels,
    view_pixel_rays,
)
from bavs_jax.rendering.render import render_rays
from bavs_jax.rendering.samplers import make_occupancy_sampler
from bavs_jax.rendering.sampling import make_march_options
from bavs_jax.training.checkpoints import Checkpoints
from bavs_jax.training.train import (
    average_weight,
    init_train_state,
    make_optimiser,
    make_train_fn,
)
from bavs_jax.uncertainty.curvature import add_jac_sq_sum
from bavs_jax.uncertainty.streaming import make_curvature_fn, table_rays
from tests.oracles_curvature import colour_terms, split_jacobian
from tests.toy_scenes import toy_scene


@pytest.fixture(scope="module")
def trainer():
    """A scene with a model of it, training function and fresh state."""
    scene = toy_scene()
    field = make_hash_grid_field(
        scene.box,
        HashGridOptions(
            num_levels=2,
            coarsest=8,
            finest=16,
            width=16,
            direction_degree=1,
            initial_optical_depth=2.0,  # a fog at first, which shows that something is learnt
        ),
    )
    options = make_march_options(
        scene.box, near=scene.near, far=scene.far, num_steps=32, num_slots=24
    )
    sampler = make_occupancy_sampler(scene.box, options, resolution=16)
    optimiser, schedule = make_optimiser(learning_rate=1e-2, final_share=0.3, num_steps=64)
    model = make_model(scene, field, sampler)
    train = make_train_fn(model, optimiser, schedule, steps_per_call=4)

    def fresh(seed=0):
        return init_train_state(jax.random.key(seed), model, optimiser)

    return scene, model, train, fresh


def make_model(scene, field, sampler, *, capacity=1024, **options):
    """A field with how it is trained; the options are those of `RayTraining`."""
    objective = make_colour_objective(field)
    return RayField(
        field,
        sampler,
        background=scene.background,
        box=scene.box,
        capacity=1024,
        training=RayTraining(objective, num_rays=64, capacity=capacity, **options),
    )


def make_train(trainer, optimiser, schedule, **options):
    """One step of the trainer's model, with other options of `make_model`."""
    scene, model, *_ = trainer
    model = make_model(scene, model.field, model.sampler, **options)
    return make_train_fn(model, optimiser, schedule, steps_per_call=1)


def test_learning_rate_rises_and_decays():
    options = {"learning_rate": 2e-3, "final_share": 0.01, "num_steps": 1000, "warmup": 100}
    _, schedule = make_optimiser(**options)
    rates = [float(schedule(step)) for step in (0, 50, 100, 550, 1000, 2000)]
    np.testing.assert_allclose(rates, [2e-4, 1.1e-3, 2e-3, 2e-4, 2e-5, 2e-5], rtol=1e-5)


def test_optimiser_is_adam_on_gradients_that_are_cut_to_a_norm():
    second_decay, epsilon, longest = 0.8, 0.3, 2.0
    optimiser, schedule = make_optimiser(
        learning_rate=0.5,
        final_share=0.1,
        num_steps=8,
        max_grad_norm=longest,
        second_decay=second_decay,
        epsilon=epsilon,
    )
    params = {"a": jnp.zeros(2), "b": jnp.zeros(1)}
    state, m, v = optimiser.init(params), np.zeros(3), np.zeros(3)
    for step, grad in enumerate(([3.0, -4.0, 12.0], [0.5, 1.0, -1.0])):
        grad = np.array(grad)
        updates, state = optimiser.update({"a": grad[:2], "b": grad[2:]}, state, params)
        grad = grad * min(1.0, longest / np.linalg.norm(grad))  # of norm 13, then 1.5
        m, v = 0.9 * m + 0.1 * grad, second_decay * v + (1 - second_decay) * grad**2
        m_hat, v_hat = m / (1 - 0.9 ** (step + 1)), v / (1 - second_decay ** (step + 1))
        expected = -float(schedule(step)) * m_hat / (np.sqrt(v_hat) + epsilon)
        np.testing.assert_allclose([*updates["a"], *updates["b"]], expected, rtol=1e-5)


@pytest.mark.parametrize("age", [0.05, 0.3, 0.5])
def test_the_mean_of_parameters_has_its_age_at_every_step(age):
    """The slow way: all of them kept, a weight for each; once 0.5, all weigh the same."""
    every, num_calls = 4, 60
    values = np.random.default_rng(0).normal(size=num_calls)
    mean, mean_step = 0.0, 0.0
    for call in range(num_calls):
        step = jnp.int32((call + 1) * every)
        weight = float(average_weight(step, every, age))
        mean += weight * (values[call] - mean)
        mean_step += weight * (int(step) - mean_step)
        # Each weighs as much as its steps do: the integral of s^(1 / age - 2) over them.
        ends = np.arange(call + 2, dtype=np.float64) ** (1 / age - 1)
        expected = np.average(values[: call + 1], weights=np.diff(ends))
        np.testing.assert_allclose(mean, expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(1 - mean_step / (num_calls * every), age, atol=1 / num_calls)


def test_training_renders_the_mean_and_goes_on_from_the_last_parameters(trainer):
    scene, model, _, fresh = trainer
    optimiser, schedule = make_optimiser(learning_rate=1e-2, final_share=0.3, num_steps=64)
    table, mask = make_pixel_table(scene), jnp.ones(scene.num_views, bool)
    close = partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-6)
    last = {}
    for age in (0.0, 0.2):
        train = make_train_fn(model, optimiser, schedule, average_age=age, steps_per_call=4)
        state, path = fresh(), []
        for call in range(3):
            key = jax.random.fold_in(jax.random.key(0), call)
            state, _ = train(key, state, table, mask)
            path.append(jax.tree.map(np.asarray, state.last_params))
        last[age] = path[-1]
        ends = np.arange(4.0) ** (1 / age - 1) if age else np.array([0.0, 0.0, 0.0, 1.0])
        weights = np.diff(ends) / ends[-1]
        mean = jax.tree.map(lambda *x, w=weights: np.tensordot(w, np.stack(x), 1), *path)
        jax.tree.map(close, state.model.params, mean)
    jax.tree.map(close, last[0.0], last[0.2])  # two programs: the last digits differ


def test_the_loss_compares_the_mean_of_a_pixel_s_rays_and_leaves_out_pixels_that_were_cut(trainer):
    """By hand: every ray rendered alone, their mean, and the pixels all of whose rays fitted."""
    scene, model, *_ = trainer
    field, sampler = model.field, model.sampler
    table, mask = make_pixel_table(scene), jnp.ones(scene.num_views, bool)
    params = field.init(jax.random.key(2))

    @jax.jit
    def drawn():
        batch = sample_pixels(
            jax.random.key(1), table, mask, 64, rays_per_pixel=4, background=scene.background
        )
        return batch, sampler.sample(None, {}, sampler.init_state(), batch.rays)[0]

    batch, samples = drawn()
    counts = np.asarray(samples.sample_mask.sum(-1)).reshape(-1, 4)
    cut = next(p for p in range(4, 16) if counts[p, 1] and counts[p, 2])
    capacity = int(counts[:cut].sum() + counts[cut, :2].sum())  # half of that pixel's rays fit
    objective = partial(make_colour_objective(field), capacity=capacity)
    outcome = jax.jit(objective)(None, params, batch, samples)
    render = jax.jit(
        partial(
            render_rays,
            field_fn=partial(field.apply, params),
            background=scene.background,
            capacity=64,
            exact=True,
        )
    )
    whole = jax.tree.map(np.asarray, (batch.rays, samples))
    rays = [jax.tree.map(lambda x, i=i: x[i : i + 1], whole) for i in range(4 * cut)]
    alone = np.stack([np.asarray(render(*one).rgb[0]) for one in rays])
    colours = alone.reshape(cut, 4, 3).mean(1)
    expected = np.square(colours - np.asarray(batch.rgb)[:cut]).mean()
    assert not outcome.ray_mask[4 * cut + 2] and outcome.ray_mask[4 * cut + 1]
    np.testing.assert_allclose(outcome.loss, expected, rtol=1e-5)
    np.testing.assert_allclose(outcome.rgb[:cut], colours, atol=1e-6)


def test_loss_counts_only_weighted_rays():
    rgb = jnp.array([[1.0, 1, 1], [0.5, 0.5, 0.5]])
    assert colour_loss(rgb, jnp.zeros((2, 3)), jnp.array([0.0, 1.0])) == 0.25
    assert colour_loss(rgb, jnp.zeros((2, 3)), jnp.zeros(2)) == 0.0


def test_training_learns_and_compiles_once_while_views_are_added(trainer):
    scene, _, train, fresh = trainer
    table, state = make_pixel_table(scene), fresh()
    losses = []
    for call in range(30):
        mask = jnp.arange(scene.num_views) < 3 + call // 10
        state, info = train(jax.random.key(call), state, table, mask)
        losses.append(float(info.loss))
        if call == 0:
            traces = train._cache_size()
    assert np.mean(losses[-5:]) < 0.2 * losses[0]
    assert train._cache_size() == traces == 1
    assert int(state.step) == 120


def test_the_penalty_pulls_at_the_field_by_its_weight(trainer):
    scene, model, *_ = trainer
    table, mask = make_pixel_table(scene), jnp.ones(scene.num_views, bool)
    tables = {}
    for weight in (0.0, 3.0):
        train = make_train(trainer, optax.sgd(0.5), lambda step: 0.5, penalty_weight=weight)
        start = init_train_state(jax.random.key(0), model, optax.sgd(0.5))
        before = jax.tree.map(lambda x: 1e3 * x, start.last_params["field"]["encoding"])
        field_params = start.last_params["field"] | {"encoding": before}
        params = start.last_params | {"field": field_params}
        start = start.replace(last_params=params)
        before = jax.tree.map(np.asarray, before)
        after, _ = train(jax.random.key(1), start, table, mask)
        tables[weight] = jax.tree.map(np.asarray, after.model.params["field"]["encoding"])
    for name, entries in before.items():
        # 0.5 times the slope of 3 mean(entries^2)
        expected = -0.5 * 3.0 * 2.0 * entries / entries.size
        assert np.abs(expected).max() > 1e-5
        np.testing.assert_allclose(tables[3.0][name] - tables[0.0][name], expected, atol=1e-7)


def test_roughness_is_the_variation_of_dense_levels_and_counts_by_training_pixels(trainer):
    scene, model, *_ = trainer
    params = model.field.init(jax.random.key(0))
    rng = np.random.default_rng(0)
    tables = {k: rng.normal(size=x.shape) for k, x in params["encoding"].items()}
    expected = 0.0
    for side, table in zip((9, 17), tables.values()):
        assert len(table) == side**3
        grid = table.reshape(side, side, side, 2)
        for axis in range(3):
            near = np.moveaxis(grid, axis, 0)
            expected += np.mean([(near[i + 1] - near[i]) ** 2 for i in range(side - 1)])
    rough = params | {"encoding": jax.tree.map(jnp.asarray, tables)}
    np.testing.assert_allclose(model.field.roughness(rough), expected, rtol=1e-5)
    hashed = table_roughness({"level_0": jnp.ones((16, 2)).at[0].set(9.0)}, (8,))
    assert float(hashed) == 0.0  # a table without neighbours

    start = init_train_state(jax.random.key(0), model, optax.sgd(1.0))
    start = start.replace(last_params=start.last_params | {"field": rough})
    slope = jax.grad(lambda p: model.field.roughness(p))(rough)["encoding"]
    table, moved = make_pixel_table(scene), {}
    for weight in (0.0, 500.0):
        train = make_train(trainer, optax.sgd(1.0), lambda step: 1.0, roughness_weight=weight)
        for num_views in (2, 5):
            mask = jnp.arange(scene.num_views) < num_views
            after, _ = train(jax.random.key(1), jax.tree.map(jnp.copy, start), table, mask)
            moved[weight, num_views] = after.model.params["field"]["encoding"]
    for num_views in (2, 5):
        num_pixels = num_views * np.prod(scene.cameras.sizes[0])
        for name in slope:
            got = moved[500.0, num_views][name] - moved[0.0, num_views][name]
            want = -500.0 / num_pixels * slope[name]
            np.testing.assert_allclose(got, want, atol=2e-6, rtol=1e-3)


@pytest.mark.parametrize(
    "options",
    [{"capacity": 1}, {"capacity": 1, "look_ahead": 1}],
    ids=["not fitted", "not looked at"],
)
def test_rays_that_were_left_out_do_not_count_in_the_loss(trainer, options):
    """With room for all of them they do: see the next test."""
    scene, model, *_ = trainer
    optimiser, schedule = make_optimiser(learning_rate=1e-2, final_share=0.3, num_steps=64)
    train = make_train(trainer, optimiser, schedule, **options)
    start = init_train_state(jax.random.key(0), model, optimiser)
    mask = jnp.ones(scene.num_views, bool)
    _, info = train(jax.random.key(1), start, make_pixel_table(scene), mask)
    assert info.rays == 0 and info.loss <= 0.01


def test_leaving_out_hidden_samples_trains_the_same_with_fewer_of_them(trainer):
    scene, model, *_ = trainer
    thick = make_hash_grid_field(
        scene.box, HashGridOptions(num_levels=1, finest=8, width=16, initial_optical_depth=20.0)
    )
    table, mask = make_pixel_table(scene), jnp.ones(scene.num_views, bool)
    thick_model = make_model(scene, thick, model.sampler)
    start = init_train_state(jax.random.key(0), thick_model, optax.sgd(1.0))
    found = {}
    for look_ahead in (0, 1):
        train = make_train(
            (scene, thick_model),
            optax.sgd(1.0),
            lambda step: 1.0,
            capacity=2048,
            look_ahead=look_ahead,
        )
        state, info = train(jax.random.key(1), jax.tree.map(jnp.copy, start), table, mask)
        found[look_ahead] = state.model.params["field"], info
    (params, info), (wanted, whole) = found[1], found[0]
    assert info.rays == whole.rays == 64 and info.samples < 0.5 * whole.samples
    assert whole.loss > 0.01
    np.testing.assert_allclose(info.loss, whole.loss, rtol=1e-2)
    moved, wanted = (
        jax.tree.map(jnp.subtract, p, start.model.params["field"]) for p in (params, wanted)
    )
    off = optax.global_norm(jax.tree.map(jnp.subtract, moved, wanted))
    assert off < 0.1 * optax.global_norm(wanted)


@pytest.mark.parametrize("look_ahead", [0, 2])
def test_the_places_that_a_step_needs_are_the_least_that_leave_out_no_ray(trainer, look_ahead):
    scene, model, *_ = trainer
    table, mask = make_pixel_table(scene), jnp.arange(scene.num_views) < 4
    thick = make_hash_grid_field(
        scene.box, HashGridOptions(num_levels=1, finest=8, width=16, initial_optical_depth=4.0)
    )
    key, state = jax.random.key(5), make_model(scene, thick, model.sampler).init(jax.random.key(0))

    def rays(capacity):
        options = {"capacity": capacity, "look_ahead": look_ahead}
        step = jax.jit(make_model(scene, thick, model.sampler, **options).loss)
        return int(step(key, state, table, mask)[1].rays)

    whole = make_model(scene, thick, model.sampler, capacity=4096, look_ahead=look_ahead)
    needed = int(jax.jit(whole.places_needed)(key, state, table, mask))
    assert rays(needed) == 64 and rays(needed - 1) < 64
    if look_ahead:  # what is hidden needs no place, once it has been looked at
        alone = make_model(scene, thick, model.sampler, capacity=4096)
        assert needed < int(jax.jit(alone.places_needed)(key, state, table, mask))


def test_training_is_deterministic(trainer):
    scene, _, train, fresh = trainer
    table, mask = make_pixel_table(scene), jnp.arange(scene.num_views) < 4
    results = []
    for _ in range(2):
        state = fresh()
        for call in range(3):
            state, _ = train(jax.random.key(call), state, table, mask)
        results.append(state.model.params)
    jax.tree.map(np.testing.assert_array_equal, *results)


@pytest.mark.slow
def test_streamed_curvature_equals_one_dense_call_for_any_bucket(trainer):
    scene, model, _, fresh = trainer
    table, fresh_state = make_pixel_table(scene), fresh().model
    occupancy = fresh_state.carried
    occupied = jax.random.uniform(jax.random.key(1), occupancy.occupied.shape) < 0.3
    occupancy = occupancy.replace(occupied=occupied)
    params = jax.tree.map(
        lambda x: x + 0.3 * jax.random.normal(jax.random.key(2), x.shape),
        fresh_state.params,
    )
    state = ModelState(params, occupancy)
    grid = DeformationGrid(jnp.asarray(scene.box), 3)
    view_ids, pixel_ids = training_pixels(table, np.arange(scene.num_views) < 2)
    pixels = table_rays(table, view_ids, pixel_ids, "gauss_newton")
    rays = view_pixel_rays(table.cameras, jnp.asarray(view_ids), jnp.asarray(pixel_ids))

    @jax.jit
    def dense():
        zero = jnp.zeros((grid.num_vertices, 3))
        samples = model.sampler.sample(None, {}, occupancy, rays)[0]
        field_fn = partial(model.field.apply, params["field"])
        terms = colour_terms(
            split_jacobian, field_fn, rays, samples, background=jnp.asarray(scene.background)
        )
        return add_jac_sq_sum(zero, terms, grid)

    want = dense()
    assert float(want.max()) > 0
    for buckets, chunk in (((8, 16), 256), ((4,), 999)):
        curvature = make_curvature_fn(model, grid, buckets=buckets, chunk_samples=chunk)
        done = []
        got = curvature(state, **pixels, progress_fn=done.append)
        # Another order of the same float32 sums.
        np.testing.assert_allclose(got[0], want, rtol=1e-4, atol=1e-5 * float(want.max()))
        assert sum(done) == len(view_ids)

    # A sum for each group of rays.
    apart = curvature(state, **pixels, group_ids=2 * view_ids, num_groups=3)
    assert got.shape == (1, *want.shape) and apart.shape == (3, *want.shape)
    assert float(apart[0].max()) > 0 and float(apart[2].max()) > 0 and not apart[1].any()
    np.testing.assert_allclose(apart.sum(0), want, rtol=1e-4, atol=1e-5 * float(want.max()))


def test_checkpoint_round_trip_keeps_the_newest(trainer, tmp_path):
    fresh = trainer[-1]
    checkpoints = Checkpoints(tmp_path / "c")
    assert checkpoints.restore(fresh()) is None
    for number in (1, 2, 5):
        checkpoints.save(number, fresh(number), {"number": number})
    checkpoints.save(5, fresh(7), {"number": 7})  # the same number again replaces it
    state, meta = checkpoints.restore(fresh())
    assert meta == {"number": 7} and not (tmp_path / "c" / "1").exists()
    jax.tree.map(np.testing.assert_array_equal, state, fresh(7))
    checkpoints.close()
