"""Trains a field on few views, chooses the next ones by several policies, and compares them.

    python -m experiments.active_selection \\
        --config=experiments/configs/quickstart.py --workdir=runs/quickstart

Any option of the config can be given as a flag, such as --config.seeds='(0,1,2)'. A run that was
stopped goes on when it is started again with the same --workdir.
"""

from absl import flags

from bavs_jax.selection.policies import POLICIES
from experiments import runner, runtime
from experiments.schema import given_config

FLAGS = flags.FLAGS
runtime.define_cache_flags()
runtime.define_device_flags()
runtime.define_config_flag("What to run, such as experiments/configs/quickstart.py")
flags.DEFINE_string("workdir", None, "Folder for results, checkpoints and report.html.")
flags.DEFINE_string(
    "part", None, "Make just this sub-folder, such as bavs/seed_0, without summary and report."
)
flags.DEFINE_bool("end_with_stdin", False, "Stop when standard input is closed.")
flags.DEFINE_bool("list_policies", False, "Print the known acquisition policies and stop.")


def main() -> None:
    if FLAGS.list_policies:
        for name, policy in POLICIES.items():
            print(f"{name:24} {policy.summary}")
        return
    config = given_config("experiments/configs/quickstart.py")
    folder = runtime.given_folder("workdir", "a folder for the results")
    runtime.start_cache()
    if FLAGS.end_with_stdin:
        runtime.end_with_parent()
    mesh = runtime.start_devices()
    runner.run_all(config, folder, runtime.command_line(), mesh, only=FLAGS.part)


if __name__ == "__main__":
    runtime.run_script(main)
