"""A field that a run has trained, taken up from its folder or trained now, and its posterior."""

from __future__ import annotations

import json
import pathlib
from typing import NamedTuple

import jax
import numpy as np
from ml_collections import ConfigDict

from bavs_jax.active import ActiveState
from bavs_jax.pixel_table import num_training_pixels
from bavs_jax.selection.policies import POLICIES, get_policy
from bavs_jax.uncertainty.model import RECONSTRUCTION, Acquired, SceneSetup
from bavs_jax.uncertainty.models.laplace import laplace_variance, training_curvature
from bavs_jax.uncertainty.posterior import posterior_precision
from experiments.build import Problem, stream_key
from experiments.build_model import KINDS
from experiments.configs import base
from experiments.runner import Run
from experiments.runtime import WorkdirError
from experiments.schema import check_config

FIRST_ROUND = "initial"  # folder of round 0, which all policies of a seed share


class TrainedRun(NamedTuple):
    """The last checkpoint of one run of `experiments.active_selection`."""

    config: ConfigDict
    problem: Problem
    state: ActiveState
    num_rays: int  # R of Eq 13: the training rays of round 0
    folder: pathlib.Path  # WORKDIR/<policy>/seed_<n>
    policy: str  # or the name of a folder of first rounds
    seed: int
    completed: bool  # whether the run has come to its end

    @property
    def label(self) -> str:
        return f"{self.policy} seed {self.seed}"

    @property
    def setup(self) -> SceneSetup:
        return self.problem.setup

    @property
    def acquired(self) -> Acquired:
        state = self.state
        known = (state.train, state.table, state.is_training_view, self.num_rays)
        return Acquired(*known, label=self.label)

    @property
    def training_views(self) -> np.ndarray:
        """Rows of the pixel table."""
        return np.flatnonzero(np.asarray(self.state.is_training_view))

    def truth(self, view_id: int) -> np.ndarray:
        """True colours of a view of the pixel table, [H, W, 3] in [0, 1]."""
        return self._of_view(self.state.table.pixels, view_id) / 255.0

    def pixel_mask(self, view_id: int) -> np.ndarray:
        """Which pixels of a view count, [H, W] bool."""
        mask = self.state.table.pixel_mask
        if len(mask) == 1:  # no view has a mask
            width, height = self.state.table.cameras.sizes[view_id]
            return np.ones((int(height), int(width)), bool)
        return self._of_view(mask, view_id)

    def _of_view(self, values, view_id: int) -> np.ndarray:
        table = self.state.table
        start, stop = (int(n) for n in table.offsets[view_id : view_id + 2])
        width, height = (int(n) for n in table.cameras.sizes[view_id])
        return np.asarray(values[start:stop]).reshape(height, width, *values.shape[1:])


# --- which run ---


