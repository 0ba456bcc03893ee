"""Bands around renders: which pixels have one, what it holds, and the way through a file."""

import json

import numpy as np
import pytest

from bavs_jax.uncertainty.bands import (
    MIN_OPACITY,
    add_bands,
    band_errors,
    calibrate_renders,
    calibration_from_json,
    calibration_to_json,
    has_band,
    render_errors,
)
from bavs_jax.uncertainty.conformal import LEVELS

SHAPE = (4, 5)


def make_image(rng, shape=SHAPE, *, noise=0.05):
    """A render and the truth that it misses by noise of a spread that the uncertainty tells."""
    uncertainty = rng.uniform(0.2, 1.0, shape)
    depth, rgb = rng.uniform(2.0, 4.0, shape), rng.uniform(0.3, 0.7, (*shape, 3))
    image = {"opacity": np.ones(shape), "uncertainty": uncertainty}
    image["depth"] = (depth + noise * uncertainty * rng.normal(size=shape)).astype(np.float32)
    image["rgb"] = rgb + noise * uncertainty[..., None] * rng.normal(size=(*shape, 3))
    return image, depth, rgb


def make_calibration(rng, *, num_views=40, factor=1.0, shape=SHAPE):
    groups = []
    for _ in range(2):
        views = [make_image(rng, shape) for _ in range(num_views)]
        depth = [band_errors("depth", i, factor * d, depth_factor=factor) for i, d, _ in views]
        groups.append(
            {"colour": [band_errors("colour", i, c) for i, _, c in views], "depth": depth}
        )
    return calibrate_renders(*groups, depth_factor=factor)


def test_pixels_without_matter_or_with_an_infinite_uncertainty_have_no_band():
    image, depth, _ = make_image(np.random.default_rng(0))
    image["opacity"][0, 0] = 0.5 * MIN_OPACITY
    image["uncertainty"][1] = np.inf
    image["uncertainty"][2, 2] = np.nan
    depth[3, 3] = 0.0  # not known
    banded = has_band("colour", image)
    assert banded.sum() == 20 - 1 - 5 - 1 and not banded[0, 0]
    known = np.ones(SHAPE, bool)
    known[3, 4] = False
    errors = band_errors("depth", image, depth, known)
    assert len(errors.errors) == 20 - 7 - 2 and np.isfinite(errors.uncertainty).all()
    # A model's own uncertainty of depth counts for depth alone.
    image["depth_uncertainty"] = np.full(SHAPE, np.inf)
    assert band_errors("depth", image, depth) is None
    assert has_band("colour", image).sum() == 13


def test_error_of_colour_is_the_largest_of_its_channels_and_depth_has_its_unit():
    image = {"rgb": np.array([[1.4, 0.5, 0.2]]), "depth": np.array([2.0])}
    errors, known = render_errors("colour", image, np.array([[0.9, 0.2, 0.1]]))
    np.testing.assert_allclose(errors, [0.3])  # 1.4 is shown as 1
    errors, known = render_errors("depth", image, np.array([0.0]), depth_factor=3.0)
    assert not known.any()
    np.testing.assert_allclose(
        render_errors("depth", image, np.array([5.0]), depth_factor=3.0)[0], [1.0]
    )


def test_bands_hold_the_truth_of_new_views_at_their_level():
    rng = np.random.default_rng(1)
    calibration = make_calibration(rng, factor=2.0)
    shares = {name: [] for name in ("rgb", "depth")}
    for _ in range(200):
        image, depth, rgb = make_image(rng)
        banded = add_bands(calibration, image, 0.9)
        np.testing.assert_allclose(banded["depth"], 2.0 * image["depth"])
        inside = (banded["depth_lower"] <= 2.0 * depth) & (2.0 * depth <= banded["depth_upper"])
        shares["depth"].append(inside.mean())
        inside = (banded["rgb_lower"] <= rgb) & (rgb <= banded["rgb_upper"])
        shares["rgb"].append(inside.all(-1).mean())
    for found in shares.values():
        # Pixels are i.i.d. here: 4 standard errors of 200 * 20 test pixels and, by the calibration,
        # of 40 * 20; above it by 0.9 / 40 for the view to come.
        slack = 4.0 * np.sqrt(0.09 / 4000 + 0.09 / 800)
        assert -slack <= np.mean(found) - 0.9 * 41 / 40 <= slack


def test_bands_are_cut_to_what_a_truth_can_be_and_are_not_known_without_matter():
    rng = np.random.default_rng(2)
    calibration = make_calibration(rng)
    image, _, _ = make_image(rng)
    image["rgb"][0, 0], image["depth"][0, 0] = (0.0, 0.5, 1.0), 1e-4
    image["opacity"][1, 1] = 0.0
    banded = add_bands(calibration, image, 0.95)
    assert banded["rgb_lower"][0, 0, 0] == 0.0 and banded["rgb_upper"][0, 0, 2] == 1.0
    assert banded["depth_lower"][0, 0] == 0.0 and banded["depth_upper"][0, 0] > 0.0
    np.testing.assert_allclose(
        banded["rgb_upper"][0, 0, 1] - banded["rgb_lower"][0, 0, 1], 2.0 * banded["rgb_half"][0, 0]
    )
    for name in ("rgb_lower", "rgb_upper", "rgb_half", "depth_lower", "depth_half"):
        assert np.isnan(banded[name][1, 1]).all() and np.isfinite(banded[name]).sum() >= 19
    assert "uncertainty" in banded and banded["rgb"] is image["rgb"]


def test_json_gives_the_same_bands():
    rng = np.random.default_rng(3)
    image, *_ = make_image(rng)
    # From 5 views, 95 % cannot be promised: that interval is infinite.
    for calibration in (make_calibration(rng, num_views=5, factor=1.5), make_calibration(rng)):
        text = json.dumps(calibration_to_json(calibration), allow_nan=False)
        read = calibration_from_json(json.loads(text))
        for level in LEVELS:
            before, after = (add_bands(one, image, level) for one in (calibration, read))
            assert before.keys() == after.keys()
            for name, values in before.items():
                np.testing.assert_array_equal(after[name], values)


def test_without_depth_there_are_bands_of_colour_alone():
    rng = np.random.default_rng(4)
    views = [make_image(rng) for _ in range(30)]
    group = {"colour": [band_errors("colour", image, rgb) for image, _, rgb in views]}
    calibration = calibrate_renders(group, group)
    assert calibration.depth is None
    read = calibration_from_json(json.loads(json.dumps(calibration_to_json(calibration))))
    banded = add_bands(read, views[0][0], 0.8)
    assert "depth_lower" not in banded and np.isfinite(banded["rgb_half"]).all()


def test_broken_json_says_what_is_missing():
    values = calibration_to_json(make_calibration(np.random.default_rng(5)))
    del values["colour"]["factors"]
    with pytest.raises(ValueError, match="'factors'"):
        calibration_from_json(values)
