"""Intervals of a scene: which views and pixels they are learned from, and their file."""

import dataclasses
import types

import numpy as np
import pytest

from bavs_jax.uncertainty.bands import add_bands, calibration_to_json
from bavs_jax.uncertainty.conformal_scale import ViewGroups
from experiments.files import write_json
from experiments.runtime import ConfigError, WorkdirError
from experiments.uncertainty import (
    FittedModel,
    ViewSample,
    calibrate_samples,
    interval_groups,
    load_calibration,
    sample_views,
)
from tests.toy_scenes import toy_scene

SIZE = 6


def scene_with_depth(size=SIZE):
    scene = toy_scene(size=size)
    depth = np.random.default_rng(0).uniform(1.0, 4.0, len(scene.pixels)).astype(np.float32)
    return dataclasses.replace(scene, depth=depth)


def make_sample(rng, *, num=50, factor=1.0):
    """Errors that grow with the uncertainty; rendered depth is the true one over `factor`."""
    uncertainty = rng.uniform(0.1, 1.0, num)
    depth = rng.uniform(2.0, 4.0, num)
    image = {
        "rgb": np.full((num, 3), 0.5),
        "depth": (depth + 0.1 * uncertainty * rng.normal(size=num)) / factor,
        "opacity": np.ones(num),
        "uncertainty": uncertainty,
    }
    colour = 0.5 + 0.1 * uncertainty[:, None] * rng.uniform(-1.0, 1.0, (num, 3))
    return ViewSample(image, {"colour": colour, "depth": depth}, np.ones(num, bool))


def make_groups(rng, num, **options):
    samples = {view: make_sample(rng, **options) for view in range(num)}
    parts = np.split(np.arange(num), (num // 4, 3 * num // 4))
    return ViewGroups(*parts), samples


def test_test_views_come_first_and_training_views_never():
    scene = types.SimpleNamespace(pool=np.arange(10), test=np.arange(10, 14))
    is_training_view = np.isin(np.arange(16), (0, 3))  # with places for pictures to come

    def views(num, seed=0):
        return sorted(np.concatenate(interval_groups(scene, is_training_view, num, seed)))

    assert views(4) == [10, 11, 12, 13]
    assert views(3) == [10, 11, 12] and views(7) == [1, 4, 7, 10, 11, 12, 13]
    for num in (0, 12, 100):
        assert views(num) == [1, 2, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13]
    first, second = (interval_groups(scene, is_training_view, 0, seed) for seed in (0, 1))
    assert first.test.tolist() != second.test.tolist()
    with pytest.raises(ConfigError, match="num_interval_views: views: 2 are too few"):
        interval_groups(scene, is_training_view, 2, 0)


def test_pixels_are_drawn_by_view_alone_and_lie_where_they_should():
    scene = scene_with_depth()

    def render_fn(rays):
        return {"origins": rays.origins, "directions": rays.directions}

    fitted = FittedModel(render_fn, 0.0)
    samples = sample_views(scene, fitted, [3, 5], 10, "toy")
    again = sample_views(scene, fitted, [5], 10, "toy")
    everything = sample_views(scene, fitted, [5], 0, "toy")
    assert samples.keys() == {3, 5} and len(samples[3].known) == 10
    for name, values in samples[5].image.items():
        np.testing.assert_array_equal(again[5].image[name], values)
    np.testing.assert_array_equal(everything[5].truth["depth"], scene.depth_image(5).ravel())
    # Each drawn pixel has the direction, the colour and the depth of one and the same pixel.
    whole = everything[5]
    for i in range(10):
        same = (whole.image["directions"] == samples[5].image["directions"][i]).all(-1)
        assert same.sum() == 1 and whole.truth["depth"][same] == samples[5].truth["depth"][i]
        np.testing.assert_array_equal(whole.truth["colour"][same][0], samples[5].truth["colour"][i])


def test_calibration_measures_the_test_views():
    groups, samples = make_groups(np.random.default_rng(1), 160)
    calibration, numbers = calibrate_samples(groups, samples, scale="isotonic", scale_depth=False)
    assert calibration.depth_factor == 1.0 and numbers.keys() == {"colour", "depth"}
    depth = numbers["depth"]
    assert depth["num_calibration_views"] == 80 and depth["num_test_views"] == 40
    assert depth["share_with_band"] == 1.0 and depth["error_without_band"] is None
    # 40 x 50 and 80 x 50 i.i.d. pixels: 5 standard errors, and 1 / 80 for the view to come.
    np.testing.assert_allclose(depth["coverage"], depth["levels"], atol=1 / 80 + 5 * 0.5 / 36.0)
    # Uniform scales within (0.1, 1) are worth knowing: the score of one constant width is higher.
    assert max(depth["score_ratio"]) < 1.0
    assert len(depth["decile_coverage"]) == len(depth["levels"])


def test_pixels_without_a_band_are_counted_beside():
    groups, samples = make_groups(np.random.default_rng(2), 40)
    for view in groups.test:
        samples[int(view)].image["opacity"][:10] = 0.0
        samples[int(view)].image["depth"][:10] = 0.0
        samples[int(view)].truth["depth"][:10] = 3.0
        samples[int(view)].truth["depth"][10:15] = 0.0  # not known
    _, numbers = calibrate_samples(groups, samples, scale="isotonic", scale_depth=False)
    assert numbers["colour"]["share_with_band"] == pytest.approx(0.8)
    assert numbers["depth"]["share_with_band"] == pytest.approx(35 / 45)
    assert numbers["depth"]["error_without_band"] == pytest.approx(3.0)


def test_depth_in_a_unit_of_its_own_is_scaled_by_the_fit_views():
    groups, samples = make_groups(np.random.default_rng(3), 40, factor=2.5)
    calibration, numbers = calibrate_samples(groups, samples, scale="isotonic", scale_depth=True)
    # 500 pixels whose relative error is about 2 %.
    assert calibration.depth_factor == pytest.approx(2.5, rel=0.01)
    assert max(numbers["depth"]["mean_width"]) < 0.5
    _, plain = calibrate_samples(groups, samples, scale="isotonic", scale_depth=False)
    assert min(plain["depth"]["mean_width"]) > 1.0


def test_saved_calibration_puts_the_same_bands_around_new_views(tmp_path):
    rng = np.random.default_rng(4)
    groups, samples = make_groups(rng, 40)
    calibration, _ = calibrate_samples(groups, samples, scale="isotonic", scale_depth=False)
    path = tmp_path / "calibration.json"
    write_json(path, {"schema_version": 1, "calibration": calibration_to_json(calibration)})
    image = make_sample(rng).image
    before, after = (add_bands(c, image, 0.9) for c in (calibration, load_calibration(path)))
    for name, values in before.items():
        np.testing.assert_array_equal(after[name], values)
    assert [p.name for p in tmp_path.iterdir()] == ["calibration.json"]  # no temporary file


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "no such file"),
        ("{", "not JSON"),
        ('{"schema_version": 99}', "schema_version is 99"),
        ('{"schema_version": 1}', "calibration: no such entry"),
    ],
)
def test_a_calibration_of_no_use_is_an_error_of_one_line(tmp_path, text, words):
    path = tmp_path / "calibration.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(WorkdirError, match=words):
        load_calibration(path)
