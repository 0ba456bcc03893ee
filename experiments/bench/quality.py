"""How good a field is after how many seconds."""

from __future__ import annotations

import math
import time

import jax
import numpy as np

from bavs_jax.active import round_keys
from bavs_jax.pixel_table import view_mask
from bavs_jax.training.fit import fit
from experiments import runtime
from experiments.bench.subject import SEED
from experiments.build import Problem, initial_views, load_config_scene, run_key, stream_key
from experiments.evaluate import evaluate_views, evenly_spaced
from experiments.runtime import ConfigError, device_name, shown, track

NEAR = 0.3  # dB below the plateau, from where on a field counts as done


def parse_targets(texts: list[str]) -> list[str]:
    """PSNRs in dB as they were given, the smallest first.

    Raises:
      ConfigError: there is none, or one of them is not a finite number.
    """
    try:
        numbers = [*map(float, texts)]
    except ValueError:
        numbers = []
    if not numbers or not all(map(math.isfinite, numbers)):
        raise ConfigError(f"--targets: {shown(texts)} are not all numbers; give some like 25,28")
    return sorted(texts, key=float)


def measure_run(config, *, num_views: int, num_test_views: int, every: int, started: float) -> dict:
    """Trains as a run does, to the end of its round, and looks at test views on the way.

    Args:
      config: see `experiments/configs/base.py`.
      num_views: training views, drawn as those that a run begins with.
      num_test_views: evenly spaced in the test split.
      every: optimiser steps between two looks, rounded up to compiled calls.
      started: `time.time()` when the clock began.

    Returns:
      `curve`, a list of `{"step", "seconds", "psnr"}`, one for each look; `scene`, `device` and
      `num_test_views`.
    """
    scene = load_config_scene(config, cache_dir=runtime.scene_cache())
    problem = Problem(config, scene)
    initial = initial_views(scene, SEED, num_views)
    view_ids = evenly_spaced(scene.test, num_test_views)
    steps, key = config.train.steps_per_call, run_key(SEED)
    calls_between = -(-every // steps)
    train = problem.trainer.init(stream_key(SEED, "init"))
    num_calls = problem.trainer.num_calls
    *_, train_key = round_keys(key, 0)
    paused, curve = 0.0, []

    with track(num_calls * steps, f"train on {num_views} views", "steps") as bar:
        for fitted in fit(
            train_key,
            problem.trainer,
            train,
            problem.table,
            view_mask(problem.table, initial),
            label="train",
        ):
            if fitted.calls % calls_between == 0 or fitted.calls == num_calls:
                jax.block_until_ready(fitted.train)
                stopped = time.time()
                measures = evaluate_views(
                    problem.render(fitted.train),
                    scene,
                    view_ids,
                    rays_per_pixel=config.rays_per_pixel,
                )
                seconds = stopped - started - paused
                step = fitted.calls * steps
                curve.append({"step": step, "seconds": seconds, "psnr": measures["psnr"]})
                paused += time.time() - stopped
            bar.advance(steps, psnr=curve[-1]["psnr"] if curve else np.nan)
    return {
        "curve": curve,
        "scene": scene.name,
        "device": device_name(),
        "num_test_views": len(view_ids),
    }


def plateau(curve: list[dict]) -> dict[str, float | None]:
    """The best PSNR of a curve, and seconds until it comes within `NEAR` dB of it for good.

    Returns:
      `db`, and `seconds` of the first look from which on none is further below; None if even
      the last one is.
    """
    best = max(point["psnr"] for point in curve)
    below = [i for i, point in enumerate(curve) if point["psnr"] < best - NEAR - 1e-6]
    near = curve[below[-1] + 1 :] if below else curve
    return {"db": best, "seconds": near[0]["seconds"] if near else None}


def first_seconds(curve: list[dict], targets: list[str]) -> dict[str, float | None]:
    """By target, seconds until it was first seen to be reached; None if it never was."""
    return {
        target: next((p["seconds"] for p in curve if p["psnr"] >= float(target)), None)
        for target in targets
    }
