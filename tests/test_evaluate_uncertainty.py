"""Uncertainty against error: errors of pixels, tables, and the script on a toy run."""

import dataclasses
import json
import subprocess
import sys
import time

import numpy as np
import pytest

from bavs_jax.metrics.ause import sparsification
from experiments.reporting.uncertainty import mean_curves
from experiments.uncertainty import (
    all_ause,
    load_calibration,
    pixel_errors,
    row_path,
    whole_views,
)
from tests.script_server import ROOT, run_script
from tests.toy_runs import toy_flags
from tests.toy_scenes import toy_scene

SIZE = 6


def make_scene():
    """With a mask in view 0, and a view that has no true depth."""
    scene = toy_scene(size=SIZE)
    depths = np.random.default_rng(0).uniform(1.0, 4.0, (scene.num_views, SIZE, SIZE))
    depths[:, 0] = 0.0  # not known
    depths[3] = 0.0
    mask = np.ones((scene.num_views, SIZE * SIZE), bool)
    mask[0, 1::2] = False
    return dataclasses.replace(scene, depth=depths.ravel(), pixel_mask=mask.ravel())


def images_of(scene, views, *, depth_factor=1.0):
    rng = np.random.default_rng(1)
    return [
        {
            "rgb": scene.image(v) / 255.0 + 0.1,
            "depth": depth_factor * scene.depth_image(v),
            "uncertainty": rng.uniform(size=(SIZE, SIZE)),
        }
        for v in views
    ]


def errors_of(scene, views, images, *, scale_depth=False):
    return pixel_errors(whole_views(scene, views, images), scale_depth=scale_depth)


def test_colour_errors_are_clipped_masked_means_over_channels():
    scene = make_scene()
    views = [0, 1, 3]
    errors = errors_of(scene, views, images_of(scene, views))
    assert [known.sum() for _, known in errors["colour"]] == [18, 36, 36]
    truth = scene.image(1) / 255.0
    expected = (np.clip(truth + 0.1, 0.0, 1.0) - truth).mean(-1).ravel()
    np.testing.assert_allclose(errors["colour"][1][0], expected, atol=1e-12)


def test_depth_errors_leave_out_what_is_not_known_and_are_shares_of_the_largest():
    scene = make_scene()
    views = [0, 1, 3]
    images = images_of(scene, views, depth_factor=0.5)
    errors = errors_of(scene, views, images)["depth"]
    assert [known.sum() for _, known in errors] == [15, 30, 0]
    true = [scene.depth_image(view).ravel()[known] for view, (_, known) in zip(views, errors)]
    largest = max(true[0].max(), true[1].max())
    np.testing.assert_allclose(errors[1][0][errors[1][1]], 0.5 * true[1] / largest)
    # One factor for the scene takes a wrong unit out.
    scaled = errors_of(scene, views, images, scale_depth=True)["depth"]
    np.testing.assert_allclose(np.concatenate([e[k] for e, k in scaled]), 0.0, atol=1e-12)


def test_a_scene_without_true_depth_has_colour_alone():
    scene = make_scene()
    errors = errors_of(scene, [3], images_of(scene, [3]))
    found = all_ause(errors, images_of(scene, [3]))
    assert errors.keys() == {"colour"} and len(found) == 6


def test_depth_has_an_uncertainty_of_its_own_where_the_model_gives_one():
    scene = make_scene()
    images = images_of(scene, [1])
    errors = errors_of(scene, [1], images_of(scene, [1], depth_factor=0.7))
    images[0]["depth_uncertainty"] = scene.depth_image(1)  # the order of the error itself
    found = all_ause(errors, images)
    assert found["depth_mae_per_image"].ause == 0.0
    e, known = errors["colour"][0]
    expected = sparsification(e[known], images[0]["uncertainty"].ravel()[known]).ause
    assert found["colour_mae_per_image"].ause == expected > 0.0


def test_mean_curves_are_shares_of_each_seeds_largest():
    arrays = [
        {
            "own_v_by_uncertainty": f * np.array([2.0, 1.0]),
            "own_v_by_error": f * np.array([2.0, 0.0]),
        }
        for f in (1.0, 100.0)
    ]
    by_uncertainty, by_error = mean_curves(arrays, "own", "v")
    np.testing.assert_allclose(by_uncertainty, [1.0, 0.5])
    np.testing.assert_allclose(by_error, [1.0, 0.0])


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    base = tmp_path_factory.mktemp("uncertain")
    return base, *run(base, models="('laplace','learned_variance')")


