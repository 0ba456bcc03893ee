"""Runs jobs on the machines of a Ray cluster, one to a GPU where there are some.

All machines must have the project installed and see the working folder under the same path.
"""

from __future__ import annotations

import os
import pathlib

from experiments.errors import ConfigError
from experiments.sweeps.local import end_process, open_process
from experiments.sweeps.schedule import Ended, Job


class RayEngine:
    """See `schedule.Engine`.

    Ray is handed all jobs that can start and finds room for them; it retries none of them, so that
    an attempt is counted in one place. A job is a process of its own here too: it ends with its
    worker, and so with its machine.
    """

    def __init__(self, address: str | None = None, cores_per_trial: int = 1):
        try:
            import ray
        except ImportError:
            raise ConfigError("--engine=ray: ray is missing; pip install -e '.[ray]'") from None
        self._ray = ray
        try:
            ray.init(address=address or None, log_to_driver=False, logging_level="error")
        except ConnectionError as error:
            raise ConfigError(f"--ray_address: {' '.join(str(error).split())}") from None
        gpus = 1 if ray.cluster_resources().get("GPU") else 0
        self._task = ray.remote(
            num_cpus=cores_per_trial, num_gpus=gpus, max_retries=0, max_calls=1
        )(run_process)
        self._env = {"NPROC": str(cores_per_trial)}
        self._running: dict = {}  # job of each Ray reference

    def has_room(self) -> bool:
        return True

    def start(self, job: Job) -> None:
        ref = self._task.remote(job.argv, str(job.log.absolute()), self._env, os.getcwd())
        self._running[ref] = job

    def wait(self, seconds: float) -> list[Ended]:
        done, _ = self._ray.wait(list(self._running), timeout=seconds)
        ended = [(self._running.pop(ref), ref) for ref in done]
        return [Ended(job, self._code(job, ref)) for job, ref in ended]

    def stop(self) -> None:
        for ref in self._running:
            self._ray.cancel(ref, force=True)
        self._ray.shutdown()

    def _code(self, job: Job, ref) -> int | None:
        try:
            return self._ray.get(ref)
        except self._ray.exceptions.RayTaskError as error:
            # The worker lives, but could not even start the process.
            with open(job.log, "a", encoding="utf-8") as file:
                file.write(f"{error}\n")
            return 1
        except self._ray.exceptions.RayError:
            return None


def run_process(argv, log: str, env: dict[str, str], cwd: str) -> int:
    """A process from start to end, in a worker of Ray; see `open_process`."""
    process = open_process(argv, pathlib.Path(log), env=env, cwd=cwd)
    try:
        return process.wait()
    finally:
        end_process(process)
