"""What is done with a trained run: which runs flags name, draws from its posterior, and LPIPS.

With --config a run is trained as far as --workdir does not hold it yet; without, the last
checkpoints in --workdir are taken up as they are.
"""

import pathlib
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import jax
import numpy as np
from absl import flags
from scipy.stats import spearmanr

from bavs_jax.metrics.covered import MIN_OPACITY
from bavs_jax.selection.distances import nearest_distances
from bavs_jax.uncertainty.draws import (
    colour_deviation,
    draw_offsets,
    make_displaced_render_fn,
    noise_scale,
)
from bavs_jax.uncertainty.posterior import posterior_precision
from experiments import runtime
from experiments.build import Problem, check_views, load_config_scene, stream_key
from experiments.evaluate import measure_test_views
from experiments.files import check_claim, claim, collect, is_completed, write_json
from experiments.reporting.report import write_report
from experiments.reporting.result_tables import FILES
from experiments.reporting.tables import collected_text
from experiments.runtime import ConfigError, WorkdirError
from experiments.schema import MAX_SEED, given_config
from experiments.sweep_plan import read_record
from experiments.trained import (
    FIRST_ROUND,
    TrainedRun,
    choose_runs,
    field_kind,
    load_run,
    saved_config,
    train_run,
)

PSNR_TOLERANCE = 0.02  # dB; another machine adds up in another order
FLAGS = flags.FLAGS
flags.disclaim_key_flags()  # as in runtime.py

# --- the runs that flags name ----------------------------------------------------------------


def define_flags() -> None:
    """Gives a script the flags of `trained_runs`."""
    runtime.define_cache_flags()
    runtime.define_config_flag(
        "What to train first where --workdir does not hold it yet, such as "
        "experiments/configs/quickstart.py; without, runs in --workdir are taken up as they are"
    )
    flags.DEFINE_string("workdir", None, "Folder of runs of active_selection, or of new ones.")
    flags.DEFINE_string(
        "policy", "", "Whose field, of the config's first by default; initial: round 0."
    )
    flags.DEFINE_integer("seed", None, "Of which seed; by default all of that policy.", 0, MAX_SEED)
    flags.DEFINE_string("data_dir", "", "Folder of scenes, if it has moved since the run.")


def trained_runs() -> Iterator[TrainedRun]:
    """The runs that the flags name, one after another; one scene and one compilation for all."""
    folder, config = runtime.given_folder("workdir", "the folder of a run"), given_config()
    runtime.start_cache()
    is_new = config is not None
    if is_new:
        if FLAGS.data_dir:
            raise ConfigError("--data_dir: with --config, give --config.data_dir in its place")
        # A config without rounds ends where all policies begin.
        policy = FLAGS.policy or (config.policies[0] if config.num_rounds else FIRST_ROUND)
        field_kind(policy)  # an unknown policy ends here, before anything is written
        check_claim(folder, config)
        seeds = config.seeds if FLAGS.seed is None else (FLAGS.seed,)
        chosen = [(policy, seed) for seed in seeds]
    else:
        config = saved_config(folder)
        chosen = choose_runs(folder, config, FLAGS.policy, FLAGS.seed)
        config.data_dir = FLAGS.data_dir or config.data_dir
    scene = load_config_scene(config, cache_dir=runtime.scene_cache())
    if is_new:
        check_views(config, scene)
    problem = Problem(config, scene, field_kind(chosen[0][0]))
    if is_new:
        claim(folder, config)
    for policy, seed in chosen:
        if is_new:
            run = train_run(config, problem, folder, policy, seed, runtime.command_line())
        else:
            run = load_run(problem, folder, policy, seed)
        state = "the end of" if run.completed else "the last checkpoint of"
        print(f"{scene.name}: {state} {run.label}, {len(run.training_views)} training views")
        yield run


