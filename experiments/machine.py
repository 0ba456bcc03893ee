"""What a result was made on."""

from __future__ import annotations

import importlib.metadata
import os
import pathlib
import platform
import resource
import subprocess
import sys

import jax

PACKAGES = ("bavs_jax", "jax", "jaxlib", "flax", "optax", "numpy")


def versions() -> dict[str, str]:
    """Of the packages that results depend on, of Python, and of this code where it is known."""
    found = {name: importlib.metadata.version(name) for name in PACKAGES}
    found["python"] = platform.python_version()
    commit = code_commit()
    return found if commit is None else found | {"commit": commit}


def code_commit() -> str | None:
    """The git commit of this code, `-dirty` if files differ from it; None outside of a checkout."""
    folder = pathlib.Path(__file__).parents[1]
    if not (folder / ".git").exists():
        return None
    command = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=10"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def device_name() -> str:
    """The device that JAX uses, such as `CPU, x86_64, 2 cores`."""
    device = jax.devices()[0]
    if device.platform != "cpu":
        return f"{device.device_kind} x {jax.device_count()}"
    cores = len(_cpu_affinity())
    return f"CPU, {platform.machine()}, {cores} core{'s' if cores > 1 else ''}"


def _cpu_affinity() -> set[int]:
    return os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else {*range(os.cpu_count())}


def peak_memory_mb() -> float:
    """Most memory of the host that this process has held so far, in units of 10^6 bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


def peak_device_memory_mb() -> float | None:
    """Likewise of the device's own memory; None where the device is the host."""
    stats = jax.devices()[0].memory_stats()
    return None if stats is None else stats["peak_bytes_in_use"] / 1e6
