"""The stages of a run on a trained field: how fast each is, and how its time grows."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.cameras import Cameras
from bavs_jax.rendering.images import render_pixels
from bavs_jax.selection.batch import acquire
from bavs_jax.selection.context import make_context
from bavs_jax.selection.policies import get_policy
from bavs_jax.training.fit import Trainer
from bavs_jax.training.train import TrainState
from bavs_jax.uncertainty.channel import mean_uncertainty
from bavs_jax.uncertainty.streaming import table_rays
from experiments.bench.subject import (
    SEED,
    Subject,
    changed,
    draw_candidates,
    draw_training_pixels,
    make_subject,
    pixel_centres,
)
from experiments.build import Problem, run_key, stream_key
from experiments.build_model import RENDER_CHUNK
from experiments.runtime import peak_device_memory_mb, peak_memory_mb, track

# --- the clock -------------------------------------------------------------------------------


def timed(fn: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of one call until all that it returns is there, and what that is."""
    start = time.perf_counter()
    value = jax.block_until_ready(fn())
    return time.perf_counter() - start, value


def timed_runs(fn: Callable[[], Any], repeats: int) -> tuple[list[float], list[Any]]:
    """The same of several calls, one after another."""
    seconds, values = zip(*(timed(fn) for _ in range(repeats)))
    return list(seconds), list(values)


