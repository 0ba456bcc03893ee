"""What `evaluate_uncertainty` leaves behind once every model of every seed is measured."""

from __future__ import annotations

import json
import pathlib

import numpy as np

from experiments.runtime import device_name, versions
from experiments.uncertain.intervals import pixel_rule
from experiments.uncertain.page import write_page
from experiments.uncertain.results import NAME, SCHEMA_VERSION, row_path, save_result

PAGE = "uncertainty.html"


def write_summary(config, scene, folder: pathlib.Path, command: str) -> tuple:
    """Collects the rows of all models and seeds into one result file and one page.

    Args:
      config: see `experiments/configs/base.py`.
      scene: the scene.
      folder: where the rows are.
      command: that made them.

    Returns:
      the paths of both files.
    """
    models, seeds = config.evaluation.models, config.seeds
    paths = [row_path(folder, model, seed) for model in models for seed in seeds]
    rows = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
    # The same for all models of a seed.
    interval_views = {str(row["seed"]): row.pop("interval_views") for row in rows}
    result = {
        "schema_version": SCHEMA_VERSION,
        "scene": scene.name,
        "kind": config.loader,
        "image_size": np.asarray(scene.cameras.sizes).max(axis=0).tolist(),
        "seeds": list(seeds),
        "command": command,
        "config": config.to_dict(),
        "device": device_name(),
        "versions": versions(),
        "pixel_rule": pixel_rule(config.evaluation.num_interval_pixels),
        "interval_views": interval_views,
        "rows": rows,
    }
    save_result(folder, result)
    arrays = {
        model: [dict(np.load(row_path(folder, model, s).with_suffix(".npz"))) for s in seeds]
        for model in models
    }
    write_page(folder / PAGE, result, arrays=arrays, variant=config.evaluation.variant)
    return folder / NAME, folder / PAGE
