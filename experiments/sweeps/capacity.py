"""What this machine has to give: cores, memory and GPUs, cut into slots for one job each."""

from __future__ import annotations

import os
import pathlib
import shutil
import subprocess
from typing import NamedTuple

GPU_SHARE = 0.9  # of a GPU's memory that its jobs may take together


class Slot(NamedTuple):
    """Where one job runs."""

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
    """As many slots as fit, each with cores of its own; at least one.

    Jobs that share cores hinder each other: two with one core each get more done than two with
    both, and than one with both. Where there are GPUs, there is a slot for each, or several share
    one if more `jobs` are asked for.

    Args:
      cores: numbers of the cores that may be used.
      memory_gb: of the host, in units of 10^9 bytes.
      gpus: names of the GPUs.
      jobs: most slots; 0: as many as fit.
      cores_per_trial: least cores of a slot.
      gb_per_trial: host memory that a job is expected to need.
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
    if hasattr(os, "sched_getaffinity"):
        cores = sorted(os.sched_getaffinity(0))
    else:
        cores = list(range(os.cpu_count() or 1))
    quota, _, period = _read("/sys/fs/cgroup/cpu.max").partition(" ")
    if quota.isdigit() and period:
        cores = cores[: max(1, int(quota) // int(period))]
    return cores


def free_memory_gb() -> float:
    """Memory of the host that new processes can have, in units of 10^9 bytes."""
    for line in _read("/proc/meminfo").splitlines():
        if line.startswith("MemAvailable:"):
            free = int(line.split()[1]) * 1024
            break
    else:
        free = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    limits = [_read(f"/sys/fs/cgroup/{n}") for n in ("memory.max", "memory/memory.limit_in_bytes")]
    return min([free, *(int(limit) for limit in limits if limit.isdigit())]) / 1e9


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


def _read(path: str) -> str:
    """A small file's text, empty where there is no such file: not every system has each."""
    try:
        return pathlib.Path(path).read_text(encoding="ascii").strip()
    except OSError:
        return ""
