"""The stages of a run on a trained field: how fast each is, and how its time grows."""

import copy
import itertools
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from ml_collections import ConfigDict

from bavs_jax.cameras import Cameras, reduced_cameras, take, view_pixels
from bavs_jax.candidates import scene_hemisphere
from bavs_jax.pixel_table import training_pixels, view_mask
from bavs_jax.rendering.images import render_pixels
from bavs_jax.scenes import Scene
from bavs_jax.selection.batch import acquire
from bavs_jax.selection.context import make_context
from bavs_jax.selection.policies import get_policy
from bavs_jax.uncertainty.channel import mean_uncertainty
from bavs_jax.uncertainty.model import RECONSTRUCTION, Acquired
from bavs_jax.uncertainty.streaming import table_rays
from experiments.build import Problem, initial_views, run_key, stream_key
from experiments.build_model import RENDER_CHUNK, train_aside
from experiments.runtime import peak_device_memory_mb, peak_memory_mb, track
from experiments.schema import MAX_LOG2_CELLS, MAX_WIDTH, check_options, leaves, several, whole

SEED = 0

# --- how much is measured --------------------------------------------------------------------


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


# --- one run of each stage -------------------------------------------------------------------


class Subject:
    """What is measured: a scene, a field, and what a run of `active_selection` does with them.

    `training`, `rendering`, `curvature`, `scoring` and `selection` make a function that does one
    piece of such work and returns the result; it compiles when it is first called.
    """

    def __init__(self, config, scene: Scene, num_views: int, kind: str = RECONSTRUCTION):
        self.config, self.scene = config, scene
        self.problem = Problem(config, scene, kind)
        self.initial = initial_views(scene, SEED, num_views)
        self.is_training = view_mask(self.problem.table, self.initial)
        self.state = self.problem.trainer.init(stream_key(SEED, "init"))
        self.jac_sq_sum, self.num_rays = None, 0  # of `curvature`, for `scoring`

    def train(self) -> None:
        """Trains the field as one round does."""
        problem, key = self.problem, run_key(SEED)
        acquired = Acquired(None, problem.table, self.is_training, 0, label=self.scene.name)
        self.state = train_aside(self.config, problem.trainer, key, acquired, problem.kind, track)

    def changed(self, **options) -> "Subject":
        """The same field under other options; `__` in a name stands for a dot."""
        other = copy.copy(self)
        other.config = self.config.copy_and_resolve_references()
        values = {name.replace("__", "."): value for name, value in options.items()}
        other.config.update_from_flattened_dict(values)
        other.problem = Problem(other.config, self.scene, self.problem.kind)
        return other

    def draw_cameras(self, num: int, width: int) -> Cameras:
        """Cameras on the hemisphere (Eq 14) with images `width` pixels wide, as photos are."""
        first = take(self.scene.cameras, np.full(num, self.scene.pool[0]))
        poses = scene_hemisphere(stream_key(SEED, "places"), self.scene, num)
        scale = width / float(first.sizes[0, 0])
        return reduced_cameras(first.replace(world_from_cam=poses), scale)

    def training(self, num_calls: int) -> Callable[[], np.ndarray]:
        """Trains on from a copy; the result is (rays that fitted the buffer, samples)."""
        # A training call is given its state for good, and others still need this one.
        state, numbers = jax.tree.map(jnp.copy, self.state), itertools.count()
        steps, key = self.config.train.steps_per_call, jax.random.fold_in(run_key(SEED), 1)
        call, views = self.problem.trainer.call, (self.problem.table, self.is_training)

        def run():
            nonlocal state
            infos = []
            for number in itertools.islice(numbers, num_calls):
                state, info = call(jax.random.fold_in(key, number), state, *views)
                infos.append(info)
            jax.block_until_ready(state)
            return steps * np.sum([[float(i.rays), float(i.samples)] for i in infos], axis=0)

        return run

    def rendering(self, num_rays: int) -> Callable[[], Any]:
        """Renders training pixels, drawn uniformly: colour and depth."""
        cameras, chunk_fn = self.problem.table.cameras, self.problem.render(self.state)
        view_ids, pixels = view_pixels(cameras, np.flatnonzero(self.is_training))
        rows = np.random.default_rng(SEED).integers(0, len(view_ids), num_rays)
        pixels, view_ids = pixels[rows], view_ids[rows]
        return lambda: render_pixels(chunk_fn, cameras, view_ids, pixels, chunk=RENDER_CHUNK)

    def curvature(self, num_rays: int) -> Callable[[], jax.Array]:
        """The summed squared Jacobian of training pixels, drawn uniformly (Eq 13)."""
        setup, table = self.problem.setup, self.problem.table
        view_ids, pixel_ids = training_pixels(table, self.is_training)
        rows = np.random.default_rng(SEED).integers(0, len(view_ids), num_rays)
        weighting = setup.laplace.weighting
        rays = table_rays(table, view_ids[rows], pixel_ids[rows], weighting)
        return lambda: setup.curvature(self.state.model, label=None, weighting=weighting, **rays)

    def scoring(self, num_candidates: int, width: int) -> Callable[[], Any]:
        """Scores candidates (Eq 15): every one, as no distance filter has gone before."""
        cameras = self.draw_cameras(num_candidates, width)
        chunk_fn = self.problem.render(self.state, self.jac_sq_sum, self.num_rays)
        return lambda: mean_uncertainty(chunk_fn, cameras, chunk=RENDER_CHUNK)

    def selection(self, num_candidates: int, batch_size: int) -> Callable[[], tuple]:
        """`bavs` with scores that cost nothing: the max-min distance filter (Fig 5), and top-k."""
        scores = np.random.default_rng(SEED).uniform(size=num_candidates).astype(np.float32)
        ctx = make_context(
            self.draw_cameras(num_candidates, 1).positions,
            training_positions=self.problem.table.cameras.positions,
            is_training_view=self.is_training,
            centre=self.scene.centre,
            mean_uncertainty_fn=lambda indices, picked: scores[indices],
        )
        policy, key = get_policy("bavs"), run_key(SEED)
        return lambda: acquire(policy, key, ctx, batch_size)


