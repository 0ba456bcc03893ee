"""Checks that an accelerator gives the numbers that the CPU beside it gives.

    python -m experiments.check_device --workdir=runs/check_device

Trains each kind of field for a moment on the CPU, hands its state to both devices, and compares
what they make of it: one more step's loss and gradient, images, curvature, scores, and the views
that are chosen. Differences are `|a - b| / |b|` with Euclidean norms over all values. Ends with an
error where one is above `--tolerance`, or other views are chosen. JAX multiplies matrices with
fewer digits on some accelerators; JAX_DEFAULT_MATMUL_PRECISION=highest in the environment asks for
all of them.
"""

from __future__ import annotations

import sys

import jax
from absl import flags

from experiments import runtime
from experiments.bench.same_numbers import (
    DEVICE_FILE,
    FIELDS,
    check_field,
    differences_table,
    too_large,
)
from experiments.files import write_json
from experiments.reporting.tables import FORMATS
from experiments.runtime import ConfigError, device_name, versions

FLAGS = flags.FLAGS
flags.DEFINE_string("workdir", None, "Folder for check_device.json.")
flags.DEFINE_float("tolerance", 1e-4, "Largest relative difference.", 0.0)
flags.DEFINE_list("fields", [], "Which fields to check; all of them if left out.")

SCHEMA_VERSION = 1


def main() -> None:
    folder = runtime.given_folder("workdir", "a folder for the results")
    unknown = sorted({*FLAGS.fields} - {*FIELDS})
    if unknown:
        raise ConfigError(f"--fields: unknown {unknown}; known: {', '.join(FIELDS)}")
    device = jax.devices()[0]
    if device.platform == "cpu":
        raise ConfigError(
            "JAX_PLATFORMS: JAX sees no device but the CPU, so there is nothing to compare; "
            "install JAX for the accelerator"
        )
    folder.mkdir(parents=True, exist_ok=True)
    path, found = folder / DEVICE_FILE, {}
    for name in FLAGS.fields or FIELDS:
        found[name] = check_field(name, device, jax.devices("cpu")[0])
        result = {
            "schema_version": SCHEMA_VERSION,
            "device": device_name(),
            "matmul_precision": str(jax.config.jax_default_matmul_precision or "default"),
            "tolerance": FLAGS.tolerance,
            "differences": found,
            "above_tolerance": too_large(found, FLAGS.tolerance),
            "command": runtime.command_line(),
            "versions": versions(),
        }
        write_json(path, result)
    print(f"numbers: {path}")
    print(FORMATS["markdown"](differences_table(found)))
    if result["above_tolerance"]:
        wrong = "; ".join(result["above_tolerance"])
        sys.exit(f"error: {result['device']} differs from the CPU in {wrong}")


if __name__ == "__main__":
    runtime.run_script(main)
