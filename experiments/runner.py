"""A policy with a seed, from its last checkpoint to its result file; and all runs of a config."""

import pathlib
import time
from functools import partial

import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from bavs_jax import active
from bavs_jax.active import ActiveState
from bavs_jax.devices import num_shards
from bavs_jax.pixel_table import num_training_pixels
from bavs_jax.training.checkpoints import Checkpoints
from bavs_jax.training.fit import MAX_RESTARTS
from bavs_jax.uncertainty.model import Acquired
from experiments import evaluate, files, runtime
from experiments.build import (
    Problem,
    check_views,
    initial_views,
    load_config_scene,
    run_key,
    stream_key,
)
from experiments.build_model import train_with_bar
from experiments.choices import acquisition_arrays, load_choices, save_choice, write_next_views
from experiments.files import Part, write_arrays, write_json
from experiments.reporting.report import write_report
from experiments.reporting.results import bound_words
from experiments.runtime import ConfigError, WorkdirError, is_first_process, warn

SCHEMA_VERSION = 1
LOG_EVERY = 10  # training calls between two lines of metrics.jsonl


class Run:
    """Trains and chooses in turn for one policy and seed, and keeps the run's files up to date.

    Round 0 is the same for all policies of a seed that train the same kind of field: it is made
    once, in `initial/seed_<n>` or `initial_<kind>/seed_<n>`, by a `Run` whose policy is None.
    """

    def __init__(self, config, problem: Problem, workdir: pathlib.Path, policy, seed, command=""):
        self.config, self.problem, self.workdir = config, problem, workdir
        self.policy, self.seed, self.command = policy, seed, command
        self.label = f"{policy or 'initial'} seed {seed}"
        self.part = Part(policy, problem.kind, seed)
        self.folder = workdir / self.part.name
        view_seed = seed if config.view_seed is None else config.view_seed
        self.initial = initial_views(problem.scene, view_seed, config.num_initial)
        self.rounds: list[dict] = []  # of result.json
        self.pending = _new_pending()  # what is known of the round under way
        self.checkpoints = Checkpoints(self.folder / "checkpoints", warn_fn=warn)

    def finish(self, shared: "Run | None" = None) -> None:
        """Goes on from the last checkpoint to the last round and writes all files of the run.

        Without a checkpoint it goes on from the finished run of round 0 that is `shared`.
        """
        state = self._restored(self) or (shared and self._restored(shared)) or self._fresh()
        if self.policy and not files.is_finished(self.workdir, self.part):
            load_choices(self.folder, int(state.round))  # whether they can be read
        last_round = self.config.num_rounds if self.policy else 0
        while True:
            number = int(state.round)
            if int(state.calls) < self.problem.trainer.num_calls:
                state = self._train(state)
            if len(self.rounds) == number:
                self._measure_round(state)
            if self.policy:
                self._write_files(state, completed=number == last_round)
            if number >= last_round:
                break
            state = self._choose(state)
        if self.policy is None:
            write_json(self.folder / "round_0.json", self.rounds[0])
        self.checkpoints.close()

    def state(self) -> ActiveState:
        """The state of the last checkpoint; raises WorkdirError if none can be read."""
        state = self._restored(self)
        if state is None:
            raise WorkdirError(
                f"{self.folder}: holds no checkpoint that can be read: start its run again"
            )
        return state

    # --- one round ---

    def _choose(self, state: ActiveState) -> ActiveState:
        """Opens the next round with the views that the policy chooses."""
        number = int(state.round) + 1
        choose_key, restart_key, _ = active.round_keys(run_key(self.seed), number)
        current = self.rounds[-1]["selected"][-1]  # in the checkpoint's notes
        acquisition = self.problem.acquisition(self.policy, self.initial, self.label, current)
        choice = active.select(choose_key, state, acquisition)
        state, view_ids = active.update(state, choice, acquisition.source)
        save_choice(self.folder, number, choice, in_scene=not self.problem.has_empty_views)
        info, filtered = choice.selection, choice.selection.filter
        self.pending = _new_pending() | {
            "selected": view_ids.tolist(),
            "num_candidates": int(choice.candidates.mask.sum()),
            "num_survivors": int(info.survivors.sum()) if filtered else None,
            "farthest_overlap": int(info.farthest_overlap),
            "survivors_farthest_overlap": (
                int(info.survivors_farthest_overlap) if filtered else None
            ),
            "batch_bound": info.bound._asdict() if info.bound else None,
        }
        self.pending["seconds"] |= choice.seconds
        self._log("choice", number, **self.pending)
        if info.bound:
            print(f"{self.label}: {bound_words(self.pending['batch_bound'])}")
        return state.replace(train=self.problem.restart(restart_key, state.train))

    def _train(self, state: ActiveState) -> ActiveState:
        """Trains the round to its end, with a bar, a log and checkpoints."""
        problem, number, pending = self.problem, int(state.round), self.pending
        _, _, train_key = active.round_keys(run_key(self.seed), number)
        clock = saved = time.monotonic()
        for fitted in train_with_bar(
            train_key,
            problem.trainer,
            state.train,
            state.table,
            state.is_training_view,
            steps_per_call=self.config.train.steps_per_call,
            label=f"{self.label}: train on {int(state.is_training_view.sum())} views",
            calls=int(state.calls),
            restarts=int(state.restarts),
        ):
            state, info = active.trained(state, fitted), fitted.info
            pending["seconds"]["train"] += time.monotonic() - clock
            shape = {name: float(getattr(info, name)) for name in ("rays", "samples", "thinned")}
            loss = float(info.loss)
            at_end = fitted.calls >= problem.trainer.num_calls
            if fitted.calls == 0:
                pending["restarts"] = fitted.restarts
                event = {"restarts": fitted.restarts, "loss": loss, "thinned": shape["thinned"]}
                self._log("restart", number, **event)
            if at_end:
                pending["stuck"] = problem.is_stuck(info, state)
            if fitted.calls % LOG_EVERY == 0 or at_end:
                step = fitted.calls * self.config.train.steps_per_call
                numbers = {"loss": loss, "psnr": float(-10 * jnp.log10(info.loss))}
                self._log("train", number, step=step, **numbers, **shape)
            due = time.monotonic() - saved > self.config.checkpoint_seconds
            if runtime.as_first_process(due) or at_end:
                self._save(state)
                saved = time.monotonic()
            clock = time.monotonic()
        return state

    def _measure_round(self, state: ActiveState) -> None:
        number, config, start = int(state.round), self.config, time.monotonic()
        num = config.num_test_final if number == config.num_rounds else config.num_test
        measures = evaluate.measure_test_views(self.problem, state.train, num, self.label)
        if number == 0:
            self.pending["selected"] = self.initial.tolist()
        self.pending["seconds"]["evaluate"] = time.monotonic() - start
        row = {"num_views": int(state.is_training_view.sum()), **self.pending, **measures}
        self.rounds.append(row)
        self.pending = _new_pending()
        self._save(state)
        self._log("round", number, **row)

    # --- checkpoints ---

    def _fresh(self) -> ActiveState:
        train = self.problem.trainer.init(stream_key(self.seed, "init"))
        return active.init(train, self.problem.table, self.initial)

    def _restored(self, run: "Run") -> ActiveState | None:
        """The state of a run's last checkpoint, from where this one goes on; None without one."""
        found = run.checkpoints.restore(saved_part(self.problem, self._fresh()))
        if found is None:
            return None
        saved, meta = found
        self.rounds, self.pending = meta["rounds"], meta["pending"]
        return whole_state(self.problem, saved)

    def _save(self, state: ActiveState) -> None:
        """Writes a checkpoint; its number grows with rounds, restarts, calls and measures."""
        calls = int(state.calls) + (len(self.rounds) > int(state.round))
        attempt = int(state.round) * (MAX_RESTARTS + 1) + int(state.restarts)
        number = attempt * (self.problem.trainer.num_calls + 2) + calls
        meta = {"rounds": self.rounds, "pending": self.pending}
        self.checkpoints.save(number, saved_part(self.problem, state), meta)

    # --- files ---

    def _write_files(self, state: ActiveState, *, completed: bool) -> None:
        if files.is_finished(self.workdir, self.part):
            return
        scene, folder = self.problem.scene, self.folder
        path, pictures_path = folder / "result.json", folder / "pictures.npz"
        if completed and (self.seed == self.config.seeds[0] or pictures_path.exists()):
            write_arrays(pictures_path, **self._pictures(state), round=int(state.round))
        if not is_first_process():
            return
        choices = load_choices(folder, int(state.round))
        arrays = acquisition_arrays(scene, self.initial, choices)
        write_arrays(folder / "acquisition.npz", **arrays)
        if completed:
            write_next_views(folder / "next_views" / "transforms.json", scene, choices)
        if not files.is_completed(files.read_json(path)):  # measured since, if it is
            write_json(path, self._result(completed))

    def _pictures(self, state: ActiveState) -> dict[str, np.ndarray]:
        """Of test views, with uncertainty (Fig 4)."""
        scene = self.problem.scene
        num_rays = int(num_training_pixels(scene, self.initial).sum())
        known = (state.train, state.table, state.is_training_view, num_rays)
        fns = self.problem.model_fns("laplace")
        acquired = Acquired(*known, label=f"{self.label}: pictures")
        fitted = fns.fit(stream_key(self.seed, "pictures"), acquired)
        return evaluate.picture_arrays(
            partial(fns.render, fitted, state.train),
            scene,
            evaluate.evenly_spaced(scene.test, self.config.num_pictures),
            rays_per_pixel=self.config.rays_per_pixel,
        )

    def _result(self, completed: bool) -> dict:
        scene, baselines = self.problem.scene, None
        if completed:  # of the last round's test views; pictures taken on the way are left out
            used = np.concatenate([row["selected"] for row in self.rounds]).astype(int)
            test_views = evaluate.evenly_spaced(scene.test, self.config.num_test_final)
            baselines = evaluate.measure_baselines(scene, used[used < scene.num_views], test_views)
        return {
            "schema_version": SCHEMA_VERSION,
            "scene": {
                "name": scene.name,
                "kind": self.config.loader,
                "num_pool": len(scene.pool),
                "num_test": len(scene.test),
                "image_size": np.max(scene.cameras.sizes, axis=0).tolist(),
            },
            "policy": self.policy,
            "seed": self.seed,
            "command": self.command,
            "config": self.config.to_dict(),
            "versions": runtime.versions(),
            "device": runtime.device_name(),
            "num_devices": num_shards(self.problem.mesh),
            "peak_memory_mb": runtime.peak_memory_mb(),
            "completed": completed,
            "lpips_reason": self.problem.lpips_reason,
            "baselines": baselines,
            "rounds": self.rounds,
        }

    def _log(self, event: str, number: int, **values) -> None:
        head = {"time": time.time(), "policy": self.folder.parent.name, "seed": self.seed}
        head |= {"event": event, "round": number}
        files.append_line(self.workdir / "metrics.jsonl", head | values)


