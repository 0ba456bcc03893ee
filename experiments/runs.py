"""All runs of a config in one folder: every policy with every seed, resumable part by part."""

from __future__ import annotations

import pathlib
import time

from jax.sharding import Mesh

from experiments import runtime, workdir
from experiments.build import build_problem
from experiments.build_scene import check_views, load_config_scene
from experiments.files import exclusive
from experiments.reporting.report import write_report
from experiments.runner import Run
from experiments.signals import is_first_process
from experiments.workdir import all_parts, find_part


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
