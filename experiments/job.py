"""Which devices a script uses: one, several of this machine, or those of several processes.

With `--coordinator`, start the same command once for each process, on machines that share the
working folder: all of them compute, the first one writes. Without it, `--devices=0` takes all
devices that JAX finds.
"""

from __future__ import annotations

import os
import sys
from collections import Counter

import jax
from absl import flags
from jax.sharding import Mesh

from bavs_jax.devices import make_mesh
from experiments.errors import ConfigError
from experiments.processes import is_first_process

FLAGS = flags.FLAGS
flags.DEFINE_integer("devices", 1, "Devices that share the rays of one run; 0: all there are.")
flags.DEFINE_string(
    "coordinator",
    "",
    "host:port of the first process, for a run by several processes; all devices are used then.",
)
flags.DEFINE_integer("num_processes", 1, "With --coordinator: how many processes there are.")
flags.DEFINE_integer("process_id", 0, "With --coordinator: which one this is, from 0 on.")


def start_job() -> Mesh | None:
    """Joins the other processes, says which devices are used, and makes their mesh.

    Must come before anything is computed. Processes other than the first print nothing.

    Raises:
      ConfigError: flags that cannot be used.
    """
    if not FLAGS.coordinator and FLAGS.num_processes != 1:
        raise ConfigError("--num_processes: needs --coordinator, the host:port of the first one")
    if FLAGS.coordinator:
        if not 0 <= FLAGS.process_id < FLAGS.num_processes:
            raise ConfigError(
                f"--process_id: {FLAGS.process_id} is not below --num_processes, "
                f"{FLAGS.num_processes}; number them from 0 on"
            )
        jax.distributed.initialize(FLAGS.coordinator, FLAGS.num_processes, FLAGS.process_id)
        if not is_first_process():
            sys.stdout = open(os.devnull, "w")  # noqa: SIM115, open as long as the process is
    try:
        mesh = make_mesh(0 if FLAGS.coordinator else FLAGS.devices)
    except ValueError as error:
        raise ConfigError(
            f"--devices: {error}; on a CPU, XLA_FLAGS=--xla_force_host_platform_device_count=N "
            "makes N of them"
        ) from None
    print(f"devices: {_in_words(mesh)}")
    return mesh


def _in_words(mesh: Mesh | None) -> str:
    devices = [jax.devices()[0]] if mesh is None else mesh.devices.ravel().tolist()
    counts = Counter(device.device_kind for device in devices)
    kinds = ", ".join(f"{num} x {kind}" for kind, num in counts.items())
    num_processes = len({device.process_index for device in devices})
    return kinds if num_processes == 1 else f"{kinds}, of {num_processes} processes"
