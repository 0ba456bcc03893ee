"""Fixtures that many modules use, and how tests compile."""

import importlib.metadata
import os

import jax
import pytest

from experiments.runtime import use_compilation_cache

# Set before XLA starts, for tests and for the scripts that they start. Most of a test's time is XLA
# compiling programs that run once: with few optimisations it takes half as long, and half of that
# again without the emitters that write fused loops. A tenth each take the splitting of a program
# for several threads, and writing down by which calls each operation came about.
for option, value in {
    "jax_disable_most_optimizations": True,
    "jax_include_full_tracebacks_in_locations": False,
}.items():
    jax.config.update(option, value)
    os.environ[option.upper()] = str(int(value))
# Later releases of jaxlib may not know the flags, and a process ends at one that it does not know.
QUICK = "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
if importlib.metadata.version("jaxlib").startswith("0.10."):
    given = os.environ.get("XLA_FLAGS", "").replace(QUICK, "")
    os.environ["XLA_FLAGS"] = f"{QUICK} {given}".strip()

# Files that take longest, in any order.
LONG = (
    *("test_suggest_views", "test_run", "test_models", "test_evaluate_uncertainty"),
    *("test_damaged_files", "test_kinds", "test_active", "test_same_colours", "test_compiled"),
    *("test_goldens", "test_sweep", "test_posthoc", "test_devices", "test_option_campaign"),
)


def pytest_collection_modifyitems(items):
    """Long files first, so that no worker is left alone with one at the end."""
    items.sort(key=lambda item: item.path.stem not in LONG)


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


@pytest.fixture
def users_compilation(monkeypatch):
    """Optimises as for users, here and in scripts that the test starts.

    For tests that are about what the optimiser makes of a program, or that compare with what users
    get. What is compiled in this process must ask for the emitters itself: `compiler_options` of
    `jax.jit`.
    """
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "0")
    monkeypatch.setenv("XLA_FLAGS", os.environ.get("XLA_FLAGS", "").replace(QUICK, ""))
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", True)