def measure_ceilings(*, matmul: int, copy_mb: int, repeats: int) -> dict[str, float]:
    """What the plainest programs reach; the best of several runs.

    Args:
      matmul: n, of `[n, n] @ [n, n]` in float32 at JAX's default precision, `2 n^3` operations.
      copy_mb: 10^6 bytes of an array that is read once and written once. One is added on the way,
        which costs nothing beside the traffic: XLA would hand over the same array for a plain copy.
      repeats: runs of each.

    Returns:
      `matmul_flops_per_s` and `copy_bytes_per_s`, read and written.
    """
    square = jnp.ones((matmul, matmul), jnp.float32)
    array = jnp.ones(copy_mb * 10**6 // 4, jnp.float32)
    product, copy = jax.jit(jnp.matmul), jax.jit(lambda x: x + 1.0)
    best = []
    for run in (lambda: product(square, square), lambda: copy(array)):
        timed(run)
        best.append(min(timed_runs(run, repeats)[0]))
    return {
        "matmul_flops_per_s": 2.0 * matmul**3 / best[0],
        "copy_bytes_per_s": 2.0 * array.nbytes / best[1],
    }


# --- one run of each stage -------------------------------------------------------------------


def make_training_run(
    subject: Subject, trainer: Trainer, trained: TrainState, calls: int
) -> Callable[[], tuple[float, float]]:
    """Makes `run() -> (rays that fitted the buffer, samples)`, which trains on from a copy."""
    # A training call is given its state for good, and others still need this one.
    state, number = jax.tree.map(lambda x: x.copy(), trained), 0
    steps, key = subject.config.train.steps_per_call, jax.random.fold_in(run_key(SEED), 1)
    table, is_training = subject.problem.table, subject.is_training_view

    def run():
        nonlocal state, number
        infos = []
        for _ in range(calls):
            state, info = trainer.call(jax.random.fold_in(key, number), state, table, is_training)
            infos.append(info)
            number += 1
        jax.block_until_ready(state)
        means = np.array([[float(info.rays), float(info.samples)] for info in infos])
        return tuple(steps * means.sum(axis=0))

    return run


def make_rendering_run(subject: Subject, state: TrainState, num_rays: int) -> Callable:
    """Makes `run() -> images`, colour and depth, of so many training pixels."""
    cameras = subject.problem.table.cameras
    view_ids, pixel_ids = draw_training_pixels(subject, num_rays)
    pixels, chunk_fn = pixel_centres(cameras, view_ids, pixel_ids), subject.problem.render(state)
    return lambda: render_pixels(chunk_fn, cameras, view_ids, pixels, chunk=RENDER_CHUNK)


def make_curvature_run(subject: Subject, state: TrainState, num_rays: int) -> Callable:
    """Makes `run() -> jac_sq_sum` of so many training pixels."""
    setup, table = subject.problem.setup, subject.problem.table
    pixels, weighting = draw_training_pixels(subject, num_rays), setup.laplace.weighting
    return lambda: setup.curvature(
        state.model, label=None, weighting=weighting, **table_rays(table, *pixels, weighting)
    )


def make_scoring_run(
    subject: Subject, state: TrainState, jac_sq_sum, num_rays: int, cameras: Cameras
) -> Callable:
    """Makes `run() -> scores` of candidates (Eq 15); `num_rays` are those of the curvature.

    Every candidate is scored: no distance filter has gone before.
    """
    chunk_fn = subject.problem.render(state, jac_sq_sum, num_rays)
    return lambda: mean_uncertainty(chunk_fn, cameras, chunk=RENDER_CHUNK)


def make_selection_run(subject: Subject, num_candidates: int, batch_size: int) -> Callable:
    """Makes `run() -> (selected, SelectionInfo)` of `bavs`, with scores that cost nothing.

    What is timed is the max-min distance filter (Fig 5), the largest scores of those at hand, and
    the report.
    """
    cameras = draw_candidates(subject, num_candidates, 1)
    scores = np.random.default_rng(SEED).uniform(size=num_candidates).astype(np.float32)
    ctx = make_context(
        cameras.positions,
        training_positions=subject.problem.table.cameras.positions,
        is_training_view=subject.is_training_view,
        centre=subject.scene.centre,
        mean_uncertainty_fn=lambda indices, picked: scores[indices],
    )
    policy, key = get_policy("bavs"), run_key(SEED)
    return lambda: acquire(policy, key, ctx, batch_size)


# --- stages ----------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Stage:
    """One stage, run several times after it was compiled."""

    unit: str  # what it is counted in, in the plural
    amounts: list[float]  # of units, in each run
    seconds: list[float]  # of each run
    compile_seconds: float  # what the very first run took longer
    run: Callable[[], Any]  # does it once more
    memory_mb: float = dataclasses.field(default_factory=peak_memory_mb)
    device_memory_mb: float | None = dataclasses.field(default_factory=peak_device_memory_mb)

    @property
    def rate(self) -> float:
        """Median of units per second."""
        return float(np.median(np.divide(self.amounts, self.seconds)))

    def numbers(self) -> dict:
        """All that is known of it, with units in the names."""
        return {
            "unit": self.unit,
            f"{self.unit}_per_run": float(np.median(self.amounts)),
            f"{self.unit}_per_s": self.rate,
            "run_s": self.seconds,
            "median_run_s": float(np.median(self.seconds)),
            "compile_s": self.compile_seconds,
            "peak_memory_so_far_mb": self.memory_mb,
            "peak_device_memory_so_far_mb": self.device_memory_mb,
        }


def training_compile_seconds(subject: Subject) -> float:
    """What the first compiled call takes longer than the second."""
    state = subject.problem.trainer.init(stream_key(SEED, "init"))
    run = make_training_run(subject, subject.problem.trainer, state, 1)
    first, second = timed(run)[0], timed(run)[0]
    return first - second


def measure_training(subject: Subject, state: TrainState, sizes, compile_seconds: float):
    """Steady state: the field is trained, so that its sampler skips what is empty.

    Returns:
      the stage in rays, and the median of samples per second.
    """
    run = make_training_run(subject, subject.problem.trainer, state, sizes.train_calls)
    timed(run)
    seconds, amounts = timed_runs(run, sizes.repeats)
    rays, samples = np.transpose(amounts)
    stage = Stage("rays", rays.tolist(), seconds, compile_seconds, run)
    return stage, float(np.median(samples / seconds))


def measure_stage(unit: str, amount: float, run: Callable, repeats: int) -> Stage:
    """A stage of which every run does the same, compiled by its first one."""
    first, _ = timed(run)
    seconds, _ = timed_runs(run, repeats)
    return Stage(unit, [amount] * repeats, seconds, first - float(np.median(seconds)), run)


# --- growth ----------------------------------------------------------------------------------


class Series(NamedTuple):
    """One thing that grows."""

    title: str  # what takes the time
    size: str  # what grows
    sizes: tuple[int, ...]
    make_run: Callable[[int], Callable]  # size -> a run to be timed
    divisor: float = 1.0  # of the seconds of a run, where it holds more than one


def all_series(
    subject: Subject, state: TrainState, jac_sq_sum, num_rays: int, sizes
) -> dict[str, Series]:
    """What is measured; `num_rays` are those of `jac_sq_sum`."""
    growth = sizes.growth
    num_steps = growth.train_calls * subject.config.train.steps_per_call

    def training(rays):
        capacity = rays * subject.config.train.capacity // subject.config.train.num_rays
        config = changed(subject.config, train__num_rays=rays, train__capacity=capacity)
        trainer = Problem(config, subject.scene).trainer
        return make_training_run(subject, trainer, state, growth.train_calls)

    def curvature_on(cells):
        config = changed(subject.config, uncertainty__log2_cells=int(np.log2(cells)))
        other = make_subject(config, subject.scene, int(subject.is_training_view.sum()))
        return make_curvature_run(other, state, growth.grid_rays)

    def scoring(num):
        cameras = draw_candidates(subject, num, growth.candidate_pixels)
        return make_scoring_run(subject, state, jac_sq_sum, num_rays, cameras)

    def rendering(rays):
        return make_rendering_run(subject, state, rays)

    def curvature(rays):
        return make_curvature_run(subject, state, rays)

    def selection_among(candidates):
        return make_selection_run(subject, candidates, batch)

    def selection_of(batch_size):
        return make_selection_run(subject, num, batch_size)

    cells = tuple(2**level for level in growth.grid_log2)
    num, batch = sizes.select_candidates, min(sizes.batch_size, *growth.candidates)
    views, on_grid = "views of the batch", f"Curvature of {growth.grid_rays:,} rays"
    of_batch, among = f"Selecting a batch of {batch}", f"Selecting among {num:,} candidates"
    return {
        "train_rays": Series("Training step", "rays", growth.train_rays, training, num_steps),
        "render_rays": Series("Rendering", "rays", growth.render_rays, rendering),
        "curvature_rays": Series("Curvature", "rays", growth.curvature_rays, curvature),
        "curvature_grid": Series(on_grid, "grid cells per side", cells, curvature_on),
        "score_candidates": Series("Scoring", "candidates", growth.candidates, scoring),
        "select_candidates": Series(of_batch, "candidates", growth.candidates, selection_among),
        "select_batch": Series(among, views, growth.batch_size, selection_of),
    }


def measure_growth(series: dict[str, Series], repeats: int) -> dict[str, dict]:
    """Medians of the warm runs at each size, and how they grow."""
    rows = {}
    with track(sum(len(s.sizes) for s in series.values()), "growth", "sizes") as bar:
        for name, one in series.items():
            medians, memory = [], []
            for size in one.sizes:
                run = one.make_run(size)
                timed(run)
                seconds, _ = timed_runs(run, repeats)
                medians.append(float(np.median(seconds)) / one.divisor)
                memory.append(peak_memory_mb())
                bar.advance(1)
            rows[name] = {
                "title": one.title,
                "size": one.size,
                "sizes": list(one.sizes),
                "median_s": medians,
                "peak_memory_so_far_mb": memory,
                "fit": fit_growth(one.sizes, medians) if len(one.sizes) > 1 else None,
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
