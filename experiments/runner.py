"""A policy with a seed, from its last checkpoint to its result file; and all runs of a config."""

from __future__ import annotations

import pathlib
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from bavs_jax import active
from bavs_jax.active import ActiveState, Choice
from bavs_jax.devices import num_shards
from bavs_jax.pixel_table import num_training_pixels
from bavs_jax.training.checkpoints import Checkpoints
from bavs_jax.training.fit import MAX_RESTARTS, fit
from bavs_jax.uncertainty.model import Acquired
from experiments import acquisitions, runtime, workdir
from experiments.build import Problem, build_problem
from experiments.build_scene import check_views, initial_views, load_config_scene
from experiments.errors import WorkdirError
from experiments.evaluate import (
    evenly_spaced,
    measure_baselines,
    measure_test_views,
    picture_arrays,
)
from experiments.files import append_line, exclusive, read_json, write_arrays, write_json
from experiments.keys import run_key, stream_key
from experiments.progress import track
from experiments.reporting.report import write_report
from experiments.reporting.results import bound_words
from experiments.runtime import device_name, peak_memory_mb, versions, warn
from experiments.signals import as_first_process, is_first_process
from experiments.workdir import Part, all_parts, find_part, is_completed, is_finished

SCHEMA_VERSION = 1
LOG_EVERY = 10  # training calls between two lines of metrics.jsonl


