"""Fixtures that many modules use."""

import os

import jax
import pytest

from experiments.runtime import use_compilation_cache


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    """`$XDG_CACHE_HOME` of this session: compiled programs and scenes, shared by all workers."""
    base = tmp_path_factory.getbasetemp()
    root = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    folder = root / "cache"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="session", autouse=True)
def compiled_programs(cache):
    """What one module has compiled, all others and the scripts that they start need not."""
    use_compilation_cache(cache / "bavs_jax" / "compiled")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(cache))
        yield


@pytest.fixture(scope="module")
def quick_compilation():
    """Compiles with few optimisations: for modules that compile much and run each thing once.

    Scripts that tests start, and all other modules, compile as users do.
    """
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", before)
