"""A field that a run has trained, taken up from its folder or trained now, and its posterior."""

import json
import pathlib
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from ml_collections import ConfigDict

from bavs_jax.active import ActiveState
from bavs_jax.pixel_table import num_training_pixels
from bavs_jax.rendering.images import render_views
from bavs_jax.selection.policies import POLICIES, get_policy
from bavs_jax.uncertainty.model import Acquired
from bavs_jax.uncertainty.models.laplace import laplace_variance, training_curvature
from bavs_jax.uncertainty.points import make_point_fn
from experiments import runtime
from experiments.build import Problem, stream_key
from experiments.build_model import KINDS, RENDER_CHUNK
from experiments.configs import base
from experiments.files import Part, modern
from experiments.runner import Run
from experiments.runtime import WorkdirError
from experiments.schema import check_config

# Folders of round 0, which all policies of a seed with the same kind of field share.
FIRST_ROUNDS = {Part(None, kind, 0).name.partition("/")[0]: kind for kind in KINDS}
FIRST_ROUND = "initial"


class TrainedRun(NamedTuple):
    """The last checkpoint of one run of `experiments.active_selection`."""

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
    def acquired(self) -> Acquired:
        state = self.state
        known = (state.train, state.table, state.is_training_view, self.num_rays)
        return Acquired(*known, label=self.label)

    @property
    def training_views(self) -> np.ndarray:
        """Rows of the pixel table."""
        return np.flatnonzero(np.asarray(self.state.is_training_view))

    def photo(self, view_id: int) -> tuple[np.ndarray, np.ndarray]:
        """True colours of a view of the table, [H, W, 3] in [0, 1], and which count, [H, W]."""
        table = self.state.table
        width, height = np.asarray(table.cameras.sizes)[view_id]
        rows = slice(*np.asarray(table.offsets)[view_id : view_id + 2])
        # A table without masks has a single True for all pixels.
        mask = np.broadcast_to(table.pixel_mask, len(table.pixels))[rows]
        rgb = np.asarray(table.pixels[rows]) / 255.0
        return rgb.reshape(height, width, 3), mask.reshape(height, width)

    def render(self, chunk_fn: Callable, view_ids, progress_fn=None) -> list[dict]:
        """Images of views of the pixel table; see `render_views`."""
        options = {"rays_per_pixel": self.problem.config.rays_per_pixel, "chunk": RENDER_CHUNK}
        cameras = self.state.table.cameras
        return render_views(chunk_fn, cameras, view_ids, progress_fn=progress_fn, **options)

    def track(self, view_ids, label: str, times: int = 1):
        """Progress over all rays of some views."""
        pixels = int(np.diff(np.asarray(self.state.table.offsets))[view_ids].sum())
        num_rays = times * self.problem.config.rays_per_pixel * pixels
        return runtime.track(num_rays, f"{self.label}: {label}", "rays")

    def curvature(self) -> jax.Array:
        """`jac_sq_sum` [G, 3] of the training rays, with progress."""
        # The key of the run's own pictures, so that the same uncertainty comes out.
        key, setup = stream_key(self.seed, "pictures"), self.problem.setup
        return training_curvature(key, setup, self.acquired, setup.laplace.weighting)

    def variance(self) -> jax.Array:
        """The vertex variance [G] that the run's uncertainty channel interpolates."""
        return laplace_variance(self.curvature(), self.num_rays, self.problem.laplace)

    def point_fn(self) -> Callable:
        """`positions [K, 3] -> dict`: density, sigma and colour there; see `make_point_fn`."""
        setup = self.problem.setup
        point_fn = make_point_fn(setup.model, setup.grid, variant=setup.laplace.variant)
        return partial(point_fn, self.state.train.model, self.variance())


# --- which run -------------------------------------------------------------------------------


def renewed_config(saved: dict) -> ConfigDict:
    """A config that was saved, unchecked; options that it did not know have their default."""
    config = base.get_config().lock()
    config.update_from_flattened_dict(modern(saved))
    return config


def saved_config(workdir: pathlib.Path) -> ConfigDict:
    """The config that a run left in its folder; WorkdirError if there is none that can be read."""
    path = workdir / "config.json"
    try:
        config = renewed_config(json.loads(path.read_text(encoding="utf-8")))
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
    known = set()
    for path in workdir.glob("*/seed_*/checkpoints/*"):
        policy, seed = path.parts[-4], path.parts[-3].removeprefix("seed_")
        if (
            path.name.isdigit()
            and seed.isdigit()
            and (policy in POLICIES or policy in FIRST_ROUNDS)
        ):
            known.add((policy, int(seed)))
    return sorted(known)


def choose_runs(workdir: pathlib.Path, config, policy: str, seed: int | None) -> list:
    """(policy, seed) of the runs of a policy, or of a folder of first rounds; `seed` None: of all.

    Without a policy these are the config's first one's, or round 0 where that has not been started.
    Raises WorkdirError if there is no such run, or it has no checkpoint yet.
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
    return FIRST_ROUNDS.get(policy) or get_policy(policy).field_kind


# --- its field -------------------------------------------------------------------------------


def load_run(problem: Problem, workdir: pathlib.Path, policy: str, seed: int) -> TrainedRun:
    """Takes up a run of `find_runs`, finished or not, where its last checkpoint is.

    The problem is built from the folder's config, for fields of `field_kind(policy)`.
    """
    own = None if policy in FIRST_ROUNDS else policy
    run = Run(problem.config, problem, workdir, own, seed)
    state = run.state()
    run.checkpoints.close()
    num_rays = int(num_training_pixels(problem.scene, run.initial).sum())
    is_last = int(state.round) == (problem.config.num_rounds if own else 0)
    completed = is_last and int(state.calls) >= problem.trainer.num_calls
    return TrainedRun(problem, state, num_rays, run.folder, policy, seed, completed)


def train_run(
    config, problem: Problem, workdir: pathlib.Path, policy: str, seed: int, command: str = ""
) -> TrainedRun:
    """Brings a run to its end from wherever it is, and takes it up there; see `load_run`.

    A policy of `FIRST_ROUND` is round 0 alone; the command is kept in the result file.
    """
    first = Run(config, problem, workdir, None, seed, command)
    first.finish()
    if policy not in FIRST_ROUNDS:
        Run(config, problem, workdir, policy, seed, command).finish(first)
    return load_run(problem, workdir, policy, seed)