def _new_pending() -> dict:
    names = ("train", "curvature", "fit", "score", "select", "evaluate")
    seconds = dict.fromkeys(names, 0.0)
    return {"selected": [], "seconds": seconds, "restarts": 0, "stuck": False}


def saved_part(problem: Problem, state: ActiveState):
    """The state without the scene's own pixels, which its files hold already."""
    saved = {
        "train": state.train,
        "is_training_view": state.is_training_view,
        "round": state.round,
        "calls": state.calls,
        "restarts": state.restarts,
        "world_from_cam": state.table.cameras.world_from_cam,
    }
    if problem.has_empty_views:
        first, table = int(problem.scene.offsets[-1]), state.table
        saved["new_pixels"] = table.pixels[first:]
        if problem.scene.alpha is not None:  # an opaque scene's table has none
            saved["new_alpha"] = table.alpha[first:]
    return saved


def whole_state(problem: Problem, saved) -> ActiveState:
    """The inverse of `saved_part`."""
    table, saved = problem.table, dict(saved)
    cameras = table.cameras.replace(world_from_cam=saved.pop("world_from_cam"))
    table = table.replace(cameras=cameras)
    if problem.has_empty_views:
        first = int(problem.scene.offsets[-1])
        table = table.replace(pixels=table.pixels.at[first:].set(saved.pop("new_pixels")))
        if problem.scene.alpha is not None:
            table = table.replace(alpha=table.alpha.at[first:].set(saved.pop("new_alpha")))
    return ActiveState(table=table, **saved)


