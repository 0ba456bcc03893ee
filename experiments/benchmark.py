"""Measures how fast every stage is.

    python -m experiments.benchmark --workdir=runs/benchmark
    python -m experiments.benchmark --workdir=runs/benchmark_lego \\
        --config=experiments/configs/blender.py --config.data_dir=FOLDER

Trains a field to its end, then measures training, rendering, curvature, scoring and selection, each
compiled anew, and writes `benchmark.json` and `benchmark.html`. Other programs on the machine make
every number worse; what a matrix product and a copy reach at the same time is noted, too.
"""

import pathlib
import time

import jax
from absl import flags
from ml_collections import config_flags

from experiments import runtime, stages
from experiments.build import load_config_scene
from experiments.configs import base
from experiments.reporting.benchmark import BENCHMARK, write_result
from experiments.schema import given_config

FLAGS = flags.FLAGS
runtime.define_config_flag("Scene, field and training", base.__file__)
SIZES = "How much is measured, as --sizes.name=value; see experiments/stages.py."
config_flags.DEFINE_config_dict("sizes", stages.default_sizes(), SIZES)
flags.DEFINE_string("workdir", None, "Folder for benchmark.json, benchmark.html and the trace.")
flags.DEFINE_integer("num_views", 20, "Training views.", 1)
flags.DEFINE_bool("profile", False, "Write a trace of one run of each stage to WORKDIR/trace.")


def benchmark(config, sizes, folder: pathlib.Path) -> None:
    """Measures everything and writes the files."""
    start = time.monotonic()
    scene = load_config_scene(config, cache_dir=runtime.scene_cache())
    subject = stages.Subject(config, scene, FLAGS.num_views)
    found, samples, runs = stages.measure_stages(subject, sizes)
    # Before what a user's run does not do.
    memory = {
        "peak_memory_mb": runtime.peak_memory_mb(),
        "peak_device_memory_mb": runtime.peak_device_memory_mb(),
    }
    ceilings = stages.measure_ceilings(sizes)
    if FLAGS.profile:
        with jax.profiler.trace(str(folder / "trace")):
            for name, run in runs.items():
                with jax.profiler.TraceAnnotation(name):
                    jax.block_until_ready(run())
    result = {
        "schema_version": 1,
        "train_rays_per_s": found["train"]["rays_per_s"],
        "train_samples_per_s": samples,
        "render_rays_per_s": found["render"]["rays_per_s"],
        "curvature_rays_per_s": found["curvature"]["rays_per_s"],
        "candidates_per_s": found["score"]["candidates_per_s"],
        "batch_select_ms": 1e3 / found["select"]["batches_per_s"],
        **memory,
        "stages": found,
        "ceilings": ceilings,
        "scene": scene.name,
        "num_views": FLAGS.num_views,
        "sizes": sizes.to_dict(),
        "config": config.to_dict(),
        **runtime.made_by(),
        "total_s": time.monotonic() - start,
    }
    write_result(folder / BENCHMARK, result, "How fast bavs_jax is")
    if FLAGS.profile:
        print(f"trace:   {folder / 'trace'}, for Perfetto or TensorBoard")


def main() -> None:
    config, folder = given_config(), runtime.given_folder("workdir", "a folder for the results")
    stages.check_sizes(FLAGS.sizes)
    config.lpips_net = ""
    # Times of compilation are those of a first start, whatever an earlier one has left behind.
    jax.config.update("jax_enable_compilation_cache", False)
    benchmark(config, FLAGS.sizes, folder)


if __name__ == "__main__":
    runtime.run_script(main)