# --- the clock -------------------------------------------------------------------------------


def timed(run: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of one call until all that it returns is there, and what that is."""
    start = time.perf_counter()
    value = jax.block_until_ready(run())
    return time.perf_counter() - start, value


def timed_runs(run: Callable[[], Any], repeats: int) -> tuple[float, list[float], list[Any]]:
    """Seconds of a first call, which compiles; those of some more, and what these return."""
    first, _ = timed(run)
    seconds, values = zip(*(timed(run) for _ in range(repeats)))
    return first, list(seconds), list(values)


def measure_stages(subject: Subject, sizes) -> tuple[dict[str, dict], float, dict[str, Callable]]:
    """Trains the field to its end, so that its sampler skips what is empty, then times each stage.

    Returns:
      numbers of each stage, by name; the median of training samples per second; a run of each.
    """
    run = subject.training(1)
    compile_s = timed(run)[0] - timed(run)[0]
    subject.train()
    stages, runs = {}, {}

    def measure(name: str, unit: str, run: Callable, amount: float | None = None) -> list:
        """Notes a stage; its amount of units in a run, if not given, is the first of its values."""
        first, seconds, values = timed_runs(run, sizes.repeats)
        amounts = np.array([value[0] for value in values] if amount is None else [amount])
        runs[name] = run
        stages[name] = {
            "unit": unit,
            f"{unit}_per_run": float(np.median(amounts)),
            f"{unit}_per_s": float(np.median(amounts / seconds)),
            "run_s": seconds,
            "median_run_s": float(np.median(seconds)),
            "compile_s": first - float(np.median(seconds)),
            "peak_memory_so_far_mb": peak_memory_mb(),
            "peak_device_memory_so_far_mb": peak_device_memory_mb(),
        }
        bar.advance(1)
        return values

    with track(5, "measure", "stages") as bar:
        values = measure("train", "rays", subject.training(sizes.train_calls))
        stages["train"]["compile_s"] = compile_s  # its programs had been compiled before
        samples = np.array([num for _, num in values]) / stages["train"]["run_s"]
        measure("render", "rays", subject.rendering(sizes.render_rays), sizes.render_rays)
        num_rays = sizes.curvature_rays
        values = measure("curvature", "rays", subject.curvature(num_rays), num_rays)
        subject.jac_sq_sum, subject.num_rays = values[-1], num_rays
        run = subject.scoring(sizes.candidates, sizes.candidate_pixels)
        measure("score", "candidates", run, sizes.candidates)
        run = subject.selection(sizes.select_candidates, sizes.batch_size)
        measure("select", "batches", run, 1)
    return stages, float(np.median(samples)), runs


def measure_ceilings(sizes) -> dict[str, float]:
    """What the plainest programs reach; the best of several runs.

    A product of square float32 matrices of side n, at JAX's default precision, is `2 n^3`
    operations. An array is read once and written once; one is added on the way, which costs nothing
    beside the traffic: XLA would hand over the same array for a plain copy.
    """
    square = jnp.ones((sizes.matmul, sizes.matmul), jnp.float32)
    array = jnp.ones(sizes.copy_mb * 10**6 // 4, jnp.float32)
    product, copied = jax.jit(jnp.matmul), jax.jit(lambda x: x + 1.0)
    runs = (lambda: product(square, square), lambda: copied(array))
    product_s, copy_s = (min(timed_runs(run, sizes.repeats)[1]) for run in runs)
    return {
        "matmul_flops_per_s": 2.0 * sizes.matmul**3 / product_s,
        "copy_bytes_per_s": 2.0 * array.nbytes / copy_s,
    }


# --- growth ----------------------------------------------------------------------------------


def measure_growth(subject: Subject, sizes) -> dict[str, dict]:
    """Medians of the warm runs of each stage at several sizes, and how they grow."""
    growth, train = sizes.growth, subject.config.train
    num, batch = sizes.select_candidates, min(sizes.batch_size, *growth.candidates)

    def training(rays: int):
        capacity = rays * train.capacity // train.num_rays
        options = {"train__num_rays": rays, "train__capacity": capacity}
        return subject.changed(**options).training(growth.train_calls)

    def on_grid(cells: int):
        other = subject.changed(uncertainty__log2_cells=int(np.log2(cells)))
        return other.curvature(growth.grid_rays)

    cells = [2**level for level in growth.grid_log2]
    scoring = partial(subject.scoring, width=growth.candidate_pixels)
    among, of_batch = partial(subject.selection, batch_size=batch), partial(subject.selection, num)
    of_size = f"Selecting a batch of {batch}"
    on, among_all = f"Curvature of {growth.grid_rays:,} rays", f"Selecting among {num:,} candidates"
    # What takes the time, what grows, its sizes, and how a run of one size is made.
    series = {
        "train_rays": ("Training step", "rays", growth.train_rays, training),
        "render_rays": ("Rendering", "rays", growth.render_rays, subject.rendering),
        "curvature_rays": ("Curvature", "rays", growth.curvature_rays, subject.curvature),
        "curvature_grid": (on, "grid cells per side", cells, on_grid),
        "score_candidates": ("Scoring", "candidates", growth.candidates, scoring),
        "select_candidates": (of_size, "candidates", growth.candidates, among),
        "select_batch": (among_all, "views of the batch", growth.batch_size, of_batch),
    }
    num_steps = {"train_rays": growth.train_calls * train.steps_per_call}  # of a run
    rows = {}
    with track(sum(len(row[2]) for row in series.values()), "growth", "sizes") as bar:
        for name, (title, size, ns, make_run) in series.items():
            medians, memory = [], []
            for n in ns:
                _, seconds, _ = timed_runs(make_run(n), growth.repeats)
                medians.append(float(np.median(seconds)) / num_steps.get(name, 1))
                memory.append(peak_memory_mb())
                bar.advance(1)
            rows[name] = {
                "title": title,
                "size": size,
                "sizes": list(ns),
                "median_s": medians,
                "peak_memory_so_far_mb": memory,
                "fit": fit_growth(ns, medians) if len(ns) > 1 else None,
            }
    return rows


def fit_growth(sizes, seconds) -> dict[str, float]:
    """Fits `log t = log c + p log n` and `t = a + b n`, both by least squares.

    The line minimises relative errors, so that small sizes count as much as large ones. An exponent
    of 1 and a small deviation both say linear.

    Args:
      sizes: [N] n > 0, at least two different ones.
      seconds: [N] t > 0.

    Returns:
      `exponent` p over the measured range, a fixed cost included; `intercept_s` a, the fixed cost;
      `slope_s` b, seconds for one more; `largest_deviation` of the points from the line, as a share
      of the measured time.
    """
    sizes, seconds = np.asarray(sizes, np.float64), np.asarray(seconds, np.float64)
    exponent, _ = np.polyfit(np.log(sizes), np.log(seconds), 1)
    slope, intercept = np.polyfit(sizes, seconds, 1, w=1.0 / seconds)
    deviation = np.abs(intercept + slope * sizes - seconds) / seconds
    return {
        "exponent": float(exponent),
        "intercept_s": float(intercept),
        "slope_s": float(slope),
        "largest_deviation": float(deviation.max()),
    }
