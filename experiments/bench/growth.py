"""How the time of each stage grows with what it is given."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from bavs_jax.training.train import TrainState
from experiments.bench import stages
from experiments.bench.subject import Subject, changed, draw_candidates, make_subject
from experiments.bench.timing import fit_growth, timed, timed_runs
from experiments.build import build_problem
from experiments.machine import peak_memory_mb
from experiments.progress import track


class Series(NamedTuple):
    """One thing that grows."""

    name: str
    title: str  # what takes the time
    size: str  # what grows
    sizes: tuple[int, ...]
    make_run: Callable[[int], Callable]  # size -> a run to be timed
    divisor: float = 1.0  # of the seconds of a run, where it holds more than one


def all_series(subject: Subject, state: TrainState, jac_sq_sum, num_rays: int, sizes) -> list:
    """What is measured; `num_rays` are those of `jac_sq_sum`."""
    growth = sizes.growth
    num_steps = growth.train_calls * subject.config.train.steps_per_call

    def training(rays):
        capacity = rays * subject.config.train.capacity // subject.config.train.num_rays
        config = changed(subject.config, train__num_rays=rays, train__capacity=capacity)
        trainer = build_problem(config, subject.scene).trainer
        return stages.make_training_run(subject, trainer, state, growth.train_calls)

    def curvature_on(cells):
        config = changed(subject.config, uncertainty__log2_cells=int(np.log2(cells)))
        other = make_subject(config, subject.scene, int(subject.is_training_view.sum()))
        return stages.make_curvature_run(other, state, growth.grid_rays)

    def scoring(num):
        cameras = draw_candidates(subject, num, growth.candidate_pixels)
        return stages.make_scoring_run(subject, state, jac_sq_sum, num_rays, cameras)

    def selection(num, batch_size):
        return stages.make_selection_run(subject, num, batch_size)[0]

    def rendering(rays):
        return stages.make_rendering_run(subject, state, rays)

    def curvature(rays):
        return stages.make_curvature_run(subject, state, rays)

    cells = tuple(2**level for level in growth.grid_log2)
    num, batch = sizes.select_candidates, min(sizes.batch_size, min(growth.candidates))
    return [
        Series("train_rays", "Training step", "rays", growth.train_rays, training, num_steps),
        Series("render_rays", "Rendering", "rays", growth.render_rays, rendering),
        Series("curvature_rays", "Curvature", "rays", growth.curvature_rays, curvature),
        Series(
            "curvature_grid",
            f"Curvature of {growth.grid_rays:,} rays",
            "grid cells per side",
            cells,
            curvature_on,
        ),
        Series("score_candidates", "Scoring", "candidates", growth.candidates, scoring),
        Series(
            "select_candidates",
            f"Selecting a batch of {batch}",
            "candidates",
            growth.candidates,
            lambda n: selection(n, batch),
        ),
        Series(
            "select_batch",
            f"Selecting among {num:,} candidates",
            "views of the batch",
            growth.batch_size,
            lambda k: selection(num, k),
        ),
    ]


def measure_growth(series: list[Series], repeats: int) -> dict[str, dict]:
    """Medians of the warm runs at each size, and how they grow."""
    rows = {}
    with track(sum(len(s.sizes) for s in series), "growth", "sizes") as bar:
        for one in series:
            seconds, memory = zip(*_points(one, repeats, bar))
            rows[one.name] = {
                "title": one.title,
                "size": one.size,
                "sizes": list(one.sizes),
                "median_s": list(seconds),
                "peak_memory_so_far_mb": list(memory),
                "fit": fit_growth(one.sizes, seconds)._asdict() if len(one.sizes) > 1 else None,
            }
    return rows


def _points(series: Series, repeats: int, bar) -> Iterator[tuple[float, float]]:
    for size in series.sizes:
        run = series.make_run(size)
        timed(run)
        seconds, _ = timed_runs(run, repeats)
        bar.advance(1)
        yield float(np.median(seconds)) / series.divisor, peak_memory_mb()
