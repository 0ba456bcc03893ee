"""How much of everything the benchmark measures."""

from __future__ import annotations

from ml_collections import ConfigDict

from experiments.schema import MAX_LOG2_CELLS, MAX_WIDTH, check_options, leaves, several, whole


def default_sizes() -> ConfigDict:
    """Sizes for a few minutes on two cores; tests and big machines take others."""
    sizes = ConfigDict()
    sizes.repeats = 5  # runs of each stage, of which the median counts
    sizes.train_calls = 4  # compiled training calls of one run
    sizes.render_rays = 65536
    sizes.curvature_rays = 32768
    sizes.candidates = 100  # that are scored
    sizes.candidate_pixels = 50  # image width of a candidate
    sizes.select_candidates = 1000  # that a batch is selected from
    sizes.batch_size = 16
    sizes.matmul = 4096  # side of the square matrices of the ceiling
    sizes.copy_mb = 256  # 10^6 bytes of the array of the other ceiling

    sizes.growth = ConfigDict()
    sizes.growth.repeats = 3
    sizes.growth.train_calls = 2
    sizes.growth.train_rays = (512, 1024, 2048, 4096)  # of one step
    sizes.growth.render_rays = (4096, 16384, 65536, 131072)
    sizes.growth.curvature_rays = (4096, 16384, 32768, 65536)
    sizes.growth.grid_log2 = (5, 6, 7, 8)  # L: grids of 2^L cells per side
    sizes.growth.grid_rays = 16384  # whose curvature each grid gets
    sizes.growth.candidates = (25, 100, 250, 1000)
    sizes.growth.candidate_pixels = 25
    sizes.growth.batch_size = (1, 4, 16, 64)
    return sizes


def check_sizes(sizes: ConfigDict) -> None:
    """Raises ConfigError for a size that cannot be used."""
    limits = {"candidate_pixels": MAX_WIDTH, "grid_log2": MAX_LOG2_CELLS, "matmul": 1 << 16}
    limits |= {"copy_mb": 1 << 16, "repeats": 1000, "train_calls": 1000}
    schema = {}
    for name, value in leaves(default_sizes()).items():
        one = whole(1, limits.get(name.rpartition(".")[2], 1 << 24))
        schema[name] = several(one, 1, 16) if isinstance(value, tuple) else one
    check_options(sizes, schema, "sizes")
