"""The rounds of a run in memory: the loop of `experiments/runner.py` without its files."""

import io

import jax

from bavs_jax import active
from bavs_jax.training.fit import fit
from experiments.build import initial_views
from experiments.runtime import track


def silent(total, label, unit):
    """`track` onto a stream that nobody reads."""
    return track(total, label, unit, stream=io.StringIO())


def start(problem, policy, seed=0):
    """A state with two views before its first training call, and how the policy chooses."""
    initial = initial_views(problem.scene, seed, 2)
    train = problem.trainer.init(jax.random.key(seed))
    state = active.init(train, problem.table, initial)
    return state, problem.acquisition(policy, initial, policy)


def run_round(problem, acquisition, key, state, on_call=None):
    """Trains the round that the state is in to its end, after opening it if the last one is done.

    Args:
      problem: whose `trainer` and `restart` are used.
      acquisition: who chooses.
      key: of the whole run.
      state: of any point of a round; it is given away.
      on_call: called with the state and the `TrainInfo` after each compiled training call.

    Returns:
      The state; the choice and the ids of its views, both None where the round was open already.
    """
    choice = view_ids = None
    if int(state.calls) >= problem.trainer.num_calls:
        choose_key, restart_key, _ = active.round_keys(key, int(state.round) + 1)
        choice = active.select(choose_key, state, acquisition)
        state, view_ids = active.update(state, choice, acquisition.source)
        state = state.replace(train=problem.restart(restart_key, state.train))
    _, _, train_key = active.round_keys(key, int(state.round))
    for fitted in fit(
        train_key,
        problem.trainer,
        state.train,
        state.table,
        state.is_training_view,
        calls=int(state.calls),
        restarts=int(state.restarts),
        label=f"round {int(state.round)}",
    ):
        state = active.trained(state, fitted)
        if on_call is not None:
            on_call(state, fitted.info)
    return state, choice, view_ids
