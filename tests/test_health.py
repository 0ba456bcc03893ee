"""Fields that learn nothing begin anew, a stated number of times, and are never told as results."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax import active
from bavs_jax.models.base import ModelState
from bavs_jax.pixel_table import make_pixel_table
from bavs_jax.training.fit import (
    MAX_RESTARTS,
    Trainer,
    check_call,
    fit,
    is_stuck,
    single_colour_error,
)
from bavs_jax.training.train import TrainInfo, TrainState
from bavs_jax.uncertainty.model import Acquired
from experiments.build import Problem
from experiments.build_model import train_aside
from experiments.reporting.results import Run
from experiments.reporting.run_tables import final_table
from experiments.runtime import track
from tests.toy_rounds import run_round
from tests.toy_runs import toy_config
from tests.toy_scenes import toy_scene

CALLS, CHECK = 6, 3


def report(loss, thinned=0.0):
    values = {"loss": loss, "thinned": thinned, "rays": 64.0, "samples": 64.0}
    return TrainInfo(**{k: jnp.float32(v) for k, v in values.items()}, learning_rate=jnp.float32(1))


def test_one_colour_for_all_pixels_is_what_a_field_must_beat():
    scene = toy_scene(num_views=4, num_test=1)
    table = make_pixel_table(scene)
    used = np.array([True, False, True, False])
    colours = np.concatenate([scene.pixels[scene.view_slice(v)] for v in (0, 2)]) / 255.0
    expected = np.square(colours - colours.mean(0)).mean()
    np.testing.assert_allclose(single_colour_error(table, used), expected, rtol=1e-6)
    mask = np.zeros(len(scene.pixels), bool)
    mask[:5] = True
    masked = table.replace(pixel_mask=jnp.asarray(mask))
    expected = (scene.pixels[:5] / 255.0).var(axis=0).mean()
    np.testing.assert_allclose(single_colour_error(masked, used), expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("loss", "thinned", "stuck"),
    [(0.02, 0.0, False), (0.05, 0.0, True), (0.001, 0.95, True), (0.001, 0.5, False)],
)
def test_what_counts_as_stuck(loss, thinned, stuck):
    assert is_stuck(report(loss, thinned), 0.04) is stuck


def test_short_rounds_are_not_looked_at():
    assert check_call(200, 16) == 20  # a tenth of 3200 steps
    assert check_call(100, 16) == 16  # 256 steps
    assert check_call(31, 16) is None


def make_calls(losses):
    """`init` and `call` that only report, `losses[a]` for attempt a, and which keys they got."""
    inits, keys = [], []

    def init(key):
        inits.append(jax.random.key_data(key).tolist())
        return fresh(len(inits))

    def call(key, train, table, is_training_view):
        keys.append(jax.random.key_data(key).tolist())
        return train.replace(step=train.step + 1), report(losses[int(train.model.params)])

    return init, call, inits, keys


def make_problem(losses):
    """A problem whose training calls only report."""
    init, call, inits, keys = make_calls(losses)
    return SimpleNamespace(trainer=Trainer(init, call, CALLS, CHECK)), inits, keys


def fresh(attempt):
    return TrainState(jnp.int32(0), ModelState(jnp.int32(attempt), ()), jnp.int32(attempt), ())


def run(losses):
    scene = toy_scene(num_views=4, num_test=1)
    problem, inits, keys = make_problem(losses)
    state = active.init(fresh(0), make_pixel_table(scene), [0, 1])
    seen = []
    # A round that is not trained yet is opened by no choice.
    state, *_ = run_round(problem, None, jax.random.key(0), state, lambda s, _: seen.append(s))
    return state, inits, keys, seen


def test_a_stuck_field_begins_anew_with_another_key():
    state, inits, keys, seen = run([1.0, 0.001])
    assert (int(state.calls), int(state.restarts), int(state.train.model.params)) == (CALLS, 1, 1)
    assert int(state.train.step) == CALLS and len(keys) == CHECK + CALLS
    assert len(inits) == 1 and len({tuple(k) for k in keys}) == len(keys)
    assert [int(s.restarts) for s in seen] == [0] * (CHECK - 1) + [1] * (CALLS + 1)


def test_a_field_that_learns_is_left_alone():
    state, inits, keys, _ = run([0.001])
    assert int(state.restarts) == 0 and not inits and len(keys) == CALLS


def test_restarts_are_bounded():
    state, inits, keys, _ = run([1.0] * 9)
    assert int(state.restarts) == MAX_RESTARTS == len(inits)
    assert len(keys) == MAX_RESTARTS * CHECK + CALLS
    assert len({tuple(k) for k in [*keys, *inits]}) == len(keys) + len(inits)


def test_a_round_that_was_restarted_goes_on_from_a_checkpoint_alike():
    _, _, whole, seen = run([1.0, 0.001])
    half = seen[CHECK + 1]  # two calls into the second attempt
    problem, inits, rest = make_problem([1.0, 0.001])
    state, *_ = run_round(problem, None, jax.random.key(0), half)
    assert not inits and rest == whole[-len(rest) :] and len(rest) == CALLS - 2
    assert int(state.restarts) == 1


class KilledError(Exception):
    pass


LONG = {"train__num_steps": 1024, "train__steps_per_call": 128}
LONG_CALLS = (8, 2)  # so many calls, looked at after so many


def test_a_config_says_how_many_calls_there_are_and_when_a_field_is_looked_at():
    scene = toy_scene(num_views=4, num_test=1)
    for options, calls in ((LONG, LONG_CALLS), ({"train__num_steps": 9}, (3, None))):
        problem = Problem(toy_config(**options), scene)
        for trainer in problem.trainers.values():
            assert (trainer.num_calls, trainer.check_call) == calls


def test_a_field_trained_aside_begins_anew_and_says_so(capsys):
    scene = toy_scene(num_views=4, num_test=1)
    init, call, inits, keys = make_calls([9.0, 1.0, 0.001])  # the first `init` is no restart
    is_training = np.array([True, True, False, False, False])
    acquired = Acquired(fresh(0), make_pixel_table(scene), is_training, 0, label="toy")
    trainer = Trainer(init, call, *LONG_CALLS)
    state = train_aside(toy_config(**LONG), trainer, jax.random.key(0), acquired, "variance", track)
    assert int(state.model.params) == 2 and int(state.step) == 8 and len(keys) == 2 + 8
    assert len({tuple(key) for key in keys}) == 10 and len(inits) == 2
    err = capsys.readouterr().err
    assert "toy: train variance: the field is stuck" in err and "another key (1)" in err


def test_training_that_is_picked_up_goes_the_same_way_and_a_bad_loss_ends_it():
    scene = toy_scene(num_views=4, num_test=1)
    where = (make_pixel_table(scene), np.array([True, True, False, False]))

    def trained(losses, **begin):
        init, call, _, keys = make_calls(losses)
        parts = fit(
            jax.random.key(3),
            Trainer(init, call, CALLS, CHECK),
            fresh(begin.get("restarts", 0)),
            *where,
            label="toy",
            **begin,
        )
        return [*parts], keys

    whole, keys = trained([1.0, 0.001])
    assert [(f.calls, f.restarts) for f in whole[CHECK - 1 :]] == [(n, 1) for n in range(CALLS + 1)]
    _, rest = trained([1.0, 0.001], calls=2, restarts=1)
    assert rest == keys[-len(rest) :] and len(rest) == CALLS - 2
    with pytest.raises(FloatingPointError, match="toy, training call 0: the loss is nan; try"):
        trained([float("nan")])


def test_a_table_marks_policies_with_a_stuck_field(tmp_path):
    def result(policy, seed, **more):
        rounds = [{"num_views": 4, "psnr": 20.0, "stuck": False}]
        rounds.append({"num_views": 8, "psnr": 25.0, "stuck": False, **more})
        return Run(policy, seed, True, rounds, {}, tmp_path)

    runs = [result("bavs", 0), result("bavs", 1, stuck=True), result("random", 0)]
    table = final_table(runs, ["bavs", "random"])
    assert [row[1].text for row in table.rows] == ["2*", "1"]
    (note,) = [why for why in table.reasons if "stuck" in why]
    assert note.startswith("bavs: a field of seed 1 is stuck in fog")
