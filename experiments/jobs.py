"""Jobs of a sweep: in what order they run, where, and what is done about those that die.

Nothing here knows what a job does. An engine's `start(job)` gives the handle of a job that runs, or
None where there is no place for it now; `ended(handles)` gives those that have ended, with their
exit status (-n: killed by signal n; None: the machine is gone); `stop(handles)` ends them.
"""

import collections
import contextlib
import dataclasses
import os
import pathlib
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

from experiments.runtime import ConfigError

GPU_SHARE = 0.9  # of a GPU's memory that its jobs may take together
PATIENCE = 5.0  # seconds from asking a process to end to making it


@dataclasses.dataclass(frozen=True)
class Job:
    """One process of the project's Python, to be run at most once to its end."""

    name: str
    argv: tuple[str, ...]  # after the name of the interpreter
    log: pathlib.Path  # what it prints, all attempts one after another
    is_finished: Callable[[], bool]  # from its files
    needs: str | None = None  # another job that must be finished before


class Event(NamedTuple):
    """Something that happened to a job; `tick` is that time went by."""

    kind: str  # "started", "retried", "finished", "failed" or "tick"
    job: Job | None = None
    reason: str = ""  # why it is tried again or has failed


def run_jobs(jobs: list[Job], engine, *, retries: int, wait_seconds=1.0) -> Iterator[Event]:
    """Runs jobs to their end and says what happens; closing the iterator stops what runs.

    A job that is finished already is not started. One that dies without having said why (it is
    killed, or its machine is gone) is started again, at most `retries` times; one that ends by
    itself with an error would only do so again. A failure stops nothing but the jobs that need
    the failed one.
    """
    waiting = {job.name: job for job in jobs}
    running, failed, attempts = {}, set(), collections.Counter()  # the first: jobs by handle
    try:
        while waiting or running:
            for job in list(waiting.values()):
                if job.needs in waiting or job.needs in {j.name for j in running.values()}:
                    continue
                if job.is_finished():
                    del waiting[job.name]
                    yield Event("finished", job)
                elif job.needs in failed:
                    del waiting[job.name]
                    failed.add(job.name)
                    yield Event("failed", job, f"{job.needs}, which it needs, has failed")
                elif (handle := engine.start(job)) is not None:
                    running[handle] = waiting.pop(job.name)
                    attempts[job.name] += 1
                    yield Event("started", job)
            if running:
                time.sleep(wait_seconds)
            for handle, code in engine.ended(running):
                job, death = running.pop(handle), death_words(code)
                if code == 0 and job.is_finished():
                    yield Event("finished", job)
                elif death and attempts[job.name] <= retries:
                    waiting = {job.name: job, **waiting}  # at the head: others may wait for it
                    yield Event("retried", job, death)
                else:
                    failed.add(job.name)
                    again = f", {attempts[job.name]} times" if attempts[job.name] > 1 else ""
                    yield Event("failed", job, f"{death}{again}" if death else last_words(job.log))
            yield Event("tick")
    finally:
        engine.stop(running)


def death_words(code: int | None) -> str:
    """How a process came to its end that did not end by itself; empty for one that did."""
    if code is None:
        return "its machine or its worker is gone"
    number = -code if code < 0 else code - 128  # as scripts end that were asked to
    if code >= 0 and number not in (signal.SIGINT, signal.SIGTERM):
        return ""
    hint = "; out of memory?" if number == signal.SIGKILL else ""
    return f"killed by {signal.Signals(number).name}{hint}"


def last_words(log: pathlib.Path) -> str:
    """The last line of a log."""
    lines = log.read_text(encoding="utf-8", errors="replace").split("\n") if log.exists() else []
    return next((line.strip() for line in reversed(lines) if line.strip()), "printed nothing")


