"""Measures how fast every stage is, how near to what the machine can do, and how it grows.

    python -m experiments.benchmark --workdir=runs/benchmark
    python -m experiments.benchmark --workdir=runs/benchmark_lego \\
        --config=experiments/configs/blender.py --config.data_dir=FOLDER

Trains a field to its end, then measures training, rendering, curvature, scoring and selection, each
compiled anew, and writes `benchmark.json` and `benchmark.html`. `experiments/bench/work.py` says
what is counted. Other programs on the machine make every number worse.
"""

from __future__ import annotations

import jax
from absl import flags
from ml_collections import config_flags

from experiments import runtime
from experiments.bench.measure import benchmark
from experiments.bench.results import BENCHMARK, benchmark_tables
from experiments.bench.subject import check_sizes, default_sizes
from experiments.configs import base
from experiments.reporting.tables import collected_text
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
    "How much is measured, as --sizes.name=value; explained in experiments/bench/settings.py.",
)
flags.DEFINE_string("workdir", None, "Folder for benchmark.json, benchmark.html and the trace.")
flags.DEFINE_integer("num_views", 20, "Training views.", 1)
flags.DEFINE_bool("growth", True, "Measure how each stage grows too.")
flags.DEFINE_bool("profile", False, "Write a trace of one run of each stage to WORKDIR/trace.")


def main() -> None:
    config, folder = given_config(), runtime.given_folder("workdir", "a folder for the results")
    check_sizes(FLAGS.sizes)
    # Times of compilation are those of a first start, whatever an earlier one has left behind.
    jax.config.update("jax_enable_compilation_cache", False)
    result = benchmark(
        config,
        FLAGS.sizes,
        folder,
        num_views=FLAGS.num_views,
        growth=FLAGS.growth,
        profile=FLAGS.profile,
        command=runtime.command_line(),
    )
    print(collected_text(benchmark_tables(folder / BENCHMARK)))
    print(f"numbers: {folder / BENCHMARK}")
    print(f"page:    {folder / 'benchmark.html'}  ({result['total_s']:.0f} s in all)")
    if FLAGS.profile:
        print(f"trace:   {folder / 'trace'}, for Perfetto or TensorBoard")


if __name__ == "__main__":
    runtime.run_script(main)
