"""A finished run of `active_selection`, taken up again: its field, its views and its posterior."""

from __future__ import annotations

import json
import pathlib
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from ml_collections import ConfigDict

from bavs_jax.active import ActiveState, init_active_state
from bavs_jax.selection.policies import get_policy
from bavs_jax.training.checkpoints import Checkpoints
from bavs_jax.uncertainty.channel import vertex_variance
from bavs_jax.uncertainty.model import LaplaceOptions, Situation, Toolbox
from bavs_jax.uncertainty.models.laplace import training_curvature
from bavs_jax.uncertainty.posterior import posterior_precision
from experiments import runtime
from experiments.build import Problem, build_problem, run_key
from experiments.build_scene import initial_views, load_config_scene
from experiments.configs import base
from experiments.errors import WorkdirError
from experiments.files import write_arrays
from experiments.progress import track
from experiments.runner import saved_part, whole_state


class TrainedRun(NamedTuple):
    """The last round of one policy and seed."""

    config: ConfigDict
    problem: Problem
    toolbox: Toolbox
    state: ActiveState
    folder: pathlib.Path  # WORKDIR/<policy>/seed_<n>
    policy: str
    seed: int

    @property
    def label(self) -> str:
        return f"{self.policy} seed {self.seed}"

    @property
    def training_views(self) -> np.ndarray:
        """Rows of the pixel table."""
        return np.flatnonzero(np.asarray(self.state.is_training_view))

    @property
    def num_rays(self) -> int:
        """R of Eq 13: the training rays of round 0."""
        scene = self.problem.scene
        initial = initial_views(scene, self.seed, self.config.num_initial)
        return int(np.diff(scene.offsets)[initial].sum())

    def truth(self, view_id: int) -> np.ndarray:
        """True colours of a view of the pixel table, [H, W, 3] in [0, 1]."""
        table = self.state.table
        rows = slice(int(table.offsets[view_id]), int(table.offsets[view_id + 1]))
        width, height = (int(n) for n in table.cameras.sizes[view_id])
        return np.asarray(table.pixels[rows], np.float64).reshape(height, width, 3) / 255.0

    def pixel_mask(self, view_id: int) -> np.ndarray:
        """Which pixels of a view count, [H, W] bool."""
        table = self.state.table
        width, height = (int(n) for n in table.cameras.sizes[view_id])
        if len(table.pixel_mask) == 1:
            return np.ones((height, width), bool)
        rows = slice(int(table.offsets[view_id]), int(table.offsets[view_id + 1]))
        return np.asarray(table.pixel_mask[rows]).reshape(height, width)


def read_config(path: pathlib.Path) -> ConfigDict:
    """The config that a run wrote beside its results.

    Raises:
      WorkdirError: there is none, or it has options that this version does not know.
    """
    if not path.is_file():
        raise WorkdirError(
            f"{path}: is missing; give --workdir of a finished run of experiments.active_selection"
        )
    config = base.get_config()
    config.lock()
    try:
        config.update(_with_tuples(json.loads(path.read_text(encoding="utf-8"))))
    except (KeyError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise WorkdirError(
            f"{path}: cannot be read ({reason}); run experiments.active_selection again"
        ) from error
    return config


def load_run(workdir: pathlib.Path, policy: str = "", seed: int | None = None) -> TrainedRun:
    """The last checkpoint of a finished run.

    Args:
      workdir: of `active_selection`.
      policy, seed: which run; by default the first of the config.

    Raises:
      WorkdirError: no such run, or one that has not been finished.
    """
    config = read_config(workdir / "config.json")
    policy = policy or config.policies[0]
    seed = config.seeds[0] if seed is None else seed
    folder = workdir / policy / f"seed_{seed}"
    _check_finished(folder, workdir)
    scene = load_config_scene(config, cache_dir=str(runtime.cache_folder() / "scenes"))
    problem = build_problem(config, scene, get_policy(policy).field_kind)
    initial = initial_views(scene, seed, config.num_initial)
    fresh = init_active_state(problem.init_train(run_key(seed)), problem.table, initial)
    checkpoints = Checkpoints(folder / "checkpoints")
    saved, _ = checkpoints.restore(saved_part(problem, fresh))
    checkpoints.close()
    state, toolbox = whole_state(problem, saved), problem.make_toolbox(track)
    return TrainedRun(config, problem, toolbox, state, folder, policy, seed)


def run_curvature(run: TrainedRun) -> jax.Array:
    """`jac_sq_sum` [G, 3] of the training views, kept in the run's folder once it is made."""
    path = run.folder / "curvature.npz"
    if path.exists():
        with np.load(path) as data:
            return jnp.asarray(data["jac_sq_sum"])
    state = run.state
    situation = Situation(
        *(state.train, state.table, state.is_training_view, run.num_rays), label=run.label
    )
    key = jax.random.fold_in(run_key(run.seed), 2**31 - 2)
    weighting = run.toolbox.laplace.weighting
    jac_sq_sum = training_curvature(key, run.toolbox, situation, weighting)
    write_arrays(path, jac_sq_sum=np.asarray(jac_sq_sum))
    return jac_sq_sum


def run_variance(run: TrainedRun) -> jax.Array:
    """The vertex variance [G] that the run's uncertainty channel interpolates."""
    return vertex_variance(
        run_curvature(run), **_posterior_options(run), variant=run.toolbox.laplace.variant
    )


def run_precision(run: TrainedRun) -> jax.Array:
    """H of the run's posterior, [G, 3] (Eq 13)."""
    return posterior_precision(run_curvature(run), **_posterior_options(run))


def _posterior_options(run: TrainedRun) -> dict[str, Any]:
    options: LaplaceOptions = run.toolbox.laplace
    return {
        "num_rays": run.num_rays,
        "prior_weight": options.prior_weight,
        "weighting": options.weighting,
    }


def _check_finished(folder: pathlib.Path, workdir: pathlib.Path) -> None:
    result = folder / "result.json"
    if not result.is_file():
        known = sorted(str(p.parent.relative_to(workdir)) for p in workdir.glob("*/*/result.json"))
        raise WorkdirError(
            f"{result}: is missing; --policy and --seed must name one of the finished runs: "
            f"{', '.join(known) or 'there are none'}"
        )
    if not json.loads(result.read_text(encoding="utf-8"))["completed"]:
        raise WorkdirError(
            f"{result}: completed: is false; start experiments.active_selection again to finish it"
        )


def _with_tuples(value):
    """JSON's lists as the tuples that configs hold."""
    if isinstance(value, dict):
        return {name: _with_tuples(x) for name, x in value.items()}
    return tuple(_with_tuples(x) for x in value) if isinstance(value, list) else value
