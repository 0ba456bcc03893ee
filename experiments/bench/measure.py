"""The whole benchmark of one scene, from the data to the result file and its page."""

from __future__ import annotations

import pathlib
import time

import jax

from experiments import runtime
from experiments.bench import stages
from experiments.bench.growth import all_series, measure_growth
from experiments.bench.page import benchmark_sections, write_page
from experiments.bench.results import BENCHMARK, STAGES
from experiments.bench.subject import make_subject, train_field
from experiments.bench.timing import measure_ceilings
from experiments.build_scene import load_config_scene
from experiments.files import write_json
from experiments.machine import device_name, peak_device_memory_mb, peak_memory_mb, versions
from experiments.progress import track

SCHEMA_VERSION = 1


def benchmark(
    config,
    sizes,
    folder: pathlib.Path,
    *,
    num_views: int,
    growth: bool,
    profile: bool,
    command: str,
) -> dict:
    """Measures everything and writes the files; returns what `benchmark.json` holds.

    Args:
      config: see `experiments/configs/base.py`.
      sizes: see `experiments/bench/settings.py`.
      folder: for results.
      num_views: training views.
      growth: whether to measure how each stage grows.
      profile: whether to write a trace.
      command: how this was called.
    """
    start = time.monotonic()
    scene = load_config_scene(config, cache_dir=runtime.scene_cache())
    subject = make_subject(config, scene, num_views)
    compile_seconds = stages.training_compile_seconds(subject)
    state = train_field(subject)

    with track(len(STAGES) + 1, "measure", "stages") as bar:
        train, samples_per_s = stages.measure_training(subject, state, sizes, compile_seconds)
        bar.advance(1)
        render = stages.measure_rendering(subject, state, sizes)
        bar.advance(1)
        curvature = stages.measure_curvature(subject, state, sizes)
        bar.advance(1)
        jac_sq_sum = curvature.run()
        score = stages.measure_scoring(subject, state, jac_sq_sum, sizes)
        bar.advance(1)
        select = stages.measure_selection(subject, sizes)
        bar.advance(1)
        # Before what a user's run does not do.
        memory = {
            "peak_memory_mb": peak_memory_mb(),
            "peak_device_memory_mb": peak_device_memory_mb(),
        }
        ceilings = measure_ceilings(
            matmul=sizes.matmul, copy_mb=sizes.copy_mb, repeats=sizes.repeats
        )
        bar.advance(1)
    measured = {stage.name: stage for stage in (train, render, curvature, score, select)}
    if profile:
        with jax.profiler.trace(str(folder / "trace")):
            for stage in measured.values():
                with jax.profiler.TraceAnnotation(stage.name):
                    jax.block_until_ready(stage.run())
    grown = {}
    if growth:
        series = all_series(subject, state, jac_sq_sum, sizes.curvature_rays, sizes)
        grown = measure_growth(series, sizes.growth.repeats)

    result = {
        "schema_version": SCHEMA_VERSION,
        "device": device_name(),
        "train_rays_per_s": train.rate,
        "train_samples_per_s": samples_per_s,
        "render_rays_per_s": render.rate,
        "curvature_rays_per_s": curvature.rate,
        "candidates_per_s": score.rate,
        "batch_select_ms": 1e3 / select.rate,
        **memory,
        "stages": {name: stage.numbers(ceilings) for name, stage in measured.items()},
        "ceilings": {
            "matmul_flops_per_s": ceilings.flops_per_s,
            "copy_bytes_per_s": ceilings.bytes_per_s,
        },
        "growth": grown,
        "scene": scene.name,
        "num_views": num_views,
        "sizes": sizes.to_dict(),
        "config": config.to_dict(),
        "command": command,
        "versions": versions(),
        "total_s": time.monotonic() - start,
    }
    write_json(folder / BENCHMARK, result)
    title = f"How fast bavs_jax is: {scene.name}, {num_views} views"
    write_page(
        folder / "benchmark.html",
        title=title,
        made=result,
        sections=benchmark_sections(result),
    )
    return result
