"""Figures of an experiment as files of their own, for a paper, slides or a page.

    python -m experiments.figures --workdir=runs/lego --format=pdf

Writes to WORKDIR/figures each measure against training views (Figure 6: psnr.pdf) and test views
with their uncertainty (Figure 8: views.pdf), from the result files alone.
"""

from absl import flags

from experiments import runtime
from experiments.reporting.pictures import FORMATS, write_figures

FLAGS = flags.FLAGS
flags.DEFINE_string("workdir", None, "Folder of experiments.active_selection, with summary.json.")
flags.DEFINE_enum("format", "png", [*FORMATS], "Of the files.")
flags.DEFINE_list("policy", [], "Which policies, in this order; by default all.")
flags.DEFINE_integer(
    "num_views", 4, "Most test views in views; a run keeps config.num_pictures.", 1
)


def main() -> None:
    folder = runtime.given_folder("workdir", "the folder of an experiment", exists=True)
    options = {"form": FLAGS.format, "policies": FLAGS.policy, "num_views": FLAGS.num_views}
    for path in write_figures(folder, **options):
        print(path)


if __name__ == "__main__":
    runtime.run_script(main)
