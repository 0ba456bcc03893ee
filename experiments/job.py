"""Which devices a script uses: one, several of this machine, or those of several processes.

With `--coordinator`, start the same command once for each process, on machines that share the
working folder: all of them compute, the first one writes. Without it, `--devices=0` takes all
devices that JAX finds.
"""

from __future__ import annotations

import os
import socket
import sys
import threading
from collections import Counter

import jax
from absl import flags
from jax.sharding import Mesh

from bavs_jax.devices import make_mesh
from experiments.errors import ConfigError, shown
from experiments.signals import is_first_process

FLAGS = flags.FLAGS
flags.DEFINE_integer("devices", 1, "Devices that share the rays of one run; 0: all there are.", 0)
flags.DEFINE_string(
    "coordinator",
    "",
    "host:port of the first process, for a run by several processes; all devices are used then.",
)
flags.DEFINE_integer("num_processes", 1, "With --coordinator: how many processes there are.", 1)
flags.DEFINE_integer("process_id", 0, "With --coordinator: which one this is, from 0 on.", 0)
flags.DEFINE_integer(
    "join_seconds", 300, "With --coordinator: how long to wait for the other processes.", 1, 86400
)


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
        _join_others()
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


def _join_others() -> None:
    """Waits for all processes, at most `--join_seconds`.

    JAX itself ends with a dump of its stack where they do not meet, so that does not come to pass.
    """
    address = FLAGS.coordinator
    host, _, port = address.rpartition(":")
    try:
        is_known = bool(host) and 0 < int(port) < 65536
        is_known = is_known and bool(socket.getaddrinfo(host.strip("[]"), int(port)))
    except (ValueError, OSError):
        is_known = False
    if not is_known:
        raise ConfigError(
            f"--coordinator: {shown(address)} is no host:port that is known here; give that of the "
            "first process, such as 10.0.0.1:1234"
        )

    def give_up():
        reason = f"after {FLAGS.join_seconds} s not all {FLAGS.num_processes} processes have met"
        print(f"error: --coordinator: {reason} at {address}", file=sys.stderr, flush=True)
        os._exit(1)

    timer = threading.Timer(FLAGS.join_seconds, give_up)
    timer.daemon = True
    timer.start()
    jax.distributed.initialize(
        address,
        FLAGS.num_processes,
        FLAGS.process_id,
        initialization_timeout=FLAGS.join_seconds + 60,
    )
    timer.cancel()


def _in_words(mesh: Mesh | None) -> str:
    devices = [jax.devices()[0]] if mesh is None else mesh.devices.ravel().tolist()
    counts = Counter(device.device_kind for device in devices)
    kinds = ", ".join(f"{num} x {kind}" for kind, num in counts.items())
    num_processes = len({device.process_index for device in devices})
    return kinds if num_processes == 1 else f"{kinds}, of {num_processes} processes"
