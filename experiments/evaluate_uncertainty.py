"""Trains fields on few views, or takes up a run, and measures how well uncertainty tells error.

    python -m experiments.evaluate_uncertainty \\
        --config=experiments/configs/uncertainty.py --workdir=runs/uncertainty

Every uncertainty model is measured on test views by AUSE in all its variants, on its own field and
on one common field; and its uncertainty is turned into calibrated intervals of colour and depth.
Started again it goes on with what is missing, also in a folder of `experiments.active_selection`
with the same config.
"""

import pathlib
import time

from absl import flags

from experiments import runtime
from experiments.build import Problem, check_views, load_config_scene
from experiments.files import check_claim, claim
from experiments.schema import given_config
from experiments.uncertainty import measure_seed, write_summary

FLAGS = flags.FLAGS
runtime.define_cache_flags()
runtime.define_config_flag("What to measure, such as experiments/configs/uncertainty.py")
flags.DEFINE_string("workdir", None, "Folder for fields, uncertainty.json and uncertainty.html.")


def evaluate(config, folder: pathlib.Path, command: str) -> None:
    """All seeds, then the summary and the page."""
    start = time.monotonic()
    check_claim(folder, config)
    scene = load_config_scene(config, cache_dir=runtime.scene_cache())
    check_views(config, scene)
    problem = Problem(config, scene)
    claim(folder, config)
    for seed in config.seeds:
        measure_seed(config, problem, folder, seed, command)
    numbers, page = write_summary(config, scene, folder, command)
    print(f"numbers: {numbers}")
    print(f"page:    {page}  ({time.monotonic() - start:.0f} s in all)")


def main() -> None:
    config = given_config("experiments/configs/uncertainty.py")
    folder = runtime.given_folder("workdir", "a folder for the results")
    runtime.start_cache()
    evaluate(config, folder, runtime.command_line())


if __name__ == "__main__":
    runtime.run_script(main)