def measure_runs(measure: Callable[[TrainedRun], dict], name: str) -> None:
    """Measures the runs one after another; each is a row of the file `name` in --workdir."""
    path, rows = pathlib.Path(FLAGS.workdir or "") / name, []
    for run in trained_runs():
        start = time.monotonic()
        measured = measure(run)
        rows.append({"seconds": time.monotonic() - start, **measured})
        # Written after each run, so that a command that is stopped leaves what it has measured.
        write_rows(path, run, rows)
    print(f"numbers: {path}\n{collected_text(FILES[name](path))}")


def write_rows(path: pathlib.Path, run: TrainedRun, rows: list[dict]) -> None:
    """A result file: a row for each run of a folder, with all that made it; `run` is the last."""
    about = {
        "policy": run.policy,
        "seed": run.seed,
        "completed": run.completed,
        "round": int(run.state.round),
        "num_views": len(run.training_views),
    }
    rows[-1] = {**about, **rows[-1]}
    result = {
        "schema_version": 1,
        "scene": run.problem.scene.name,
        "kind": run.problem.config.loader,
        "config": run.problem.config.to_dict(),
        **runtime.made_by(),
        "rows": rows,
    }
    write_json(path, result)


# --- draws from the posterior (Fig 3) ----------------------------------------------------------


def farthest_view(run: TrainedRun, view_ids) -> int:
    """The view whose camera is farthest from its nearest training camera."""
    positions, is_training = run.state.table.cameras.positions, run.state.is_training_view
    return int(view_ids[nearest_distances(positions[view_ids], positions, is_training).argmax()])


def draw_views(
    run: TrainedRun, view_ids, *, num_draws: int, scale: float, limit
) -> tuple[list[dict], float]:
    """Renders views [n] of the pixel table, training views among them, at the mode and D draws.

    Args:
      scale: temperature of `draw_offsets`; 0 takes `noise_scale` of the training views shown.
      limit: largest offset, scene units.

    Returns:
      Of each view `view_id`, images of the mode (`theta = 0`) with the run's "uncertainty", and
      "draws" [D, H, W, 3]; and the scale.
    """
    train, setup = run.state.train, run.problem.setup
    jac_sq_sum, laplace = run.curvature(), setup.laplace
    with run.track(view_ids, f"{len(view_ids)} views") as bar:
        modes = run.problem.render(train, jac_sq_sum, run.num_rays)
        images = run.render(modes, view_ids, bar.advance)
    if not scale:
        squares = []
        for view, image in zip(view_ids, images):
            truth, mask = run.photo(view)
            if run.state.is_training_view[view]:
                squares.append(np.square(image["rgb"] - truth)[mask].mean())
        scale = float(noise_scale(np.mean(squares), run.num_rays))

    displaced, by_draw = make_displaced_render_fn(setup.model, setup.grid), []
    precision = posterior_precision(
        jac_sq_sum,
        num_rays=run.num_rays,
        prior_weight=laplace.prior_weight,
        weighting=laplace.weighting,
    )
    with run.track(view_ids, f"{num_draws} draws", num_draws) as bar:
        for draw in range(num_draws):
            key = jax.random.fold_in(stream_key(run.seed, "draws"), draw)
            (theta,) = draw_offsets(key, precision, 1, scale=scale, limit=limit)
            moved = run.render(partial(displaced, train.model, theta), view_ids, bar.advance)
            by_draw.append([image["rgb"] for image in moved])
    views = [
        {**image, "view_id": int(view), "draws": np.stack(draws)}
        for view, image, draws in zip(view_ids, images, zip(*by_draw))
    ]
    return views, scale


