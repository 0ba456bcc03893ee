"""The loop of the paper (Fig 2): train, find out where the field is uncertain, choose views.

`step(key, state) -> (state, info)` is one round. All of its randomness comes from `key` and the
state's counters, so a run that is stopped and picked up goes the same way.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from bavs_jax.candidates import Candidates, CandidateSource
from bavs_jax.selection.batch import SelectionInfo, acquire
from bavs_jax.selection.context import make_context
from bavs_jax.selection.policy import Policy
from bavs_jax.training.batches import PixelTable, view_mask
from bavs_jax.training.fit import fit
from bavs_jax.training.train import TrainState
from bavs_jax.uncertainty.model import Situation


@struct.dataclass
class ActiveState:
    """What must be carried from round to round, and inside of one."""

    train: TrainState
    table: PixelTable  # the views' pictures; changes only where new ones are taken
    is_training_view: jax.Array  # [V] bool
    round: jax.Array  # [] int32, 0 while only the initial views are there
    calls: jax.Array  # [] int32, compiled training calls done in this round
    restarts: jax.Array  # [] int32, times that this round began anew since its field was stuck


class Choice(NamedTuple):
    """How a batch was chosen; only reports."""

    view_ids: np.ndarray  # [k] rows of the pixel table, in the order of picking
    selected: np.ndarray  # [k] the same as indices of the candidates
    candidates: Candidates
    selection: SelectionInfo
    seconds: dict[str, float]  # curvature, fit, score, select


class RoundInfo(NamedTuple):
    """What one round reports."""

    round: int
    choice: Choice | None  # None in round 0, and where a round was picked up half way
    train_seconds: float


class Stages(NamedTuple):
    """The parts of a round as functions, put together by the caller.

    `train_call(key, train_state, table, is_training_view) -> (train_state, TrainInfo)`
    `init(key) -> train_state`, fresh, for a field that is stuck
    `restart(key, train_state) -> train_state` at the start of each round after the first: a fresh
      optimiser, and fresh parameters too where each round trains from scratch.
    `sources(policy, key, situation, candidates) -> Sources` (see `sources.py`)
    """

    train_call: Callable
    init: Callable
    restart: Callable
    sources: Callable


def init_active_state(train: TrainState, table: PixelTable, initial_views) -> ActiveState:
    """A state before its first training call, with the initial views (given as ids) in use."""
    return ActiveState(
        train=train,
        table=table,
        is_training_view=jnp.asarray(view_mask(table, initial_views)),
        round=jnp.int32(0),
        calls=jnp.int32(0),
        restarts=jnp.int32(0),
    )


def make_active_step(
    policy: Policy,
    stages: Stages,
    source: CandidateSource,
    *,
    centre,
    batch_size: int,
    calls_per_round: int,
    check_call: int | None = None,
    num_rays: int,
    radii=None,
    mode: str | None = None,
    label: str = "",
) -> Callable:
    """Makes `step(key, state, on_choice=None, on_call=None) -> (state, RoundInfo)`.

    A step finishes the round that the state is in; if that round is complete, it first chooses
    the next batch of views and opens a new round. `on_choice(state, choice)` and
    `on_call(state, train_info)` are called as things happen, for reports and checkpoints.

    Args:
      policy: who chooses.
      stages: how to train, and where the policy's numbers come from.
      source: where candidates come from.
      centre: [3] scene centre, scene units.
      batch_size: views chosen at once.
      calls_per_round: compiled training calls of a round.
      check_call: see `fit`.
      num_rays: R of Eq 13, the training rays of round 0.
      radii: of the max-min distance filter; by default from the cameras.
      mode: "top_k" or "greedy"; by default the policy's own.
      label: of the run, for progress.

    A step raises FloatingPointError if the loss is not finite, before the state is handed on.
    """

    def choose(key, state):
        propose_key, source_key, policy_key = jax.random.split(key, 3)
        candidates = source.propose(propose_key, state.table, state.is_training_view)
        situation = Situation(
            state.train,
            state.table,
            state.is_training_view,
            num_rays,
            candidates=candidates.cameras,
            label=label,
        )
        start = time.perf_counter()
        sources = stages.sources(policy, source_key, situation, candidates)
        context = make_context(
            candidates.cameras.positions,
            view_ids=candidates.view_ids,
            mask=candidates.mask,
            training_positions=state.table.cameras.positions,
            is_training_view=state.is_training_view,
            centre=centre,
            **sources.fields,
        )
        selected, selection = acquire(
            policy, policy_key, context, batch_size, radii=radii, mode=mode
        )
        elapsed = time.perf_counter() - start
        seconds = {**sources.seconds, "select": elapsed - sum(sources.seconds.values())}
        table, view_ids = source.acquire(state.table, state.is_training_view, candidates, selected)
        state = state.replace(
            table=table,
            is_training_view=state.is_training_view.at[view_ids].set(True),
            round=state.round + 1,
            calls=jnp.int32(0),
            restarts=jnp.int32(0),
        )
        return state, Choice(view_ids, selected, candidates, selection, seconds)

    def step(key, state, on_choice=None, on_call=None):
        choice = None
        if int(state.calls) >= calls_per_round:
            choose_key, restart_key, _ = round_keys(key, int(state.round) + 1)
            state, choice = choose(choose_key, state)
            state = state.replace(train=stages.restart(restart_key, state.train))
            if on_choice is not None:
                on_choice(state, choice)

        _, _, train_key = round_keys(key, int(state.round))
        start = time.perf_counter()
        for fitted in fit(
            train_key,
            stages.init,
            stages.train_call,
            state.train,
            state.table,
            state.is_training_view,
            num_calls=calls_per_round,
            check_call=check_call,
            calls=int(state.calls),
            restarts=int(state.restarts),
            label=f"round {int(state.round)}",
        ):
            state = state.replace(
                train=fitted.train,
                calls=jnp.int32(fitted.calls),
                restarts=jnp.int32(fitted.restarts),
            )
            if on_call is not None:
                on_call(state, fitted.info)
        jax.block_until_ready(state.train.step)
        return state, RoundInfo(int(state.round), choice, time.perf_counter() - start)

    return step


def round_keys(key, number: int):
    """Keys of a round for choosing, restarting and training; round 0 is trained by the last."""
    return jax.random.split(jax.random.fold_in(key, number), 3)
