"""One job on several devices: rays are spread over them, everything else is on each.

A mesh of one axis, `rays`, over the devices of one process or of several (`jax.distributed`). Each
device renders its own rays and packs their samples in a buffer of its own; sums over rays, such as
those of gradients and of curvature, then go over all. Functions here take `mesh=None` for a single
device and leave everything as it is.
"""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

AXIS = "rays"
ONE_EACH, ON_ALL = PartitionSpec(AXIS), PartitionSpec()


Args = ParamSpec("Args")
Result = TypeVar("Result")


def make_mesh(num_devices: int = 0) -> Mesh | None:
    """A mesh over the first devices of all processes, or None if that is just one.

    Args:
      num_devices: how many; 0 for all.

    Raises:
      ValueError: there are not so many.
    """
    devices = jax.devices()
    if not 0 <= num_devices <= len(devices):
        raise ValueError(f"{num_devices} devices are asked for, but there are {len(devices)}")
    devices = devices[: num_devices or len(devices)]
    return Mesh(np.array(devices), (AXIS,)) if len(devices) > 1 else None


def num_shards(mesh: Mesh | None) -> int:
    """Into how many parts rays are split."""
    return 1 if mesh is None else mesh.size


def over_rays(
    fn: Callable[Args, Result], mesh: Mesh | None, *, sharded: tuple[bool, ...]
) -> Callable[Args, Result]:
    """Runs `fn` on each device for that device's rays alone.

    Args:
      fn: pure; all that it returns has a leading axis of rays.
      mesh: see above.
      sharded: for each argument, whether its leading axes are rays, a multiple of the devices; the
        others are given to each device whole. Derivatives by those are summed over the devices.
    """
    if mesh is None:
        return fn
    specs = tuple(ONE_EACH if is_sharded else ON_ALL for is_sharded in sharded)
    # Nothing inside talks to other devices, so there is nothing that the check could find.
    return jax.shard_map(fn, mesh=mesh, in_specs=specs, out_specs=ONE_EACH, check_vma=False)


def jit_over_rays(
    fn: Callable[Args, Result], mesh: Mesh | None, *, sharded: tuple[bool, ...]
) -> Callable[Args, Result]:
    """Compiles `over_rays`; what it returns is whole on every device, and so in every process."""
    fn_over_rays = over_rays(fn, mesh, sharded=sharded)

    @functools.wraps(fn)  # traces and profiles bear the name of what they run
    def gathered(*args: Args.args, **kwargs: Args.kwargs) -> Result:
        return gather_rays(fn_over_rays(*args, **kwargs), mesh)

    return jax.jit(gathered)


def shard_rays(tree, mesh: Mesh | None):
    """In a compiled function: each device makes its own part of these arrays [R, ...]."""
    return _constrained(tree, mesh, ONE_EACH)


def gather_rays(tree, mesh: Mesh | None):
    """In a compiled function: every device, and so every process, has the whole of these arrays."""
    return _constrained(tree, mesh, ON_ALL)


def _constrained(tree, mesh, spec):
    if mesh is None:
        return tree
    return jax.lax.with_sharding_constraint(tree, NamedSharding(mesh, spec))


def put_on_all(tree, mesh: Mesh | None):
    """Copies arrays, the same in all processes, to every device of the mesh."""
    return tree if mesh is None else jax.device_put(tree, NamedSharding(mesh, ON_ALL))