def spread_measures(views: list[dict]) -> dict[str, float | None]:
    """How far pixels move, and whether they do so where the uncertainty says.

    Over the pixels of all views whose opacity at the mode is at least `MIN_OPACITY`; `spread_all`
    is over all pixels. `rank_correlation` is Spearman's, of the spread over draws with the rendered
    uncertainty; None where either is the same everywhere.
    """
    spread = np.concatenate([np.ravel(colour_deviation(view["draws"])) for view in views])
    opacity, uncertainty = (
        np.concatenate([view[name].ravel() for view in views])
        for name in ("opacity", "uncertainty")
    )
    covered = opacity >= MIN_OPACITY
    moved, uncertain = spread[covered], uncertainty[covered]
    varies = covered.any() and np.ptp(moved) > 0 and np.ptp(uncertain) > 0
    return {
        "num_views": len(views),
        "num_covered_pixels": int(covered.sum()),
        "spread": float(moved.mean()) if covered.any() else None,
        "spread_all": float(spread.mean()),
        "rank_correlation": float(spearmanr(moved, uncertain).statistic) if varies else None,
    }


# --- LPIPS for runs that have ended without it -------------------------------------------------


def remeasure(
    folder: pathlib.Path,
    command: str,
    *,
    lpips_net: str = "alex",
    policies: Sequence[str] = (),
    data_dir: str = "",
) -> None:
    """Measures every setting of a sweep, or the one experiment that the folder holds.

    Of all policies, if none is named, and with the scenes of the runs, unless `data_dir` is where
    they are now. The `command` is noted in the result files. Raises ConfigError if LPIPS is not
    installed or a policy has no finished run.
    """
    record = read_record(folder)
    names = ["."] if record is None else [row["folder"] for row in record.settings]
    for setting in [folder / name for name in names]:
        config = saved_config(setting)
        config.lpips_net, config.data_dir = lpips_net, data_dir or config.data_dir
        ended = [result for result in collect(setting)["runs"] if is_completed(result)]
        known = {result["policy"] for result in ended}
        if unknown := [policy for policy in policies if policy not in known]:
            raise ConfigError(f"--policy: {unknown[0]}: {setting} holds no finished run of it")
        chosen = [result for result in ended if result["policy"] in (policies or known)]
        todo = [result for result in chosen if not _has_lpips(result, lpips_net)]
        if not todo:
            print(f"{setting}: nothing is left to measure")
            continue
        scene = load_config_scene(config, cache_dir=runtime.scene_cache())
        problems: dict[str, Problem] = {}
        for number, result in enumerate(todo, start=1):
            kind = field_kind(result["policy"])
            if kind not in problems:
                problems[kind] = Problem(config, scene, kind)
            if problems[kind].lpips_fn is None:
                raise ConfigError(f"--lpips_net: {problems[kind].lpips_reason}")
            run = load_run(problems[kind], setting, result["policy"], result["seed"])
            _measure_run(run, result, f"{run.label} ({number} of {len(todo)})", command)
        collect(setting)
        print(f"report: {write_report(setting)}")


def _has_lpips(result: dict, net: str) -> bool:
    """Whether a result holds the LPIPS of this network."""
    own = result.get("lpips_net", result["config"]["lpips_net"])
    return own == net and result["rounds"][-1]["lpips"] is not None


def _measure_run(run: TrainedRun, result: dict, label: str, command: str) -> None:
    """Measures one run's last field, whose PSNR must be the known one; rewrites its result file."""
    config, path, last = run.problem.config, run.folder / "result.json", result["rounds"][-1]
    measures = measure_test_views(run.problem, run.state.train, config.num_test_final, label)
    if not abs(measures["psnr"] - last["psnr"]) < PSNR_TOLERANCE:
        raise WorkdirError(
            f"{path}: psnr: the run had {last['psnr']:.2f} dB, its checkpoint has "
            f"{measures['psnr']:.2f} dB on the views that are there now: give the run's own scene "
            "with --data_dir"
        )
    last["lpips"] = measures["lpips"]
    result |= {"lpips_reason": None, "lpips_net": config.lpips_net, "remeasured_by": command}
    write_json(path, result)
    print(f"{label}: LPIPS {measures['lpips']:.4f}, PSNR {measures['psnr']:.2f} dB as before")