def open_process(argv, log: pathlib.Path, *, env=None, cwd=None) -> subprocess.Popen:
    """Starts this Python with `argv`; all it prints is added to the log.

    It has a session of its own, so that ctrl-C reaches only the program that started it, and its
    standard input is a pipe, which closes when that program is killed.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    with open(log, "ab", buffering=0) as file:
        file.write(f"$ python {shlex.join(argv)}\n".encode())
        return subprocess.Popen(
            [sys.executable, *argv],
            stdin=subprocess.PIPE,
            stdout=file,
            stderr=subprocess.STDOUT,
            env=os.environ | (env or {}),
            cwd=cwd,
            start_new_session=True,
        )


def end_process(process: subprocess.Popen) -> None:
    """Asks a process to end, and makes it."""
    process.terminate()
    try:
        process.wait(PATIENCE)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


# --- this machine ----------------------------------------------------------------------------


class Slot(NamedTuple):
    """A part of this machine that one job has for itself."""

    cores: tuple[int, ...]
    env: dict[str, str]


def make_slots(
    cores: list[int],
    memory_gb: float,
    gpus: list[str],
    *,
    jobs: int = 0,
    cores_per_trial: int = 1,
    gb_per_trial: float = 2.0,
) -> list[Slot]:
    """Divides a machine among as many jobs as fit, at least one.

    Args:
      cores, memory_gb, gpus: what there is; a job has no GPU where there is none.
      jobs: most jobs at a time; 0: one a GPU, or as many as cores and memory allow.
      cores_per_trial, gb_per_trial: what each of them needs.
    """
    fit = min(len(cores) // cores_per_trial, int(memory_gb / gb_per_trial))
    num = max(1, min(fit, jobs or len(gpus) or fit))
    width = max(cores_per_trial, len(cores) // num) if gpus else cores_per_trial
    slots = []
    for i in range(num):
        own = tuple(cores[i * width : (i + 1) * width])
        # Read by XLA, whose own count of cores ignores that others work beside it.
        env = {"NPROC": str(len(own))}
        if gpus:
            sharing = -(-num // len(gpus))
            env["CUDA_VISIBLE_DEVICES"] = gpus[i % len(gpus)]
            env["XLA_PYTHON_CLIENT_MEM_FRACTION"] = f"{GPU_SHARE / sharing:.3f}"
        slots.append(Slot(own, env))
    return slots


def usable_cores() -> list[int]:
    """The cores that this process may use, fewer where a container has less time than that."""
    affinity = getattr(os, "sched_getaffinity", lambda pid: range(os.cpu_count() or 1))
    cores = sorted(affinity(0))
    quota, _, period = _read("/sys/fs/cgroup/cpu.max").partition(" ")
    return cores[: max(1, int(quota) // int(period))] if quota.isdigit() and period else cores


def free_memory_gb() -> float:
    """Memory of the host that new processes can have, in units of 10^9 bytes."""
    known = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    for line in _read("/proc/meminfo").splitlines():
        if line.startswith("MemAvailable:"):
            known.append(int(line.split()[1]) * 1024)
    limits = [_read(f"/sys/fs/cgroup/{n}") for n in ("memory.max", "memory/memory.limit_in_bytes")]
    return min(known + [int(limit) for limit in limits if limit.isdigit()]) / 1e9


def _read(path: str) -> str:
    """A small file's text, empty where there is no such file: not every system has each."""
    try:
        return pathlib.Path(path).read_text(encoding="ascii").strip()
    except OSError:
        return ""


def visible_gpus() -> list[str]:
    """Names of NVIDIA's GPUs as CUDA_VISIBLE_DEVICES takes them.

    JAX is not asked: it would take their memory for this process.
    """
    given = os.environ.get("CUDA_VISIBLE_DEVICES")
    if given is not None:
        return [name for name in given.split(",") if name]
    if os.environ.get("JAX_PLATFORMS", "").startswith("cpu") or not shutil.which("nvidia-smi"):
        return []
    query = ["nvidia-smi", "--query-gpu=index", "--format=csv,noheader"]
    listed = subprocess.run(query, capture_output=True, text=True)
    return listed.stdout.split() if listed.returncode == 0 else []


class LocalEngine:
    """Each job is a process of this machine, on cores of its own."""

    def __init__(self, slots: list[Slot]):
        self._free, self._used = list(slots), {}

    def start(self, job: Job) -> subprocess.Popen | None:
        if not self._free:
            return None
        slot = self._free.pop(0)
        process = open_process(job.argv, job.log, env=slot.env)
        if hasattr(os, "sched_setaffinity"):
            with contextlib.suppress(ProcessLookupError):  # it has ended already
                os.sched_setaffinity(process.pid, slot.cores)
        self._used[process] = slot
        return process

    def ended(self, handles) -> list[tuple]:
        done = [process for process in handles if process.poll() is not None]
        self._free += [self._used.pop(process) for process in done]
        return [(process, process.returncode) for process in done]

    def stop(self, handles) -> None:
        for process in handles:
            process.terminate()
        for process in handles:
            end_process(process)


# --- a Ray cluster ---------------------------------------------------------------------------


class RayEngine:
    """Each job runs on a machine of a Ray cluster, with a GPU of its own where there are some.

    All machines must have the project installed and see the working folder under the same path.
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
        place = {"num_cpus": cores_per_trial, "num_gpus": gpus, "max_retries": 0, "max_calls": 1}
        self._task = ray.remote(**place)(_run_process)
        self._env = {"NPROC": str(cores_per_trial)}
        self._logs: dict = {}  # by handle

    def start(self, job: Job):
        ref = self._task.remote(job.argv, str(job.log.absolute()), self._env, os.getcwd())
        self._logs[ref] = job.log
        return ref

    def ended(self, handles) -> list[tuple]:
        left = list(handles)
        done = self._ray.wait(left, num_returns=len(left), timeout=0)[0] if left else []
        return [(ref, self._exit_code(ref)) for ref in done]

    def _exit_code(self, ref) -> int | None:
        try:
            return self._ray.get(ref)
        except self._ray.exceptions.RayTaskError as error:  # the worker could not start the job
            with open(self._logs[ref], "a", encoding="utf-8") as file:
                file.write(f"{error}\n")
            return 1
        except self._ray.exceptions.RayError:
            return None

    def stop(self, handles) -> None:
        if left := list(handles):
            for ref in left:
                self._ray.cancel(ref, force=True)
            self._ray.wait(left, num_returns=len(left), timeout=PATIENCE)
        self._ray.shutdown()


def _run_process(argv, log: str, env: dict[str, str], cwd: str) -> int:
    """A process from start to end, in a worker of Ray; see `open_process`."""
    process = open_process(argv, pathlib.Path(log), env=env, cwd=cwd)
    try:
        return process.wait()
    finally:
        end_process(process)