# --- all runs of a config ---


def run_all(
    config, folder: pathlib.Path, command: str, mesh: Mesh | None = None, only: str | None = None
) -> None:
    """Every policy with every seed, each from the round 0 it shares; then views and report.

    `command` is kept in the result files. `only` names a part, such as `bavs/seed_0`, to make just
    that.
    """
    start = time.monotonic()
    known = {part.name: part for part in files.all_parts(config.policies, config.seeds)}
    if only is not None and only not in known:
        raise ConfigError(f"--part: {only!r} is not part of this config; use one of {(*known,)}")
    parts = [*known.values()] if only is None else [known[only]]
    files.check_claim(folder, config)
    scene = load_config_scene(config, cache_dir=runtime.scene_cache())
    check_views(config, scene)
    print(f"{scene.name}: {len(scene.pool)} views to choose from, {len(scene.test)} test views")
    problems = {kind: Problem(config, scene, kind, mesh) for kind in {p.kind for p in parts}}
    files.claim(folder, config)

    def make(part: Part, shared: Run | None = None) -> Run:
        # Other processes may make other parts of the same folder, and need the same round 0.
        with files.exclusive(folder / part.name):
            run = Run(config, problems[part.kind], folder, part.policy, part.seed, command)
            run.finish(shared)
            return run

    first_rounds: dict[Part, Run] = {}
    for part in parts:
        if part.initial not in first_rounds:
            first_rounds[part.initial] = make(part.initial)
        if part.policy is not None:
            make(part, first_rounds[part.initial])
            if only is None and is_first_process():
                files.collect(folder)
    if only is None and is_first_process():
        next_views = files.export_next_views(folder, config.policies[0], config.seeds[0])
        print(f"chosen poses: {next_views}")
        report = write_report(folder)
        print(f"report:       {report}  ({time.monotonic() - start:.0f} s in all)")