class Run:
    """Trains and chooses in turn for one policy and seed, and keeps the run's files up to date.

    Round 0 is the same for all policies of a seed that train the same kind of field: it is made
    once, in `initial/seed_<n>` or `initial_<kind>/seed_<n>`, by a `Run` whose policy is None.
    """

    def __init__(self, config, problem: Problem, workdir: pathlib.Path, policy, seed, command=""):
        self.config, self.problem, self.workdir = config, problem, workdir
        self.command = command
        self.policy, self.seed = policy, seed
        self.label = f"{policy or 'initial'} seed {seed}"
        self.part = Part(policy, problem.kind, seed)
        self.folder = workdir / self.part.name
        view_seed = int(config.view_seed or seed)
        self.initial = initial_views(problem.scene, view_seed, config.num_initial)
        self.rounds: list[dict] = []  # of result.json
        self.pending = _new_pending()  # what is known of the round under way
        self._is_restored = False  # whether a checkpoint was there
        self.checkpoints = Checkpoints(self.folder / "checkpoints", warn_fn=warn)

    def finish(self, shared: Run | None = None) -> None:
        """Goes on from the last checkpoint to the last round and writes all files of the run.

        Args:
          shared: the finished run of round 0 to start from; None to make round 0 here.
        """
        state = self._start(shared)
        if self.policy and not is_finished(self.workdir, self.part):
            acquisitions.load_choices(self.folder, int(state.round))  # whether they can be read
        last_round = self.config.num_rounds if self.policy else 0
        while True:
            number = int(state.round)
            if not self._is_trained(state):
                state = self._train(state)
            if len(self.rounds) == number:
                self._measure_round(state, is_last=number == self.config.num_rounds)
            if self.policy:
                self._write_files(state, completed=number == last_round)
            if number >= last_round:
                break
            state = self._choose(state)
        if self.policy is None:
            write_json(self.folder / "round_0.json", self.rounds[0])
        self.checkpoints.close()

    def state(self) -> ActiveState:
        """The state of the last checkpoint.

        Raises:
          WorkdirError: there is none that can be read.
        """
        state = self._start(None)
        if not self._is_restored:
            raise WorkdirError(
                f"{self.folder}: holds no checkpoint that can be read: start its run again"
            )
        return state

    # --- one round ---

    def _is_trained(self, state: ActiveState) -> bool:
        return int(state.calls) >= self.problem.trainer.num_calls

    def _choose(self, state: ActiveState) -> ActiveState:
        """Opens the next round with the views that the policy chooses."""
        number = int(state.round) + 1
        choose_key, restart_key, _ = active.round_keys(run_key(self.seed), number)
        acquisition = self.problem.acquisition(self.policy, self.initial, self.label)
        choice = active.select(choose_key, state, acquisition)
        state, view_ids = active.update(state, choice, acquisition.source)
        self._record_choice(number, choice, view_ids)
        return state.replace(train=self.problem.restart(restart_key, state.train))

    def _train(self, state: ActiveState) -> ActiveState:
        """Trains the round to its end, with a bar, a log and checkpoints."""
        trainer, steps = self.problem.trainer, self.config.train.steps_per_call
        _, _, train_key = active.round_keys(run_key(self.seed), int(state.round))
        left = (trainer.num_calls - int(state.calls)) * steps
        label = f"{self.label}: train on {int(state.is_training_view.sum())} views"
        with track(left, label, "steps") as bar:
            clock = saved = time.monotonic()
            for fitted in fit(
                train_key,
                trainer,
                state.train,
                state.table,
                state.is_training_view,
                calls=int(state.calls),
                restarts=int(state.restarts),
                label=f"round {int(state.round)}",
            ):
                state, info = active.trained(state, fitted), jax.block_until_ready(fitted.info)
                self.pending["seconds"]["train"] += time.monotonic() - clock
                at_end = self._is_trained(state)
                if fitted.restarts > self.pending["restarts"]:
                    self._record_restart(state, info)
                if at_end:
                    self.pending["stuck"] = self.problem.is_stuck(info, state)
                numbers = {"loss": float(info.loss), "psnr": float(-10 * jnp.log10(info.loss))}
                bar.advance(steps, **numbers)
                if fitted.calls % LOG_EVERY == 0 or at_end:
                    shape = {k: float(getattr(info, k)) for k in ("rays", "samples", "thinned")}
                    at = {"round": int(state.round), "step": fitted.calls * steps}
                    self._log(event="train", **at, **numbers, **shape)
                due = as_first_process(time.monotonic() - saved > self.config.checkpoint_seconds)
                if due or at_end:
                    self._save(state)
                    saved = time.monotonic()
                clock = time.monotonic()
        return state

    def _record_restart(self, state: ActiveState, info) -> None:
        self.pending["restarts"] = int(state.restarts)
        at = {"round": int(state.round), "restarts": int(state.restarts)}
        self._log(event="restart", **at, loss=float(info.loss), thinned=float(info.thinned))
        warn(
            f"{self.label}: round {int(state.round)}: the field is stuck (loss "
            f"{float(info.loss):.3g}, {float(info.thinned):.0%} of the rays full of fog): "
            "trained anew with another key"
        )

    def _record_choice(self, number: int, choice: Choice, view_ids: np.ndarray) -> None:
        in_scene = not self.problem.has_empty_views
        acquisitions.save_choice(self.folder, number, choice, in_scene=in_scene)
        info = choice.selection
        self.pending = _new_pending()
        self.pending["seconds"] |= choice.seconds
        self.pending |= {
            "selected": view_ids.tolist(),
            "num_candidates": int(choice.candidates.mask.sum()),
            "num_survivors": int(info.survivors.sum()) if info.filter else None,
            "farthest_overlap": int(info.farthest_overlap),
            "survivors_farthest_overlap": (
                int(info.survivors_farthest_overlap) if info.filter else None
            ),
            "batch_bound": info.bound._asdict() if info.bound else None,
        }
        self._log(event="choice", round=number, **self.pending)
        if info.bound:
            print(f"{self.label}: {bound_words(self.pending['batch_bound'])}")

    def _measure_round(self, state: ActiveState, *, is_last: bool) -> None:
        start = time.monotonic()
        num = self.config.num_test_final if is_last else self.config.num_test
        measures = measure_test_views(self.problem, state.train, num, self.label)
        pending = self.pending
        if int(state.round) == 0:
            pending["selected"] = self.initial.tolist()
        pending["seconds"]["evaluate"] = time.monotonic() - start
        row = {"num_views": int(state.is_training_view.sum()), **pending, **measures}
        self.rounds.append(row)
        self.pending = _new_pending()
        self._save(state)
        self._log(event="round", round=int(state.round), **row)

    def _uncertain_render_fn(self, state: ActiveState):
        """Renders colour and uncertainty (Fig 4) of a state that may come from disk."""
        num_rays = int(num_training_pixels(self.problem.scene, self.initial).sum())
        fns = self.problem.model_fns("laplace")
        acquired = Acquired(
            state.train,
            state.table,
            state.is_training_view,
            num_rays,
            label=f"{self.label}: pictures",
        )
        fitted = fns.fit(stream_key(self.seed, "pictures"), acquired)
        return partial(fns.render, fitted, state.train)

    # --- files ---

    def _start(self, shared: Run | None) -> ActiveState:
        """The last checkpoint's state, or the one where `shared` ended, or a fresh one."""
        init_key = stream_key(self.seed, "init")
        fresh = active.init(self.problem.trainer.init(init_key), self.problem.table, self.initial)
        for run in (self, shared):
            found = run and run.checkpoints.restore(saved_part(self.problem, fresh))
            if found:
                saved, meta = found
                self.rounds, self.pending = meta["rounds"], meta["pending"]
                self._is_restored = True
                return whole_state(self.problem, saved)
        return fresh

    def _save(self, state: ActiveState) -> None:
        """Writes a checkpoint; its number grows with rounds, restarts, calls and measures."""
        calls = int(state.calls) + (len(self.rounds) > int(state.round))
        attempt = int(state.round) * (MAX_RESTARTS + 1) + int(state.restarts)
        number = attempt * (self.problem.trainer.num_calls + 2) + calls
        meta = {"rounds": self.rounds, "pending": self.pending}
        self.checkpoints.save(number, saved_part(self.problem, state), meta)

    def _write_files(self, state: ActiveState, *, completed: bool) -> None:
        if is_finished(self.workdir, self.part):
            return
        scene, config = self.problem.scene, self.config
        path, pictures_path = self.folder / "result.json", self.folder / "pictures.npz"
        if completed and (self.seed == config.seeds[0] or pictures_path.exists()):
            view_ids = evenly_spaced(scene.test, config.num_pictures)
            pictures = picture_arrays(
                self._uncertain_render_fn(state),
                scene,
                view_ids,
                rays_per_pixel=config.rays_per_pixel,
            )
            write_arrays(pictures_path, **pictures, round=int(state.round))
        if not is_first_process():
            return
        choices = acquisitions.load_choices(self.folder, int(state.round))
        write_arrays(
            self.folder / "acquisition.npz",
            **acquisitions.acquisition_arrays(scene, self.initial, choices),
        )
        if completed:
            acquisitions.write_next_views(
                self.folder / "next_views" / "transforms.json", scene, choices
            )
        if not is_completed(read_json(path)):  # measured since, if it is
            write_json(path, self._result(completed))

    def _result(self, completed: bool) -> dict:
        scene = self.problem.scene
        sizes = np.asarray(scene.cameras.sizes)
        return {
            "schema_version": SCHEMA_VERSION,
            "scene": {
                "name": scene.name,
                "kind": self.config.loader,
                "num_pool": len(scene.pool),
                "num_test": len(scene.test),
                "image_size": sizes.max(axis=0).tolist(),
            },
            "policy": self.policy,
            "seed": self.seed,
            "command": self.command,
            "config": self.config.to_dict(),
            "versions": versions(),
            "device": device_name(),
            "num_devices": num_shards(self.problem.mesh),
            "peak_memory_mb": peak_memory_mb(),
            "completed": completed,
            "lpips_reason": self.problem.lpips_reason,
            "baselines": self._baselines() if completed else None,
            "rounds": self.rounds,
        }

    def _baselines(self) -> dict[str, float]:
        """Of the last round's test views; pictures taken on the way are left out."""
        scene = self.problem.scene
        used = np.concatenate([row["selected"] for row in self.rounds]).astype(int)
        test_views = evenly_spaced(scene.test, self.config.num_test_final)
        return measure_baselines(scene, used[used < scene.num_views], test_views)

    def _log(self, **values) -> None:
        head = {"time": time.time(), "policy": self.folder.parent.name, "seed": self.seed}
        append_line(self.workdir / "metrics.jsonl", {**head, **values})


