"""The loop of the paper (Fig 2) in steps: `init`, then `fit`, `select` and `update` in turn.

    state = init(train, table, initial_views)
    for number in range(num_rounds):
        _, restart_key, train_key = round_keys(key, number)
        for fitted in fit(train_key, trainer, state.train, state.table, state.is_training_view):
            state = trained(state, fitted)
        choice = select(round_keys(key, number + 1)[0], state, acquisition)
        state, view_ids = update(state, choice, acquisition.source)

The caller loops, and so may measure, save and show progress wherever it likes. All randomness comes
from `key` and the state's counters: a run that is stopped and picked up goes the same way.
"""

import dataclasses
import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from bavs_jax.arrays import Array
from bavs_jax.candidates import Candidates, CandidateSource
from bavs_jax.pixel_table import PixelTable, view_mask
from bavs_jax.policy_inputs import MakeInputs
from bavs_jax.selection.batch import SelectionInfo, acquire
from bavs_jax.selection.context import make_context
from bavs_jax.selection.distances import SURVIVOR_SHARE, Radii
from bavs_jax.selection.policy import Mode, Policy
from bavs_jax.training.fit import Fitted
from bavs_jax.training.train import TrainState
from bavs_jax.uncertainty.model import Acquired


class ActiveState(struct.PyTreeNode):
    """What must be carried from round to round, and inside of one."""

    train: TrainState
    table: PixelTable  # the views' pictures; changes only where new ones are taken
    is_training_view: jax.Array  # [V] bool
    round: jax.Array  # [] int32, 0 while only the initial views are there
    calls: jax.Array  # [] int32, compiled training calls done in this round
    restarts: jax.Array  # [] int32, times that this round began anew since its field was stuck


class Choice(NamedTuple):
    """A batch, and how it was chosen."""

    selected: np.ndarray  # [k] indices of the candidates, in the order of picking
    candidates: Candidates
    selection: SelectionInfo
    seconds: dict[str, float]  # curvature, fit, score, select


@dataclasses.dataclass(frozen=True)
class Acquisition:
    """Who chooses a batch of views, from what, and how many."""

    policy: Policy
    source: CandidateSource  # where candidates come from
    inputs: MakeInputs  # where the policy's numbers come from
    centre: Array  # [3] scene centre, scene units
    batch_size: int  # views chosen at once
    num_rays: int  # R of Eq 13, the training rays of round 0
    radii: Radii | None = None  # of the max-min distance filter; None: by `survivor_share`
    survivor_share: float = SURVIVOR_SHARE  # of the candidates, which the filter leaves
    mode: Mode | None = None  # None: the policy's own
    label: str = ""  # of the run, for progress


def init(train: TrainState, table: PixelTable, initial_views) -> ActiveState:
    """A state before its first training call, with the initial views (given as ids) in use."""
    return ActiveState(
        train=train,
        table=table,
        is_training_view=jnp.asarray(view_mask(table, initial_views)),
        round=jnp.int32(0),
        calls=jnp.int32(0),
        restarts=jnp.int32(0),
    )


def select(key, state: ActiveState, acquisition: Acquisition) -> Choice:
    """Chooses the next batch of views by what the trained field knows (Fig 5, Eq 15).

    Args:
      key: from `round_keys`.
      state: whose round is trained to its end.
      acquisition: who chooses, and from what.
    """
    propose_key, input_key, policy_key = jax.random.split(key, 3)
    candidates = acquisition.source.propose(propose_key, state.table, state.is_training_view)
    acquired = Acquired(
        state.train,
        state.table,
        state.is_training_view,
        acquisition.num_rays,
        candidates=candidates.cameras,
        label=acquisition.label,
    )
    start = time.perf_counter()
    inputs = acquisition.inputs(acquisition.policy, input_key, acquired, candidates)
    context = make_context(
        candidates.cameras.positions,
        view_ids=candidates.view_ids,
        mask=candidates.mask,
        training_positions=state.table.cameras.positions,
        is_training_view=state.is_training_view,
        centre=acquisition.centre,
        **inputs.fields,
    )
    selected, selection = acquire(
        acquisition.policy,
        policy_key,
        context,
        acquisition.batch_size,
        radii=acquisition.radii,
        survivor_share=acquisition.survivor_share,
        mode=acquisition.mode,
    )
    elapsed = time.perf_counter() - start
    seconds = {**inputs.seconds, "select": elapsed - sum(inputs.seconds.values())}
    return Choice(selected, candidates, selection, seconds)


def update(
    state: ActiveState, choice: Choice, source: CandidateSource
) -> tuple[ActiveState, np.ndarray]:
    """Opens the next round with the chosen views: their photos join what is trained on.

    Returns:
      The state, whose field is still that of the round before, and the rows of the pixel table
      that the chosen views have, [k] in the order of picking.
    """
    table, view_ids = source.acquire(
        state.table, state.is_training_view, choice.candidates, choice.selected
    )
    state = state.replace(
        table=table,
        is_training_view=state.is_training_view.at[view_ids].set(True),
        round=state.round + 1,
        calls=jnp.int32(0),
        restarts=jnp.int32(0),
    )
    return state, np.asarray(view_ids)


def trained(state: ActiveState, fitted: Fitted) -> ActiveState:
    """The state after one more compiled training call of `fit`."""
    return state.replace(
        train=fitted.train, calls=jnp.int32(fitted.calls), restarts=jnp.int32(fitted.restarts)
    )


def round_keys(key, number: int):
    """Keys of a round for choosing, restarting and training; round 0 is trained by the last."""
    return jax.random.split(jax.random.fold_in(key, number), 3)
