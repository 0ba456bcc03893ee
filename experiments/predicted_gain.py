"""Compares what batches of views were predicted to be worth with what they were worth.

    python -m experiments.predicted_gain --workdir=runs/gain_lego --workdir=runs/gain_sculpture

Reads the result files of finished runs of `experiments.active_selection` that recorded predictions
(--config.predict_gain=True); several folders are taken together, such as one for each scene.
Writes `predicted_gain.json` and `predicted_gain.html` into --out. Definitions: the predicted gain
in bavs_jax/selection/predicted_gain.py, everything else in experiments/predicted/__init__.py.

--planned predicts the batches of any finished runs anew, all from the field of the initial views,
whose checkpoint is still in the folder: as if they had been planned at once.
"""

from __future__ import annotations

import pathlib
import sys

from absl import flags

from experiments import compilation, runtime
from experiments.predicted.compare import PAGE_FILE, compare
from experiments.predicted.results import RESULT_FILE

FLAGS = flags.FLAGS
flags.adopt_module_key_flags(compilation)
flags.DEFINE_multi_string("workdir", [], "Folder of an experiment; may be given several times.")
flags.DEFINE_list("policies", [], "Whose runs to read; by default all.")
flags.DEFINE_bool("planned", False, "Predict all batches from the field of the initial views.")
flags.DEFINE_string("out", None, "Folder for the results; by default the first --workdir.")


def main() -> None:
    if not FLAGS.workdir:
        sys.exit("error: --workdir: is missing; name the folder of a finished experiment")
    folders = [pathlib.Path(folder) for folder in FLAGS.workdir]
    out = runtime.given_folder("out", "a folder for the results") if FLAGS.out else folders[0]
    compilation.start_cache()
    result = compare(
        *(folders, out),
        command=runtime.command_line(),
        policies=FLAGS.policies,
        planned=FLAGS.planned,
    )
    print(f"{len(result['cases'])} batches")
    print(f"numbers: {out / RESULT_FILE}")
    print(f"page:    {out / PAGE_FILE}")


if __name__ == "__main__":
    runtime.run_script(main)
