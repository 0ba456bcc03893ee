"""Clean-up of floaters: density is removed wherever the uncertainty is above a threshold.

As in Bayes' Rays (Goli et al. 2024, section 5.2): the trained field stays as it is, and what it
says of a point counts only if the deformation posterior is certain enough there.

Thresholds are always on the [0, 1] form of the uncertainty, `(log10 sigma + 3) / 9` clipped (see
`channel.py`), whatever scale is rendered and scored elsewhere. `+inf` removes nothing.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.arrays import Array
from bavs_jax.cameras import Rays
from bavs_jax.fields.deformation import DeformationGrid
from bavs_jax.metrics.covered import Sweep
from bavs_jax.models.base import ModelState
from bavs_jax.models.ray_field import RayField
from bavs_jax.registry import check_known
from bavs_jax.rendering.compositing import composite_colour, expected_depth, render_weights
from bavs_jax.uncertainty.channel import finish_uncertainty, make_uncertainty_channel

RULES = ("quality", "keep", "knee")


def make_point_uncertainty_fn(
    grid: DeformationGrid, variance: jax.Array, *, variant: str, extent: str = "box"
) -> Callable[[jax.Array], jax.Array]:
    """Makes the uncertainty of points, in [0, 1], that thresholds are held against.

    Args:
      variance: [G] from `vertex_variance`.
      variant, extent: see `make_uncertainty_channel`; with the extent `box`, what lies outside of
        the scene box is never removed.
    """
    channel = make_uncertainty_channel(grid, variance, variant=variant, scale="log", extent=extent)

    def uncertainty(positions):
        # The same from wherever it is looked at: the directions are not read.
        return finish_uncertainty(channel.value_fn(positions, positions), scale="log")

    return uncertainty


def make_cleaned_render_fn(
    model: RayField, grid: DeformationGrid, *, variant: str, extent: str = "box"
) -> Callable[[ModelState, Array, Array, Rays], dict[str, jax.Array]]:
    """Makes the compiled rendering of the cleaned field for many thresholds at once.

    The cleaned field is `sigma(x) [u(x) <= threshold]`. To remove a point changes nothing of what
    the field says elsewhere, so that one evaluation of all samples serves every threshold; only the
    compositing (Eqs 2-3) is done for each. Thresholds are traced: a sweep compiles once for each
    number of them.

    Samples lie where the sampler of the *untouched* field puts them. Steps through an occupancy
    grid are even, so nothing is lost; samplers that gather samples at the first surface leave few
    for what lies behind a removed floater.

    Args:
      model, grid: the field and the deformation grid.
      variant, extent: see `make_point_uncertainty_fn`.

    Returns:
      `render(state, variance [G], thresholds [T], rays)`, which gives of R rays "rgb" [R, T, 3],
      "depth" [R, T] (scene units), "opacity" [R, T], and "content" [R, T]: the rendering weight of
      the untouched field that its samples up to the threshold hold, `sum_i w_i [u_i <= threshold]`.
    """

    @jax.jit
    def render(state, variance, thresholds, rays):
        uncertainty_fn = make_point_uncertainty_fn(grid, variance, variant=variant, extent=extent)

        def apply_and_keep(field_params, positions, directions, **inputs):
            density, rgb, *_ = model.field.apply(field_params, positions, directions, **inputs)
            return density, rgb, {"rgb": rgb, "uncertainty": uncertainty_fn(positions)}

        keeping = dataclasses.replace(model, field=model.field._replace(apply=apply_and_keep))
        untouched = keeping.render(state, rays)
        samples = untouched.samples
        rgb, uncertainty = untouched.values["rgb"], untouched.values["uncertainty"]

        def composited(threshold):
            removed = uncertainty > threshold
            weights = render_weights(jnp.where(removed, 0.0, untouched.density), samples.deltas)
            return {
                "rgb": composite_colour(weights, rgb, model.background),
                "depth": expected_depth(weights, samples.t_mids),
                "opacity": weights.sum(-1),
                "content": jnp.where(removed, 0.0, untouched.weights).sum(-1),
            }

        # One threshold after another: all at once would hold [T, R, S] several times over.
        by_threshold = jax.lax.map(composited, thresholds)
        return {name: jnp.moveaxis(value, 0, 1) for name, value in by_threshold.items()}

    return render


def even_thresholds(variance, num: int, unit) -> np.ndarray:
    """Thresholds [num + 1] from the most certain vertex to the least certain one, then `+inf`.

    Args:
      variance: [G] from `vertex_variance`, scene unit^2, > 0.
      num: how many below `+inf`, evenly spaced in the [0, 1] form.
      unit: `offset_unit` of the scene's box.
    """
    ends = jnp.array([jnp.min(variance), jnp.max(variance)])
    low, high = finish_uncertainty(0.5 * jnp.log10(ends) - jnp.log10(unit), scale="log")
    return np.append(np.linspace(low, high, num), np.inf).astype(np.float32)


def choose_threshold(
    sweep: Sweep, *, rule: str = "quality", max_loss: float = 0.1, keep: float = 0.99
) -> int:
    """Which threshold to clean up with, from renders of the *training* views alone.

    What the photos show must stay, and what no photo relies on may go. A field shows no view that
    was left out, so no test view enters.

    `quality`: the lowest threshold from which on no threshold costs the training views more than
    `max_loss` of their PSNR.
    `keep`: the lowest threshold that keeps at least the share `keep` of the training content, each
    sample of the untouched field counting by its rendering weight (`Sweep.content_kept`); on a fine
    sweep this is the `keep` quantile of the uncertainty of what training rays meet. Fog in the
    colour of the background is content too, is uncertain everywhere, and drives this threshold up.
    `knee`: where the curve of kept content over finite thresholds lies highest above the straight
    line between its ends (Satopaa et al. 2011): from there on a lower threshold costs more content
    for each step than it did on the average.

    Args:
      sweep: of the training views.
      rule: one of `RULES`.
      max_loss: dB, >= 0; read by the rule `quality` alone.
      keep: share of the content, in (0, 1]; read by the rule `keep` alone.

    Returns:
      Row of `sweep`, the last (`+inf`, no clean-up) if no other is good enough.

    Raises:
      ValueError: unknown rule, a loss below 0, a share outside of (0, 1], or fewer than 3 finite
        thresholds for the rule `knee`.
    """
    check_known("rule", rule, RULES)
    if not max_loss >= 0.0:
        raise ValueError(f"max_loss: {max_loss} is no loss; give 0 dB or more")
    if not 0.0 < keep <= 1.0:
        raise ValueError(f"keep: {keep} is no share; give a number above 0 and up to 1")
    if rule == "knee":
        return _knee(np.asarray(sweep.thresholds)[:-1], np.asarray(sweep.content_kept)[:-1])
    if rule == "keep":
        good = np.asarray(sweep.content_kept) >= keep
    else:
        good = np.asarray(sweep.psnr) >= sweep.psnr[-1] - max_loss
    good[-1] = True  # nothing removed: also where there was nothing to measure
    return int(len(good) - np.argmin(good[::-1])) if not good.all() else 0


def _knee(thresholds: np.ndarray, kept: np.ndarray) -> int:
    if len(thresholds) < 3:
        raise ValueError(f"thresholds: {len(thresholds)} are too few for a knee; give 3 or more")
    chord = np.interp(thresholds, thresholds[[0, -1]], kept[[0, -1]])
    return int(np.argmax(kept - chord))


def threshold_sigma(threshold, unit) -> np.ndarray:
    """The offset's standard deviation that a threshold stands for, `unit 10^(9 u - 3)`, where
    `unit` is the `offset_unit` of the scene's box; scene units."""
    return unit * 10.0 ** (9.0 * np.asarray(threshold, np.float64) - 3.0)
