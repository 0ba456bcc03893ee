"""One seed of the evaluation with made-up fields: killed anywhere, it repeats nothing."""

import dataclasses
import json
import types

import numpy as np
import pytest

from bavs_jax.uncertainty.model import Acquired
from experiments import uncertainty
from experiments.reporting.uncertainty import load_result
from experiments.uncertainty import row_path, write_summary
from tests.test_intervals import scene_with_depth
from tests.toy_runs import toy_config

MODELS = ("laplace", "entropy", "ensemble")
CONFIG = {
    "evaluation__models": MODELS,
    "evaluation__num_views": 2,
    "seeds": (0, 1),
    "num_rounds": 0,
}


def make_render(model: str):
    """A field that is wrong as far as the hash of a ray says, and knows how much."""

    def render(rays):
        directions = np.asarray(rays.directions, np.float64)
        noise = np.abs(np.sin(1e4 * directions.sum(-1) + len(model)))
        return {
            "rgb": np.clip(0.5 + 0.3 * noise[:, None] * np.sin(1e3 * directions), 0.0, 1.0),
            "depth": 2.5 + noise,
            "opacity": np.where(noise < 0.05, 0.0, 1.0),
            "uncertainty": 0.1 + noise,
        }

    return render


@pytest.fixture
def place(tmp_path, monkeypatch):
    """Config, problem, folder, and a list that fits and renders of whole views are noted in."""
    scene, log = scene_with_depth(size=12), []
    is_training_view = np.isin(np.arange(scene.num_views), (0, 1))

    def train(config, problem, folder, policy, seed, command):
        log.append(f"train {seed}")
        return types.SimpleNamespace(acquired=Acquired({}, None, is_training_view, 288))

    def fit(problem, name, key, acquired):
        log.append(f"fit {name}")
        return uncertainty.FittedModel(make_render(name), 0.5)

    render_model = uncertainty.render_model

    def render(scene, fitted, view_ids, label):
        log.append(f"render {label.split()[-1]}")
        return render_model(scene, fitted, view_ids, label)

    monkeypatch.setattr(uncertainty, "train_run", train)
    monkeypatch.setattr(uncertainty, "fit_model", fit)
    monkeypatch.setattr(uncertainty, "render_model", render)
    return toy_config(**CONFIG), types.SimpleNamespace(scene=scene), tmp_path, log


def test_each_step_is_done_once_wherever_it_is_killed(place, monkeypatch):
    config, problem, folder, log = place
    whole_fit = uncertainty.fit_model

    def killed_fit(problem, name, key, acquired):
        if name == "ensemble":
            raise KeyboardInterrupt
        return whole_fit(problem, name, key, acquired)

    monkeypatch.setattr(uncertainty, "fit_model", killed_fit)
    with pytest.raises(KeyboardInterrupt):
        uncertainty.measure_seed(config, problem, folder, 0, "command")
    # The common field is rendered once, and serves the model that renders just it.
    common = ["train 0", "fit entropy", "render entropy"]
    assert log == [*common, "fit laplace", "render laplace"]
    before = {name: row_path(folder, name, 0).stat().st_mtime_ns for name in MODELS[:2]}

    log.clear()
    monkeypatch.setattr(uncertainty, "fit_model", whole_fit)
    uncertainty.measure_seed(config, problem, folder, 0, "command")
    assert log == [*common, "fit ensemble", "render ensemble"]
    assert before == {name: row_path(folder, name, 0).stat().st_mtime_ns for name in MODELS[:2]}

    log.clear()
    uncertainty.measure_seed(config, problem, folder, 0, "command")
    assert log == []
    # A row of an older version of this program is made anew.
    path = row_path(folder, "laplace", 0)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"row_version": 1}))
    uncertainty.measure_seed(config, problem, folder, 0, "command")
    assert log == [*common, "fit laplace", "render laplace"]


def test_result_and_page_of_two_seeds(place):
    config, problem, folder, _ = place
    for seed in config.seeds:
        uncertainty.measure_seed(config, problem, folder, seed, "command")
    numbers, page = write_summary(config, problem.scene, folder, "python -m x")
    result = load_result(folder)
    assert numbers.name == "uncertainty.json" and result["command"] == "python -m x"
    found = [(row["model"], row["seed"]) for row in result["rows"]]
    assert found == [(model, seed) for model in MODELS for seed in (0, 1)]
    # 12 views, 2 of them trained on; a split for each seed.
    first, second = (result["interval_views"][seed] for seed in ("0", "1"))
    assert [len(first[name]) for name in ("fit", "calibration", "test")] == [3, 5, 2]
    assert first != second and not {0, 1} & set().union(*first.values())
    for row in result["rows"]:
        shown = row["intervals"]["depth"]
        # Five views cannot promise 90 %: 5 / 6 is the most.
        assert shown["mean_width"][2:] == [None, None] and shown["mean_width"][0] > 0.0
        assert shown["share_with_band"] < 1.0 and shown["error_without_band"] > 0.0
    assert "Uncertainty against error: ball" in page.read_text()


def test_page_of_a_scene_without_depth(place):
    config, problem, folder, _ = place
    problem.scene = dataclasses.replace(problem.scene, depth=None)
    config.seeds = (0,)
    uncertainty.measure_seed(config, problem, folder, 0, "command")
    write_summary(config, problem.scene, folder, "python -m x")
    result = load_result(folder)
    assert result["rows"][0]["intervals"].keys() == {"colour"}
    assert "this scene has no true one" in (folder / "uncertainty.html").read_text()
