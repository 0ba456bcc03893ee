"""The stages of a run, measured one by one on a trained field."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from bavs_jax.cameras import Cameras, num_pixels
from bavs_jax.pixel_table import view_pixel_rays
from bavs_jax.rendering.images import render_pixels
from bavs_jax.selection.batch import acquire
from bavs_jax.selection.context import Context, make_context
from bavs_jax.selection.policies import get_policy
from bavs_jax.training.fit import Trainer
from bavs_jax.training.train import TrainState
from bavs_jax.uncertainty.models.laplace import laplace_variance
from bavs_jax.uncertainty.scoring import mean_uncertainty
from bavs_jax.uncertainty.streaming import table_rays
from experiments.bench import work
from experiments.bench.subject import (
    SEED,
    Subject,
    draw_candidates,
    draw_training_pixels,
    pixel_centres,
)
from experiments.bench.timing import Ceilings, Work, timed, timed_runs
from experiments.build import RENDER_CHUNK
from experiments.keys import run_key, stream_key
from experiments.machine import peak_device_memory_mb, peak_memory_mb


@dataclasses.dataclass(frozen=True)
class Stage:
    """One stage, run several times after it was compiled."""

    name: str
    unit: str  # what it is counted in, in the plural
    amounts: list[float]  # of units, in each run
    seconds: list[float]  # of each run
    compile_seconds: float  # what the very first run took longer
    work: Work  # of one run
    run: Callable[[], Any]  # does it once more
    memory_mb: float = dataclasses.field(default_factory=peak_memory_mb)
    device_memory_mb: float | None = dataclasses.field(default_factory=peak_device_memory_mb)

    @property
    def rate(self) -> float:
        """Median of units per second."""
        return float(np.median(np.divide(self.amounts, self.seconds)))

    def numbers(self, ceilings: Ceilings) -> dict:
        """All that is known of it, with units in the names."""
        seconds = float(np.median(self.seconds))
        flops_per_s, bytes_per_s = self.work.flops / seconds, self.work.bytes / seconds
        return {
            "unit": self.unit,
            f"{self.unit}_per_run": float(np.median(self.amounts)),
            f"{self.unit}_per_s": self.rate,
            "run_s": self.seconds,
            "median_run_s": seconds,
            "compile_s": self.compile_seconds,
            "flops_per_run": self.work.flops,
            "bytes_per_run": self.work.bytes,
            "flops_per_s": flops_per_s,
            "bytes_per_s": bytes_per_s,
            "share_of_matmul_ceiling": flops_per_s / ceilings.flops_per_s,
            "share_of_copy_ceiling": bytes_per_s / ceilings.bytes_per_s,
            "peak_memory_so_far_mb": self.memory_mb,
            "peak_device_memory_so_far_mb": self.device_memory_mb,
        }


def _measure(name: str, unit: str, amount: float, run: Callable, repeats: int, work: Work) -> Stage:
    """A stage of which every run does the same."""
    first, _ = timed(run)
    seconds, _ = timed_runs(run, repeats)
    compile_seconds = first - float(np.median(seconds))
    return Stage(name, unit, [amount] * repeats, seconds, compile_seconds, work, run)


# --- training --------------------------------------------------------------------------------


def training_compile_seconds(subject: Subject) -> float:
    """What the first compiled call takes longer than the second."""
    state = subject.trainer.init(stream_key(SEED, "init"))
    run = make_training_run(subject, subject.trainer, state, 1)
    first, second = timed(run)[0], timed(run)[0]
    return first - second


def make_training_run(
    subject: Subject, trainer: Trainer, trained: TrainState, calls: int
) -> Callable[[], tuple[float, float]]:
    """Makes `run() -> (rays that fitted the buffer, samples)`, which trains on from a copy."""
    # A training call is given its state for good, and others still need this one.
    state, number = jax.tree.map(lambda x: x.copy(), trained), 0
    steps, key = subject.config.train.steps_per_call, jax.random.fold_in(run_key(SEED), 1)

    def run():
        nonlocal state, number
        infos = []
        for _ in range(calls):
            state, info = trainer.call(
                jax.random.fold_in(key, number),
                state,
                subject.problem.table,
                subject.is_training_view,
            )
            infos.append(info)
            number += 1
        jax.block_until_ready(state)
        means = np.array([[float(info.rays), float(info.samples)] for info in infos])
        return tuple(steps * means.sum(axis=0))

    return run


def measure_training(subject: Subject, state: TrainState, sizes, compile_seconds: float):
    """Steady state: the field is trained, so that its sampler skips what is empty.

    Returns:
      the stage in rays, and the median of samples per second.
    """
    run = make_training_run(subject, subject.trainer, state, sizes.train_calls)
    timed(run)
    seconds, amounts = timed_runs(run, sizes.repeats)
    rays, samples = np.transpose(amounts)
    one_call = work.training_work(subject, state)
    stage = Stage(
        "train",
        "rays",
        rays.tolist(),
        seconds,
        compile_seconds,
        one_call * sizes.train_calls,
        run,
    )
    return stage, float(np.median(samples / seconds))


# --- rendering and curvature -----------------------------------------------------------------


def make_rendering_run(subject: Subject, state: TrainState, num_rays: int) -> Callable:
    """Makes `run() -> images` of so many training pixels."""
    cameras = subject.problem.table.cameras
    view_ids, pixel_ids = draw_training_pixels(subject, num_rays)
    pixels, chunk_fn = pixel_centres(cameras, view_ids, pixel_ids), subject.problem.render(state)
    return lambda: render_pixels(chunk_fn, cameras, view_ids, pixels, chunk=RENDER_CHUNK)


def measure_rendering(subject: Subject, state: TrainState, sizes) -> Stage:
    """Colour and depth of training pixels."""
    rays = _training_rays(subject, RENDER_CHUNK)
    num_samples = max(int(subject.count_samples(state, rays).sum()), 1)
    chunk = work.rendering_work(subject, state, rays, num_samples)
    run = make_rendering_run(subject, state, sizes.render_rays)
    return _measure(
        "render",
        "rays",
        sizes.render_rays,
        run,
        sizes.repeats,
        chunk * (sizes.render_rays / RENDER_CHUNK),
    )


def make_curvature_run(subject: Subject, state: TrainState, num_rays: int) -> Callable:
    """Makes `run() -> jac_sq_sum` of so many training pixels."""
    toolbox, table = subject.toolbox, subject.problem.table
    pixels, weighting = draw_training_pixels(subject, num_rays), toolbox.laplace.weighting
    return lambda: toolbox.curvature(
        state.model, label=None, weighting=weighting, **table_rays(table, *pixels, weighting)
    )


def measure_curvature(subject: Subject, state: TrainState, sizes) -> Stage:
    """The raw Jacobian sum of training pixels."""
    rays = _training_rays(subject, sizes.curvature_rays)
    counts = np.asarray(subject.count_samples(state, rays))
    run = make_curvature_run(subject, state, sizes.curvature_rays)
    return _measure(
        "curvature",
        "rays",
        sizes.curvature_rays,
        run,
        sizes.repeats,
        work.curvature_work(subject, state, rays, counts),
    )


def _training_rays(subject: Subject, num: int):
    cameras = subject.problem.table.cameras
    return jax.jit(view_pixel_rays)(cameras, *draw_training_pixels(subject, num))


# --- scoring and selection -------------------------------------------------------------------


def make_scoring_run(
    subject: Subject, state: TrainState, jac_sq_sum, num_rays: int, cameras: Cameras
) -> Callable:
    """Makes `run() -> scores` of candidates (Eq 15); `num_rays` are those of the curvature."""
    chunk_fn = subject.problem.render(state, jac_sq_sum, num_rays)
    return lambda: mean_uncertainty(chunk_fn, cameras, chunk=RENDER_CHUNK)


def measure_scoring(subject: Subject, state: TrainState, jac_sq_sum, sizes) -> Stage:
    """Every candidate: no distance filter has gone before."""
    num_rays, options = sizes.curvature_rays, subject.toolbox.laplace
    cameras = draw_candidates(subject, sizes.candidates, sizes.candidate_pixels)
    total = int(num_pixels(cameras).sum())
    rng = np.random.default_rng(SEED)
    view_ids = rng.integers(0, len(cameras), RENDER_CHUNK)
    pixel_ids = rng.integers(0, num_pixels(cameras)[view_ids])
    rays = jax.jit(view_pixel_rays)(jax.tree.map(np.asarray, cameras), view_ids, pixel_ids)
    num_samples = max(int(subject.count_samples(state, rays).sum()), 1)
    variance = laplace_variance(jac_sq_sum, num_rays, options)
    chunk = work.rendering_work(subject, state, rays, num_samples, variance)
    run = make_scoring_run(subject, state, jac_sq_sum, num_rays, cameras)
    return _measure(
        "score",
        "candidates",
        sizes.candidates,
        run,
        sizes.repeats,
        chunk * (total / RENDER_CHUNK),
    )


def make_selection_run(subject: Subject, num_candidates: int, batch_size: int):
    """Makes `run() -> (selected, SelectionInfo)` of `bavs`, and the context that it selects from.

    The path of runs, with scores that cost nothing.
    """
    cameras = draw_candidates(subject, num_candidates, 1)
    scores = np.random.default_rng(SEED).uniform(size=num_candidates).astype(np.float32)
    ctx: Context = make_context(
        cameras.positions,
        training_positions=subject.problem.table.cameras.positions,
        is_training_view=subject.is_training_view,
        centre=subject.scene.centre,
        mean_uncertainty_fn=lambda indices, picked: scores[indices],
    )
    policy, key = get_policy("bavs"), run_key(SEED)
    return lambda: acquire(policy, key, ctx, batch_size), ctx


def measure_selection(subject: Subject, sizes) -> Stage:
    """The max-min distance filter (Fig 5), the largest scores of those at hand, and the report."""
    run, ctx = make_selection_run(subject, sizes.select_candidates, sizes.batch_size)
    first, (_, info) = timed(run)
    seconds, _ = timed_runs(run, sizes.repeats)
    return Stage(
        "select",
        "batches",
        [1.0] * sizes.repeats,
        seconds,
        first - float(np.median(seconds)),
        work.selection_work(ctx, info),
        run,
    )
