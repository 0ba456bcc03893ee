"""One uncertainty model on the test views of one trained field: images, errors and AUSE."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import numpy as np

from bavs_jax.metrics.ause import ERRORS, Sparsification, mean_sparsification, variant_name
from bavs_jax.rendering.images import render_views
from bavs_jax.uncertainty.bands import uncertainty_of
from bavs_jax.uncertainty.model import Situation
from experiments.build import RENDER_CHUNK, Problem
from experiments.picture_stack import stack_pictures
from experiments.progress import track

IMAGES = ("rgb", "depth", "opacity", "uncertainty", "depth_uncertainty")


class FittedModel(NamedTuple):
    """A model that is ready to render."""

    render: Callable  # rays [chunk] -> images, those of `IMAGES` that the model has
    seconds: float  # that it took to fit


class ModelImages(NamedTuple):
    """What a model says about some views."""

    images: list[dict[str, np.ndarray]]  # of each view
    seconds: float


def fit_model(problem: Problem, name: str, key, situation: Situation) -> FittedModel:
    """Fits a model to the training views of a situation."""
    fns = problem.model_fns(name)
    start = time.perf_counter()
    fitted = jax.block_until_ready(fns.fit(key, situation))
    seconds = time.perf_counter() - start

    def render(rays):
        rendered = fns.render(fitted, situation.train, rays)
        return {k: rendered[k] for k in IMAGES if k in rendered}

    return FittedModel(render, seconds)


def render_model(scene, fitted: FittedModel, view_ids, label: str) -> ModelImages:
    """Renders whole views with a fitted model."""
    start = time.perf_counter()
    num_rays = int(np.diff(scene.offsets)[view_ids].sum())
    with track(num_rays, f"{label} on {len(view_ids)} views", "rays") as bar:
        rendered = render_views(
            fitted.render, scene.cameras, view_ids, chunk=RENDER_CHUNK, progress_fn=bar.advance
        )
    return ModelImages(rendered, time.perf_counter() - start)


def pixel_errors(scene, view_ids, images: list[dict], *, scale_depth: bool) -> dict[str, list]:
    """Absolute errors of each view by what they are of, in the order of its pixels.

    Args:
      scene: holds the true images, and true depth where it is known.
      view_ids: [n] which views.
      images: of each view "rgb" and "depth".
      scale_depth: whether depth has a scale of its own: one factor, the least-squares one over all
        pixels, is taken out before.

    Returns:
      {"colour": [...], "depth": [...]}, each a list of (errors [N], which pixels [H * W] bool);
      without "depth" if no view has a true one. Colour errors are means over the channels; depth
      errors are shares of the largest true depth.
    """
    colour, known, pairs = [], [], []
    for view, image in zip(view_ids, images):
        truth = scene.image(view).astype(np.float64) / 255.0
        mask = scene.mask_image(view)
        counts = np.ones(truth.shape[:2], bool) if mask is None else mask
        error = np.abs(np.clip(image["rgb"], 0.0, 1.0) - truth).mean(-1)
        colour.append((error[counts], counts.ravel()))
        true_depth = scene.depth_image(view)
        if true_depth is not None and (true_depth > 0.0).any():
            has_depth = counts & (true_depth > 0.0)
            known.append(has_depth.ravel())
            pairs.append((image["depth"][has_depth], true_depth[has_depth]))
        else:
            known.append(np.zeros(counts.size, bool))
            pairs.append((np.zeros(0), np.zeros(0)))
    if not any(k.any() for k in known):
        return {"colour": colour}
    rendered, true = (np.concatenate([p[i] for p in pairs]).astype(np.float64) for i in (0, 1))
    factor = (rendered @ true) / max(rendered @ rendered, 1e-12) if scale_depth else 1.0
    largest = true.max()
    depth = [(np.abs(factor * r - t) / largest, k) for (r, t), k in zip(pairs, known)]
    return {"colour": colour, "depth": depth}


def all_ause(errors: dict[str, list], images: list[dict]) -> dict[str, Sparsification]:
    """Every variant of AUSE of one model, by its name.

    Args:
      errors: from `pixel_errors`; maybe those of another field than the model's own.
      images: of each view "uncertainty", and "depth_uncertainty" where the model has one for depth.
    """
    found = {}
    for (of, parts), error, pooled in itertools.product(errors.items(), ERRORS, (False, True)):
        pick = partial(uncertainty_of, of)
        pairs = [(e, pick(image).ravel()[k]) for (e, k), image in zip(parts, images) if len(e)]
        name = variant_name(of=of, error=error, pooled=pooled)
        found[name] = mean_sparsification(pairs, error=error, pooled=pooled)
    return found


def ause_numbers(found: dict[str, Sparsification]) -> dict[str, dict[str, float]]:
    """Both areas of each variant, for a result file."""
    return {
        name: {"ause": one.ause, "unnormalised": one.ause_unnormalised}
        for name, one in found.items()
    }


def curve_arrays(found: dict[str, Sparsification], prefix: str) -> dict[str, np.ndarray]:
    """The curves of each variant as arrays with names."""
    arrays = {}
    for name, one in found.items():
        arrays[f"{prefix}_{name}_by_uncertainty"] = one.by_uncertainty
        arrays[f"{prefix}_{name}_by_error"] = one.by_error
    return arrays


def picture_arrays(scene, view_ids, images: list[dict], shown) -> dict[str, np.ndarray]:
    """Truth, render, colour error and uncertainty of the views at places `shown`."""
    views = [int(view_ids[i]) for i in shown]
    truth = stack_pictures([scene.image(v) for v in views])
    rgb = stack_pictures([np.clip(images[i]["rgb"], 0.0, 1.0) for i in shown])
    return {
        "names": np.array([scene.names[v] for v in views]),
        "sizes": np.asarray(scene.cameras.sizes)[views],
        "truth": truth,
        "rgb": np.round(255.0 * rgb).astype(np.uint8),
        "error": np.abs(rgb - truth / 255.0).mean(-1).astype(np.float32),
        "uncertainty": stack_pictures([images[i]["uncertainty"] for i in shown]),
    }
