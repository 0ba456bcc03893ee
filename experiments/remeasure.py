"""Measures the finished runs of a folder once more: with LPIPS, which they may have gone without.

    python -m experiments.remeasure --workdir=runs/lego --lpips_net=alex

Renders the last round's test views from each run's last checkpoint and writes the measures into its
result.json and the folder's summary. What was measured then must come out again, so that fields and
files of another scene are noticed. What has been measured by the same network is left alone.
"""

from absl import flags

from bavs_jax.metrics.perceptual import NETS
from experiments import runtime
from experiments.posthoc import remeasure

FLAGS = flags.FLAGS
runtime.define_cache_flags()
flags.DEFINE_string("workdir", None, "Folder of experiments.active_selection or of a sweep.")
flags.DEFINE_enum("lpips_net", "alex", [*NETS], "Network of LPIPS; alex is the usual one.")
flags.DEFINE_list("policy", [], "Of which policies; by default all.")
flags.DEFINE_string("data_dir", "", "Folder of scenes, if it has moved since the runs.")


def main() -> None:
    folder = runtime.given_folder("workdir", "the folder of an experiment", exists=True)
    runtime.start_cache()
    options = {"policies": FLAGS.policy, "data_dir": FLAGS.data_dir}
    remeasure(folder, runtime.command_line(), lpips_net=FLAGS.lpips_net, **options)


if __name__ == "__main__":
    runtime.run_script(main)
