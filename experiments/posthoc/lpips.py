"""LPIPS for runs that have ended without it, from the fields that they left behind."""

import pathlib
from collections.abc import Sequence

from experiments import runtime
from experiments.build import Problem, load_config_scene
from experiments.evaluate import measure_test_views
from experiments.files import collect, is_completed, write_json
from experiments.reporting.report import write_report
from experiments.runtime import ConfigError, WorkdirError
from experiments.sweep_plan import read_record
from experiments.trained import TrainedRun, field_kind, load_run, saved_config

PSNR_TOLERANCE = 0.02  # dB; another machine adds up in another order


def remeasure(
    folder: pathlib.Path,
    command: str,
    *,
    lpips_net: str = "alex",
    policies: Sequence[str] = (),
    data_dir: str = "",
) -> None:
    """Every setting of a sweep, or the one experiment that the folder holds.

    Args:
      folder: of the runs.
      command: that is noted in their result files.
      lpips_net: network of LPIPS.
      policies: whose runs; none: all.
      data_dir: where scenes are; empty: where the runs had them.

    Raises:
      ConfigError: LPIPS is not installed, or there is no finished run of a policy.
      WorkdirError, SceneError: the folder or the scene cannot be used.
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
    """Measures one run's last field and rewrites its result file.

    Raises:
      WorkdirError: the field does not have the PSNR that its result says.
    """
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
