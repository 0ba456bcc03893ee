"""What a result was made on."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import resource
import sys

import jax

PACKAGES = ("bavs_jax", "jax", "jaxlib", "flax", "optax", "numpy")


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


def versions() -> dict[str, str]:
    """Of Python and of the packages that results depend on."""
    packages = {name: importlib.metadata.version(name) for name in PACKAGES}
    return packages | {"python": platform.python_version()}
