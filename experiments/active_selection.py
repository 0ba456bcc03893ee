"""Trains a field on few views, chooses the next ones by several policies, and compares them.

    python -m experiments.active_selection \\
        --config=experiments/configs/quickstart.py --workdir=runs/quickstart

Any option of the config can be given as a flag, such as --config.seeds='(0,1,2)'. A run that was
stopped goes on when it is started again with the same --workdir.
"""

import os
import socket
import sys
import threading
from collections import Counter

import jax
from absl import flags
from jax.sharding import Mesh

from bavs_jax.devices import make_mesh
from bavs_jax.selection.policies import POLICIES
from experiments import runner, runtime
from experiments.runtime import ConfigError, shown
from experiments.schema import given_config

FLAGS = flags.FLAGS
runtime.define_cache_flags()
runtime.define_config_flag("What to run, such as experiments/configs/quickstart.py")
flags.DEFINE_string("workdir", None, "Folder for results, checkpoints and report.html.")
flags.DEFINE_string(
    "part", None, "Make just this sub-folder, such as bavs/seed_0, without summary and report."
)
flags.DEFINE_bool("end_with_stdin", False, "Stop when standard input is closed.")
flags.DEFINE_integer("devices", 1, "Devices that share the rays of a run; 0: all.", 0)
flags.DEFINE_string(
    "coordinator", "", "host:port of the first of several processes; they use all devices."
)
flags.DEFINE_integer("num_processes", 1, "With --coordinator: how many processes there are.", 1)
flags.DEFINE_integer("process_id", 0, "With --coordinator: which one this is, from 0 on.", 0)
flags.DEFINE_integer("join_seconds", 300, "With --coordinator: how long to wait for all.", 1, 86400)
flags.DEFINE_bool("list_policies", False, "Print the known acquisition policies and stop.")


def start_devices() -> Mesh | None:
    """Joins the other processes, says which devices are used, and makes their mesh.

    With `--coordinator` the same command is started once for each process, on machines that share
    the working folder: all of them compute, the first one prints and writes. Must come before
    anything is computed. Raises ConfigError for flags that cannot be used.
    """
    if not FLAGS.coordinator and FLAGS.num_processes != 1:
        raise ConfigError("--num_processes: needs --coordinator, the host:port of the first one")
    if FLAGS.coordinator:
        _join_processes(FLAGS.coordinator, FLAGS.num_processes, FLAGS.process_id)
    try:
        mesh = make_mesh(0 if FLAGS.coordinator else FLAGS.devices)
    except ValueError as error:
        raise ConfigError(
            f"--devices: {error}; on a CPU, XLA_FLAGS=--xla_force_host_platform_device_count=N "
            "makes N of them"
        ) from None
    devices = jax.devices()[:1] if mesh is None else mesh.devices.ravel().tolist()
    kinds = Counter(device.device_kind for device in devices)
    of = f", of {FLAGS.num_processes} processes" if FLAGS.num_processes > 1 else ""
    print(f"devices: {', '.join(f'{num} x {kind}' for kind, num in kinds.items())}{of}")
    return mesh


def _join_processes(address: str, num: int, number: int) -> None:
    if not 0 <= number < num:
        raise ConfigError(
            f"--process_id: {number} is not below --num_processes, {num}; number them from 0 on"
        )
    host, _, port = address.rpartition(":")
    try:
        if not host or not 0 < int(port) < 65536:
            raise ValueError
        socket.getaddrinfo(host.strip("[]"), int(port))
    except (ValueError, OSError):
        raise ConfigError(
            f"--coordinator: {shown(address)} is no host:port that is known here; give that of the "
            "first process, such as 10.0.0.1:1234"
        ) from None

    def give_up():  # before JAX does, which dumps its stack
        reason = f"after {FLAGS.join_seconds} s not all {num} processes have met at {address}"
        print(f"error: --coordinator: {reason}", file=sys.stderr, flush=True)
        os._exit(1)

    timer = threading.Timer(FLAGS.join_seconds, give_up)
    timer.daemon = True
    timer.start()
    patience = FLAGS.join_seconds + 60
    jax.distributed.initialize(address, num, number, initialization_timeout=patience)
    timer.cancel()
    if number > 0:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115, open as long as the process is


def end_with_parent() -> None:
    """Ends this process as soon as its standard input is closed.

    A program that starts this one through a pipe takes it along even when it is killed.
    """

    def watch():
        while os.read(sys.stdin.fileno(), 1024):
            pass
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def main() -> None:
    if FLAGS.list_policies:
        for name, policy in POLICIES.items():
            print(f"{name:24} {policy.summary}")
        return
    config = given_config("experiments/configs/quickstart.py")
    folder = runtime.given_folder("workdir", "a folder for the results")
    runtime.start_cache()
    if FLAGS.end_with_stdin:
        end_with_parent()
    mesh = start_devices()
    runner.run_all(config, folder, runtime.command_line(), mesh, only=FLAGS.part)


if __name__ == "__main__":
    runtime.run_script(main)