def _new_pending() -> dict:
    names = ("train", "curvature", "fit", "score", "select", "evaluate")
    seconds = dict.fromkeys(names, 0.0)
    return {"selected": [], "seconds": seconds, "restarts": 0, "stuck": False}


def saved_part(problem: Problem, state: ActiveState):
    """The state without the scene's own pixels, which its files hold already."""
    first = int(problem.scene.offsets[-1])
    return {
        "train": state.train,
        "is_training_view": state.is_training_view,
        "round": state.round,
        "calls": state.calls,
        "restarts": state.restarts,
        "world_from_cam": state.table.cameras.world_from_cam,
        **({"new_pixels": state.table.pixels[first:]} if problem.has_empty_views else {}),
        **({"new_alpha": state.table.alpha[first:]} if problem.has_empty_views else {}),
    }


def whole_state(problem: Problem, saved) -> ActiveState:
    """The inverse of `saved_part`."""
    table = problem.table
    cameras = table.cameras.replace(world_from_cam=saved["world_from_cam"])
    pixels, alpha = table.pixels, table.alpha
    if problem.has_empty_views:
        pixels = pixels.at[int(problem.scene.offsets[-1]) :].set(saved["new_pixels"])
        alpha = alpha.at[int(problem.scene.offsets[-1]) :].set(saved["new_alpha"])
    return ActiveState(
        train=saved["train"],
        table=table.replace(cameras=cameras, pixels=pixels, alpha=alpha),
        is_training_view=saved["is_training_view"],
        round=saved["round"],
        calls=saved["calls"],
        restarts=saved["restarts"],
    )