def saved_config(workdir: pathlib.Path) -> ConfigDict:
    """The config that a run left in its folder; options that it did not know have their default.

    Raises:
      WorkdirError: there is none, or one that this version cannot read.
    """
    path = workdir / "config.json"
    config = base.get_config()
    config.lock()
    try:
        saved = json.loads(path.read_text(encoding="utf-8"))
        if "field" in saved:  # the group's name before
            saved["hash_grid"] = saved.pop("field")
        config.update(_with_tuples(saved))
    except FileNotFoundError as error:
        raise WorkdirError(
            f"{path}: does not exist: give the --workdir of a run, or a --config to start one"
        ) from error
    except (AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise WorkdirError(f"{path}: cannot be read ({reason}): start the run again") from error
    return check_config(config, name=str(path))


def find_runs(workdir: pathlib.Path) -> list[tuple[str, int]]:
    """(policy, seed) of the runs that have a checkpoint, first rounds among them."""
    known = []
    for folder in workdir.glob("*/seed_*/checkpoints"):
        name, seed = folder.parent.parent.name, folder.parent.name.removeprefix("seed_")
        has_any = any(path.name.isdigit() for path in folder.iterdir())
        if has_any and seed.isdigit() and (name in POLICIES or _first_round_kind(name)):
            known.append((name, int(seed)))
    return sorted(known)


def choose_runs(workdir: pathlib.Path, config, policy: str, seed: int | None) -> list:
    """(policy, seed) of the runs that are asked for.

    Args:
      workdir: as given to `experiments.active_selection`.
      config: of the folder.
      policy: whose runs, or a folder of first rounds. Empty: the config's first policy, or round 0
        where that has not been started.
      seed: which of them; None: all.

    Raises:
      WorkdirError: there is no such run, or it has no checkpoint yet.
    """
    known = find_runs(workdir)
    first = config.policies[0]
    policy = policy or (first if first in {name for name, _ in known} else FIRST_ROUND)
    chosen = [(p, s) for p, s in known if p == policy and seed in (None, s)]
    if not chosen:
        wanted = workdir / policy / f"seed_{'*' if seed is None else seed}"
        words = ", ".join(f"--policy={p} --seed={s}" for p, s in known) or "none yet"
        raise WorkdirError(f"{wanted}: holds no checkpoint; runs that do: {words}")
    return chosen


def field_kind(policy: str) -> str:
    """Kind of field that a policy's runs, or a folder of first rounds, train."""
    return _first_round_kind(policy) or get_policy(policy).field_kind


# --- its field ---


def load_run(config, problem: Problem, workdir: pathlib.Path, policy: str, seed: int) -> TrainedRun:
    """Takes up a run, finished or not, where its last checkpoint is.

    Args:
      config: of the folder.
      problem: built from it, for fields of `field_kind(policy)`.
      workdir: as given to `experiments.active_selection`.
      policy, seed: one of `find_runs`.
    """
    run = Run(config, problem, workdir, None if _first_round_kind(policy) else policy, seed)
    state = run.state()
    run.checkpoints.close()
    last_round = config.num_rounds if run.policy else 0
    return TrainedRun(
        config=config,
        problem=problem,
        state=state,
        num_rays=int(num_training_pixels(problem.scene, run.initial).sum()),
        folder=run.folder,
        policy=policy,
        seed=seed,
        completed=int(state.round) == last_round and int(state.calls) >= problem.trainer.num_calls,
    )


def train_run(
    config, problem: Problem, workdir: pathlib.Path, policy: str, seed: int, command: str = ""
) -> TrainedRun:
    """Brings a run to its end from wherever it is, and takes it up there.

    Args:
      config, problem, workdir, seed: see `load_run`.
      policy: whose run; `FIRST_ROUND` for round 0 alone.
      command: kept in its result file.
    """
    first = Run(config, problem, workdir, None, seed, command)
    first.finish()
    if not _first_round_kind(policy):
        Run(config, problem, workdir, policy, seed, command).finish(first)
    return load_run(config, problem, workdir, policy, seed)


# --- its posterior ---


def run_curvature(run: TrainedRun) -> jax.Array:
    """`jac_sq_sum` [G, 3] of the training rays, with progress."""
    # The key of the run's own pictures, so that the same uncertainty comes out.
    key = stream_key(run.seed, "pictures")
    setup = run.setup
    return training_curvature(key, setup, run.acquired, setup.laplace.weighting)


def run_variance(run: TrainedRun, jac_sq_sum: jax.Array) -> jax.Array:
    """The vertex variance [G] that the run's uncertainty channel interpolates."""
    return laplace_variance(jac_sq_sum, run.num_rays, run.setup.laplace)


def run_precision(run: TrainedRun, jac_sq_sum: jax.Array) -> jax.Array:
    """H of the run's posterior, [G, 3] (Eq 13)."""
    options = run.setup.laplace
    return posterior_precision(
        jac_sq_sum,
        num_rays=run.num_rays,
        prior_weight=options.prior_weight,
        weighting=options.weighting,
    )


def _first_round_kind(name: str) -> str | None:
    """Kind of field that a folder of first rounds holds; None for any other folder."""
    if name == FIRST_ROUND:
        return RECONSTRUCTION
    kind = name.removeprefix(f"{FIRST_ROUND}_")
    return kind if kind != name and kind in KINDS else None


def _with_tuples(values):
    """JSON's lists as the tuples that they were."""
    if isinstance(values, dict):
        return {name: _with_tuples(value) for name, value in values.items()}
    return tuple(map(_with_tuples, values)) if isinstance(values, list) else values
