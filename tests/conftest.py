"""Fixtures that many modules use."""

import jax
import pytest


@pytest.fixture(scope="module")
def quick_compilation():
    """Compiles with few optimisations: for modules that compile much and run each thing once.

    Scripts that tests start, and all other modules, compile as users do.
    """
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", before)
