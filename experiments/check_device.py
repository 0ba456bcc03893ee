"""Checks that an accelerator gives the numbers that the CPU beside it gives.

    python -m experiments.check_device --workdir=runs/check_device

Trains each kind of field for a moment on the CPU, hands its state to both devices, and compares
what they make of it: one more step's loss and gradient, images, curvature, scores, and the views
that are chosen. Differences are `|a - b| / |b|` with Euclidean norms over all values. Ends with an
error where one is above `--tolerance`, or other views are chosen. JAX multiplies matrices with
fewer digits on some accelerators; JAX_DEFAULT_MATMUL_PRECISION=highest in the environment asks for
all of them.
"""

import sys

import jax
from absl import flags

from experiments import runtime, stages
from experiments.files import write_json
from experiments.reporting.result_tables import DEVICE_FILE, differences_table
from experiments.reporting.tables import markdown
from experiments.runtime import ConfigError

FLAGS = flags.FLAGS
flags.DEFINE_string("workdir", None, "Folder for check_device.json.")
flags.DEFINE_float("tolerance", 1e-4, "Largest relative difference.", 0.0)
flags.DEFINE_list("fields", [], "Which fields to check; all of them if left out.")


def main() -> None:
    folder = runtime.given_folder("workdir", "a folder for the results")
    known = [*stages.FIELDS]
    if unknown := sorted({*FLAGS.fields} - {*known}):
        raise ConfigError(f"--fields: unknown {unknown}; known: {', '.join(known)}")
    device = jax.devices()[0]
    if device.platform == "cpu":
        raise ConfigError(
            "JAX_PLATFORMS: JAX sees no device but the CPU, so there is nothing to compare; "
            "install JAX for the accelerator"
        )
    path, found, wrong = folder / DEVICE_FILE, {}, []
    for name in FLAGS.fields or known:
        found[name] = stages.check_field(name, device, jax.devices("cpu")[0])
        wrong = stages.too_large(found, FLAGS.tolerance)
        result = {
            "schema_version": 1,
            **runtime.made_by(),
            "matmul_precision": str(jax.config.jax_default_matmul_precision or "default"),
            "tolerance": FLAGS.tolerance,
            "differences": found,
            "above_tolerance": wrong,
        }
        write_json(path, result)
    print(f"numbers: {path}\n{markdown(differences_table(found))}")
    if wrong:
        sys.exit(f"error: {runtime.device_name()} differs from the CPU in {'; '.join(wrong)}")


if __name__ == "__main__":
    runtime.run_script(main)
