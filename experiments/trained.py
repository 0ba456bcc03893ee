"""A field that a run has trained, taken up from its folder, with its posterior."""

from __future__ import annotations

import json
import pathlib
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from ml_collections import ConfigDict

from bavs_jax.scenes.poses import scene_points, user_units
from bavs_jax.selection.policies import POLICIES, get_policy
from bavs_jax.uncertainty.model import RECONSTRUCTION, Situation
from bavs_jax.uncertainty.points import make_point_fn
from experiments.build import Problem, build_problem, run_key
from experiments.build_scene import load_config_scene
from experiments.build_trainer import KINDS
from experiments.configs import base
from experiments.errors import WorkdirError
from experiments.runner import Run


class Trained(NamedTuple):
    """The last checkpoint of a run of `experiments.active_selection`."""

    config: ConfigDict
    problem: Problem
    situation: Situation
    folder: pathlib.Path  # of the run, `<workdir>/<policy>/seed_<n>`
    policy: str  # or the name of a folder of first rounds
    seed: int
    round: int
    completed: bool  # whether the run has come to its end


def saved_config(workdir: pathlib.Path) -> ConfigDict:
    """The config that a run left in its folder; options that it did not know have their default.

    Raises:
      WorkdirError: there is none, or it belongs to another script.
    """
    path = workdir / "config.json"
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise WorkdirError(
            f"{path}: does not exist: give the --workdir of a run of experiments.active_selection"
        ) from error
    except ValueError as error:
        raise WorkdirError(f"{path}: is no JSON ({error}): start the run again") from error
    config = base.get_config()
    config.update(_with_tuples(values))
    return config


def load_trained(
    workdir: pathlib.Path, *, policy: str = "", seed: int | None = None, data_dir: str = "", cache
) -> Trained:
    """Takes up a run, finished or not, where its last checkpoint is.

    Args:
      workdir: as given to `experiments.active_selection`.
      policy: whose run; or a folder of first rounds, such as `initial`. Empty: the config's first.
      seed: which run of it; None: the config's first.
      data_dir: where the scenes are now, if they have moved.
      cache: folder that keeps scenes for the next time, or None.

    Raises:
      WorkdirError: there is no such run, or it has no checkpoint yet.
      SceneError: the scene's files cannot be used.
    """
    config = saved_config(workdir)
    policy = policy or config.policies[0]
    seed = config.seeds[0] if seed is None else seed
    folder = workdir / policy / f"seed_{seed}"
    runs = _runs_with_checkpoint(workdir)
    if (policy, seed) not in runs:
        known = ", ".join(f"--policy={p} --seed={s}" for p, s in runs) or "none yet"
        raise WorkdirError(f"{folder}: holds no checkpoint; runs that do: {known}")
    kind = _first_round_kind(policy)
    run_policy = policy if kind is None else None
    if data_dir:
        config.data_dir = data_dir
    scene = load_config_scene(config, cache_dir=cache)
    problem = build_problem(config, scene, kind or get_policy(policy).field_kind)
    run = Run(config, problem, workdir, run_policy, seed)
    state = run.state()
    run.checkpoints.close()
    situation = Situation(
        state.train,
        state.table,
        state.is_training_view,
        num_rays=int(np.diff(scene.offsets)[run.initial].sum()),
        label=run.label,
    )
    last_round = config.num_rounds if run_policy else 0
    completed = int(state.round) == last_round and int(state.calls) >= problem.calls_per_round
    return Trained(config, problem, situation, folder, policy, seed, int(state.round), completed)


def fit_variance(trained: Trained, track: Callable) -> jax.Array:
    """The Laplace posterior's variance of each vertex [G], from all training rays."""
    fns = trained.problem.model_fns("laplace", track)
    # The key of the run's own pictures, so that the same uncertainty is exported.
    key = jax.random.fold_in(run_key(trained.seed), 2**31 - 2)
    return fns.fit(key, trained.situation)


def bind_point_fn(trained: Trained, variance: jax.Array) -> Callable:
    """`positions [K, 3] -> dict`, in scene units: see `points.make_point_fn`."""
    toolbox = trained.problem.make_toolbox(None)
    field, _ = toolbox.fields[toolbox.kind]
    point_fn = make_point_fn(field, toolbox.grid, variant=toolbox.laplace.variant)
    return partial(point_fn, trained.situation.train.params["field"], variance)


def user_point_fn(trained: Trained, variance: jax.Array) -> Callable:
    """The same in the coordinates and units of the user's own files, directions included."""
    scene, point_fn = trained.problem.scene, bind_point_fn(trained, variance)
    unit = user_units(scene)
    user_from_scene_rotation = np.asarray(scene.user_from_scene)[:3, :3] / unit

    def query(positions, *, directions=None, progress_fn=None):
        if directions is not None:
            directions = np.asarray(directions) @ user_from_scene_rotation
        values = point_fn(
            scene_points(scene, positions), directions=directions, progress_fn=progress_fn
        )
        return values | {"density": values["density"] / unit, "sigma": values["sigma"] * unit}

    return query


def _runs_with_checkpoint(workdir: pathlib.Path) -> list[tuple[str, int]]:
    """(policy, seed) of the runs that can be taken up, without those of other scripts."""
    known = []
    for folder in sorted(workdir.glob("*/seed_*/checkpoints")):
        name, seed = folder.parent.parent.name, folder.parent.name.removeprefix("seed_")
        has_any = any(path.name.isdigit() for path in folder.iterdir())
        if has_any and seed.isdigit() and (name in POLICIES or _first_round_kind(name)):
            known.append((name, int(seed)))
    return known


def _first_round_kind(name: str) -> str | None:
    """Kind of field that a folder of first rounds holds; None for any other folder."""
    if name == "initial":
        return RECONSTRUCTION
    kind = name.removeprefix("initial_")
    return kind if kind != name and kind in KINDS else None


def _with_tuples(values):
    """JSON's lists as the tuples that they were."""
    if isinstance(values, dict):
        return {name: _with_tuples(value) for name, value in values.items()}
    return tuple(map(_with_tuples, values)) if isinstance(values, list) else values
