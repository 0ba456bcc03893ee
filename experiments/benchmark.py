"""Measures how fast every stage is, and how its time grows.

    python -m experiments.benchmark --workdir=runs/benchmark
    python -m experiments.benchmark --workdir=runs/benchmark_lego \\
        --config=experiments/configs/blender.py --config.data_dir=FOLDER

Trains a field to its end, then measures training, rendering, curvature, scoring and selection, each
compiled anew, and writes `benchmark.json` and `benchmark.html`. Other programs on the machine make
every number worse; what a matrix product and a copy reach at the same time is noted, too.
"""

from __future__ import annotations

import pathlib
import time

import jax
from absl import flags
from ml_collections import config_flags

from experiments import runtime
from experiments.bench import stages
from experiments.bench.results import BENCHMARK, STAGES, benchmark_tables, write_benchmark_page
from experiments.bench.subject import (
    check_sizes,
    default_sizes,
    draw_candidates,
    make_subject,
    train_field,
)
from experiments.build import load_config_scene
from experiments.configs import base
from experiments.files import write_json
from experiments.reporting.tables import collected_text
from experiments.runtime import device_name, peak_device_memory_mb, peak_memory_mb, track, versions
from experiments.schema import given_config

FLAGS = flags.FLAGS
config_flags.DEFINE_config_file(
    "config",
    base.__file__,
    "The scene, the field and how it is trained; every option is explained in "
    "experiments/configs/base.py and can be set as --config.name=value.",
    lock_config=True,
)
config_flags.DEFINE_config_dict(
    "sizes",
    default_sizes(),
    "How much is measured, as --sizes.name=value; explained in experiments/bench/subject.py.",
)
flags.DEFINE_string("workdir", None, "Folder for benchmark.json, benchmark.html and the trace.")
flags.DEFINE_integer("num_views", 20, "Training views.", 1)
flags.DEFINE_bool("growth", True, "Measure how each stage grows too.")
flags.DEFINE_bool("profile", False, "Write a trace of one run of each stage to WORKDIR/trace.")

SCHEMA_VERSION = 1


def measure_stages(subject, state, sizes, compile_seconds: float):
    """Every stage by name, the training samples per second, and the curvature's sum."""
    rays, repeats = sizes.curvature_rays, sizes.repeats
    found = {}
    with track(len(STAGES), "measure", "stages") as bar:

        def measure(name, unit, amount, run):
            found[name] = stages.measure_stage(unit, amount, run, repeats)
            bar.advance(1)

        found["train"], samples = stages.measure_training(subject, state, sizes, compile_seconds)
        bar.advance(1)
        run = stages.make_rendering_run(subject, state, sizes.render_rays)
        measure("render", "rays", sizes.render_rays, run)
        measure("curvature", "rays", rays, stages.make_curvature_run(subject, state, rays))
        jac_sq_sum = found["curvature"].run()
        cameras = draw_candidates(subject, sizes.candidates, sizes.candidate_pixels)
        run = stages.make_scoring_run(subject, state, jac_sq_sum, rays, cameras)
        measure("score", "candidates", sizes.candidates, run)
        run = stages.make_selection_run(subject, sizes.select_candidates, sizes.batch_size)
        measure("select", "batches", 1.0, run)
    return found, samples, jac_sq_sum


def benchmark(config, sizes, folder: pathlib.Path) -> dict:
    """Measures everything and writes the files; returns what `benchmark.json` holds."""
    start = time.monotonic()
    scene = load_config_scene(config, cache_dir=runtime.scene_cache())
    subject = make_subject(config, scene, FLAGS.num_views)
    compile_seconds = stages.training_compile_seconds(subject)
    state = train_field(subject)
    found, samples, jac_sq_sum = measure_stages(subject, state, sizes, compile_seconds)
    # Before what a user's run does not do.
    memory, device_memory = peak_memory_mb(), peak_device_memory_mb()
    ceilings = stages.measure_ceilings(
        matmul=sizes.matmul, copy_mb=sizes.copy_mb, repeats=sizes.repeats
    )
    if FLAGS.profile:
        with jax.profiler.trace(str(folder / "trace")):
            for name, stage in found.items():
                with jax.profiler.TraceAnnotation(name):
                    jax.block_until_ready(stage.run())
    grown = {}
    if FLAGS.growth:
        series = stages.all_series(subject, state, jac_sq_sum, sizes.curvature_rays, sizes)
        grown = stages.measure_growth(series, sizes.growth.repeats)
    result = {
        "schema_version": SCHEMA_VERSION,
        "device": device_name(),
        "train_rays_per_s": found["train"].rate,
        "train_samples_per_s": samples,
        "render_rays_per_s": found["render"].rate,
        "curvature_rays_per_s": found["curvature"].rate,
        "candidates_per_s": found["score"].rate,
        "batch_select_ms": 1e3 / found["select"].rate,
        "peak_memory_mb": memory,
        "peak_device_memory_mb": device_memory,
        "stages": {name: stage.numbers() for name, stage in found.items()},
        "ceilings": ceilings,
        "growth": grown,
        "scene": scene.name,
        "num_views": FLAGS.num_views,
        "sizes": sizes.to_dict(),
        "config": config.to_dict(),
        "command": runtime.command_line(),
        "versions": versions(),
        "total_s": time.monotonic() - start,
    }
    write_json(folder / BENCHMARK, result)
    write_benchmark_page(folder / "benchmark.html", result)
    return result


def main() -> None:
    config, folder = given_config(), runtime.given_folder("workdir", "a folder for the results")
    check_sizes(FLAGS.sizes)
    # Times of compilation are those of a first start, whatever an earlier one has left behind.
    jax.config.update("jax_enable_compilation_cache", False)
    result = benchmark(config, FLAGS.sizes, folder)
    print(collected_text(benchmark_tables(folder / BENCHMARK)))
    print(f"numbers: {folder / BENCHMARK}")
    print(f"page:    {folder / 'benchmark.html'}  ({result['total_s']:.0f} s in all)")
    if FLAGS.profile:
        print(f"trace:   {folder / 'trace'}, for Perfetto or TensorBoard")


if __name__ == "__main__":
    runtime.run_script(main)