def command(base, *, models):
    flags = toy_flags(num_rounds=1, evaluation__num_views=2, evaluation__models=models)
    return ["experiments.evaluate_uncertainty", f"--workdir={base}", *flags]


def run(base, *, models):
    done = run_script(*command(base, models=models))
    return done.returncode, done.stdout, done.stderr


def test_script_writes_numbers_curves_and_a_page(finished):
    base, code, out, err = finished
    assert code == 0, err
    result = json.loads((base / "uncertainty.json").read_text())
    assert [row["model"] for row in result["rows"]] == ["laplace", "learned_variance"]
    assert result["seeds"] == [0] and "evaluate_uncertainty" in result["command"]
    assert {"jax", "bavs_jax", "python"} <= result["versions"].keys()
    for row in result["rows"]:
        assert row["num_views"] == 4 and len(row["own"]) == len(row["common"]) == 12
        assert all(np.isfinite([n["ause"], n["unnormalised"]]).all() for n in row["own"].values())
    first, second = result["rows"]
    assert first["own"] == first["common"]  # a measure on the common field itself
    assert second["own"] != second["common"]
    assert first["psnr"] == first["psnr_common"] == second["psnr_common"] != second["psnr"]
    page = (base / "uncertainty.html").read_text()
    # Curves, coverage of both quantities, and one test view.
    assert page.count("<svg ") == 2 + 2 + 1 and "learned_variance" in page
    assert "remaining" in out


def test_intervals_are_of_views_that_nothing_was_trained_on(finished):
    base, *_ = finished
    result = json.loads((base / "uncertainty.json").read_text())
    split = result["interval_views"]["0"]
    sizes = [len(split[name]) for name in ("fit", "calibration", "test")]
    views = set().union(*split.values())
    # 25 test views and the 96 of the pool that were not trained on.
    assert sum(sizes) == len(views) == 121 and sizes[1] >= 48
    summary = json.loads((base / "bavs_spread" / "seed_0" / "result.json").read_text())
    trained = set().union(*(one["selected"] for one in summary["rounds"]))
    assert len(trained) == 4 and not views & trained
    for row in result["rows"]:
        for numbers in row["intervals"].values():
            assert numbers["num_calibration_views"] <= sizes[1]
            coverage, stderr = (np.array(numbers[k]) for k in ("coverage", "coverage_stderr"))
            expected = np.array(numbers["levels"])
            # 5 standard errors of the test views, and as much again for the calibration views.
            slack = 5.0 * np.sqrt(2.0) * np.maximum(stderr, 0.01)
            assert (np.abs(coverage - expected) < slack + 1.0 / sizes[1]).all()


def test_saved_intervals_give_the_bands_of_the_page(finished):
    base, *_ = finished
    path = row_path(base, "laplace", 0)
    colour = load_calibration(path.with_name("seed_0_calibration.json")).colour
    with np.load(path.with_suffix(".npz")) as file:
        half = file["half"]
    assert half.shape == (1, 16, 16) and np.isfinite(half).any()
    factor = colour.factors[list(colour.levels).index(0.9)]
    # All widths lie between those at the ends of the scale.
    ends = factor * (colour.scale.values[[0, -1]] + colour.scale.floor)
    known = half[np.isfinite(half)]
    assert (known >= ends[0] * (1 - 1e-6)).all() and (known <= ends[1] * (1 + 1e-6)).all()


@pytest.mark.slow
def test_a_killed_evaluation_goes_on_and_does_nothing_twice(finished):
    base, *_ = finished
    models = ("laplace", "learned_variance", "entropy", "ensemble")
    done = [row_path(base, model, 0) for model in models[:3]]
    flags = command(base, models=str(models).replace(" ", ""))
    process = subprocess.Popen([sys.executable, "-m", *flags], cwd=ROOT)
    deadline = time.monotonic() + 300.0
    while not done[-1].exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
    process.kill()
    process.wait()
    assert done[-1].exists()
    before = [path.stat().st_mtime_ns for path in done]
    code, out, err = run(base, models=str(models).replace(" ", ""))
    assert code == 0, err
    assert [path.stat().st_mtime_ns for path in done] == before
    for words in ("train on", "train variance", "laplace", "learned_variance"):
        assert words not in out
    rows = json.loads((base / "uncertainty.json").read_text())["rows"]
    assert [row["model"] for row in rows] == list(models)


def test_an_unknown_model_ends_in_one_line(finished):
    code, _, err = run(finished[0], models="('laplas',)")
    assert code != 0 and "Traceback" not in err
    assert "config.evaluation.models: is ('laplas',)" in err