# --- all runs of a config ---


def make_parts(
    config, folder: pathlib.Path, command: str, only: str | None = None, mesh: Mesh | None = None
) -> None:
    """Every policy with every seed, each from the round 0 it shares; or only one part of that."""
    parts = all_parts(config.policies, config.seeds)
    if only is not None:
        parts = [find_part(only, parts)]
    workdir.check_claim(folder, config)
    scene = load_config_scene(config, cache_dir=runtime.scene_cache())
    check_views(config, scene)
    print(f"{scene.name}: {len(scene.pool)} views to choose from, {len(scene.test)} test views")
    problems = {kind: build_problem(config, scene, kind, mesh) for kind in {p.kind for p in parts}}
    workdir.claim(folder, config)

    def make(part, shared=None) -> Run:
        # Other processes may make other parts of the same folder, and need the same round 0.
        with exclusive(folder / part.name):
            run = Run(config, problems[part.kind], folder, part.policy, part.seed, command)
            run.finish(shared)
            return run

    first_rounds = {}
    for part in parts:
        if part.initial not in first_rounds:
            first_rounds[part.initial] = make(part.initial)
        if part.policy is not None:
            make(part, first_rounds[part.initial])
            if only is None and is_first_process():
                workdir.collect(folder)


def run_all(config, folder: pathlib.Path, command: str, mesh: Mesh | None) -> None:
    """All parts of a config, then the exported views and the report."""
    start = time.monotonic()
    make_parts(config, folder, command, mesh=mesh)
    if not is_first_process():
        return
    next_views = workdir.export_next_views(folder, config.policies[0], config.seeds[0])
    report = write_report(folder)
    print(f"chosen poses: {next_views}")
    print(f"report:       {report}  ({time.monotonic() - start:.0f} s in all)")
