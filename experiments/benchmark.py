"""Measures how fast every stage is, how near to what the machine can do, and how it grows.

    python -m experiments.benchmark --workdir=runs/benchmark
    python -m experiments.benchmark --workdir=runs/benchmark_lego \\
        --config=experiments/configs/blender.py --config.data_dir=FOLDER

Trains a field to its end, then measures training, rendering, curvature, scoring and selection, each
compiled anew, and writes `benchmark.json` and `benchmark.html`. `experiments/bench/work.py` says
what is counted. Other programs on the machine make every number worse.
"""

from __future__ import annotations

import pathlib
import sys
import time

import jax
from absl import flags
from ml_collections import config_flags

from experiments import runtime
from experiments.bench import stages
from experiments.bench.ceilings import measure_ceilings
from experiments.bench.growth import all_series, measure_growth
from experiments.bench.page import benchmark_sections, write_page
from experiments.bench.results import BENCHMARK, STAGES, bench_tables
from experiments.bench.settings import default_sizes
from experiments.bench.subject import make_subject, train_field
from experiments.build_scene import load_config_scene
from experiments.configs import base
from experiments.errors import USER_ERRORS
from experiments.files import write_json
from experiments.machine import device_name, peak_device_memory_mb, peak_memory_mb, versions
from experiments.progress import track

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
    "How much is measured, as --sizes.name=value; explained in experiments/bench/settings.py.",
)
flags.DEFINE_string("workdir", None, "Folder for benchmark.json, benchmark.html and the trace.")
flags.DEFINE_integer("num_views", 20, "Training views.")
flags.DEFINE_bool("growth", True, "Measure how each stage grows too.")
flags.DEFINE_bool("profile", False, "Write a trace of one run of each stage to WORKDIR/trace.")

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
    scene = load_config_scene(config, cache_dir=str(runtime.cache_folder() / "scenes"))
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


def main() -> None:
    if not FLAGS.workdir:
        sys.exit("error: --workdir: is missing; name a folder for the results")
    # Times of compilation are those of a first start, whatever an earlier one has left behind.
    jax.config.update("jax_enable_compilation_cache", False)
    folder = pathlib.Path(FLAGS.workdir)
    try:
        result = benchmark(
            FLAGS.config,
            FLAGS.sizes,
            folder,
            num_views=FLAGS.num_views,
            growth=FLAGS.growth,
            profile=FLAGS.profile,
            command=runtime.command_line(),
        )
    except USER_ERRORS as error:
        sys.exit(f"error: {error}")
    print(bench_tables(folder))
    print(f"numbers: {folder / BENCHMARK}")
    print(f"page:    {folder / 'benchmark.html'}  ({result['total_s']:.0f} s in all)")
    if FLAGS.profile:
        print(f"trace:   {folder / 'trace'}, for Perfetto or TensorBoard")


if __name__ == "__main__":
    runtime.run_script(main)
