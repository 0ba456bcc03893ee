"""LPIPS for runs that have ended without it, from the fields that they left behind."""

from __future__ import annotations

import json
import pathlib
from collections.abc import Sequence

from experiments import runtime
from experiments.build import Problem, load_config_scene
from experiments.evaluate import measure_test_views
from experiments.files import collect, is_completed, read_json, write_json
from experiments.reporting.report import write_report
from experiments.runtime import ConfigError, WorkdirError
from experiments.sweeps.plan import read_record
from experiments.trained import TrainedRun, field_kind, find_runs, load_run, saved_config

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
    rows = [{"folder": "."}] if record is None else record.settings
    for setting in [folder / row["folder"] for row in rows]:
        _measure_folder(setting, command, lpips_net, policies, data_dir)


def _measure_folder(folder: pathlib.Path, command: str, lpips_net, policies, data_dir) -> None:
    config = saved_config(folder)
    config.lpips_net = lpips_net
    config.data_dir = data_dir or config.data_dir
    todo = _runs_without(folder, lpips_net, policies)
    if not todo:
        print(f"{folder}: nothing is left to measure")
        return
    scene = load_config_scene(config, cache_dir=runtime.scene_cache())
    problems: dict[str, Problem] = {}
    for number, (policy, seed) in enumerate(todo):
        kind = field_kind(policy)
        if kind not in problems:
            problems[kind] = Problem(config, scene, kind)
        if problems[kind].lpips_fn is None:
            raise ConfigError(f"--lpips_net: {problems[kind].lpips_reason}")
        run = load_run(config, problems[kind], folder, policy, seed)
        measure_run(run, f"{policy} seed {seed} ({number + 1} of {len(todo)})", command)
    collect(folder)
    print(f"report: {write_report(folder)}")


def measure_run(run: TrainedRun, label: str, command: str) -> None:
    """Measures one run's last field and rewrites its result file.

    Raises:
      WorkdirError: the field does not have the PSNR that its result file says.
    """
    num = run.config.num_test_final
    measures = measure_test_views(run.problem, run.state.train, num, label)
    path = run.folder / "result.json"
    result = json.loads(path.read_text(encoding="utf-8"))
    before = result["rounds"][-1]["psnr"]
    if not abs(measures["psnr"] - before) < PSNR_TOLERANCE:
        raise WorkdirError(
            f"{path}: psnr: the run had {before:.2f} dB, its checkpoint has "
            f"{measures['psnr']:.2f} dB on the views that are there now: give the run's own scene "
            "with --data_dir"
        )
    result["rounds"][-1] |= {"lpips": measures["lpips"]}
    result |= {"lpips_reason": None, "lpips_net": run.config.lpips_net, "remeasured_by": command}
    write_json(path, result)
    print(f"{label}: LPIPS {measures['lpips']:.4f}, PSNR {measures['psnr']:.2f} dB as before")


def _runs_without(folder: pathlib.Path, lpips_net: str, policies) -> list[tuple[str, int]]:
    """(policy, seed) of the runs that have ended and lack this network's LPIPS."""
    results = {}
    for policy, seed in find_runs(folder):
        path = folder / policy / f"seed_{seed}" / "result.json"
        result = read_json(path, otherwise="left out; start its run again, which makes it anew")
        results |= {(policy, seed): result} if is_completed(result) else {}
    known = {name for name, _ in results}
    for policy in policies:
        if policy not in known:
            raise ConfigError(f"--policy: {policy}: {folder} holds no finished run of it")
    found = []
    for (policy, seed), result in results.items():
        net = result.get("lpips_net", result["config"]["lpips_net"])
        is_measured = net == lpips_net and result["rounds"][-1]["lpips"] is not None
        if policy in (policies or known) and not is_measured:
            found.append((policy, seed))
    return found
