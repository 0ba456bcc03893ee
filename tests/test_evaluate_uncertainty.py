"""Uncertainty against error: errors of pixels, tables, and the script on a toy run."""

import json
import os
import pathlib
import subprocess
import sys

import numpy as np
import pytest

from bavs_jax.metrics.ause import sparsification
from experiments.uncertain import measure
from experiments.uncertain.results import known_variants, mean_curves
from experiments.uncertain.tables import ause_table
from tests.toy_runs import toy_flags
from tests.toy_scenes import toy_scene

ROOT = pathlib.Path(__file__).parents[1]
SIZE = 6


class SceneWithDepth:
    """What `pixel_errors` asks of a scene, with a view that has no true depth."""

    def __init__(self):
        self.scene = toy_scene(size=SIZE)
        self.depths = np.random.default_rng(0).uniform(1.0, 4.0, (12, SIZE, SIZE))
        self.depths[:, 0] = 0.0  # not known

    def image(self, view):
        return self.scene.image(view)

    def mask_image(self, view):
        return None if view else np.arange(SIZE * SIZE).reshape(SIZE, SIZE) % 2 == 0

    def depth_image(self, view):
        return None if view == 3 else self.depths[view]


def images_of(scene, views, *, depth_factor=1.0):
    rng = np.random.default_rng(1)
    return [
        {
            "rgb": scene.image(v) / 255.0 + 0.1,
            "depth": depth_factor * scene.depths[v],
            "uncertainty": rng.uniform(size=(SIZE, SIZE)),
        }
        for v in views
    ]


def test_colour_errors_are_clipped_masked_means_over_channels():
    scene = SceneWithDepth()
    views = [0, 1, 3]
    errors = measure.pixel_errors(scene, views, images_of(scene, views), scale_depth=False)
    assert [len(e) for e, _ in errors["colour"]] == [18, 36, 36]
    truth = scene.image(1) / 255.0
    expected = (np.clip(truth + 0.1, 0.0, 1.0) - truth).mean(-1).ravel()
    np.testing.assert_allclose(errors["colour"][1][0], expected, atol=1e-12)


def test_depth_errors_leave_out_what_is_not_known_and_are_shares_of_the_largest():
    scene = SceneWithDepth()
    views = [0, 1, 3]
    images = images_of(scene, views, depth_factor=0.5)
    errors = measure.pixel_errors(scene, views, images, scale_depth=False)["depth"]
    assert [len(e) for e, _ in errors] == [15, 30, 0]
    known = [scene.depths[0].ravel()[errors[0][1]], scene.depths[1].ravel()[errors[1][1]]]
    largest = max(k.max() for k in known)
    np.testing.assert_allclose(errors[1][0], 0.5 * known[1] / largest)
    # One factor for the scene takes a wrong unit out.
    scaled = measure.pixel_errors(scene, views, images, scale_depth=True)["depth"]
    np.testing.assert_allclose(np.concatenate([e for e, _ in scaled]), 0.0, atol=1e-12)


def test_a_scene_without_true_depth_has_colour_alone():
    scene = SceneWithDepth()
    errors = measure.pixel_errors(scene, [3], images_of(scene, [3]), scale_depth=False)
    found = measure.all_ause(errors, images_of(scene, [3]))
    assert errors.keys() == {"colour"} and len(found) == 6


def test_depth_has_an_uncertainty_of_its_own_where_the_model_gives_one():
    scene = SceneWithDepth()
    images = images_of(scene, [1])
    errors = measure.pixel_errors(
        scene, [1], images_of(scene, [1], depth_factor=0.7), scale_depth=False
    )
    images[0]["depth_uncertainty"] = scene.depths[1]  # the order of the error itself
    found = measure.all_ause(errors, images)
    assert found["depth_mae_per_image"].ause == 0.0
    e, known = errors["colour"][0]
    expected = sparsification(e, images[0]["uncertainty"].ravel()[known]).ause
    assert found["colour_mae_per_image"].ause == expected > 0.0


def make_rows():
    def row(model, seed, own, common):
        numbers = {"depth_mae_pooled": {"ause": own, "unnormalised": own / 10}}
        shared = {"depth_mae_pooled": {"ause": common, "unnormalised": common / 10}}
        return {"model": model, "seed": seed, "psnr": 20.0 + seed, "own": numbers, "common": shared}

    return [
        *(row("laplace", seed, 0.2, 0.2 + 0.01 * seed) for seed in (0, 1)),
        *(row("entropy", seed, 0.4, 0.5 + 0.01 * seed) for seed in (0, 1)),
        row("cf_nerf", 7, 0.1, 0.3),
    ]


def test_table_is_paired_by_seed():
    rows = make_rows()
    assert known_variants(rows) == ["depth_mae_pooled"]
    table = ause_table(rows, "depth_mae_pooled")
    cells = {row[0].text: row for row in table.rows}
    assert cells["entropy"][-1].text == "+0.300 ± 0.000"
    assert cells["laplace"][-1].text == "—" and cells["cf_nerf"][-1].why.endswith("share no seed")
    assert cells["laplace"][2].text == "20.50 ± 6.35"  # 12.706 / sqrt(2) * sqrt(0.5)


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


def run(base, *, models):
    flags = toy_flags(num_rounds=1, evaluation__num_views=2, evaluation__models=models)
    done = subprocess.run(
        [sys.executable, "-m", "experiments.evaluate_uncertainty", f"--workdir={base}", *flags],
        cwd=ROOT,
        env=os.environ | {"XDG_CACHE_HOME": str(base)},
        capture_output=True,
        text=True,
        timeout=300,
    )
    return done.returncode, done.stdout, done.stderr


def test_script_writes_numbers_curves_and_a_page(finished):
    base, code, out, err = finished
    assert code == 0, err
    result = json.loads((base / "uncertainty.json").read_text())
    assert [row["model"] for row in result["rows"]] == ["laplace", "learned_variance"]
    for row in result["rows"]:
        assert row["num_views"] == 4 and len(row["own"]) == len(row["common"]) == 12
        assert all(np.isfinite([n["ause"], n["unnormalised"]]).all() for n in row["own"].values())
    first, second = result["rows"]
    assert first["own"] == first["common"]  # a measure on the common field itself
    assert second["own"] != second["common"]
    page = (base / "uncertainty.html").read_text()
    assert page.count("<svg ") == 2 and "learned_variance" in page
    assert page.count("<img ") == 2 * 4 and "remaining" in out


def test_more_models_are_added_to_what_is_there(finished):
    base, *_ = finished
    before = (base / "uncertainty" / "laplace" / "seed_0.json").stat().st_mtime_ns
    code, out, err = run(base, models="('laplace','learned_variance','entropy')")
    assert code == 0, err
    assert (base / "uncertainty" / "laplace" / "seed_0.json").stat().st_mtime_ns == before
    assert "train on" not in out
    rows = json.loads((base / "uncertainty.json").read_text())["rows"]
    assert [row["model"] for row in rows] == ["laplace", "learned_variance", "entropy"]


def test_an_unknown_model_ends_in_one_line(finished):
    code, _, err = run(finished[0], models="('laplas',)")
    assert code != 0 and "config.evaluation.models: 'laplas'" in err and "Traceback" not in err
