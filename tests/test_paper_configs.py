"""The configs of the paper's tables and figures: they build in both sizes, and Table 3 runs."""

import importlib
import json
import pathlib

import jax
import numpy as np
import pytest

from bavs_jax.selection.policies import POLICIES
from experiments.build import Problem
from experiments.configs.paper.protocols import PROTOCOLS, get_config
from experiments.reporting.run_tables import PAPER
from tests.scene_files import write_nerfstudio
from tests.script_server import run_script
from tests.toy_runs import OVERRIDES
from tests.toy_scenes import toy_scene

ROOT = pathlib.Path(__file__).parents[1]
SIZED = tuple(PROTOCOLS)


def load(name, *size):
    return get_config(",".join([name, *size]))


@pytest.mark.parametrize("size", ["laptop", "paper"])
@pytest.mark.parametrize("name", SIZED)
def test_every_size_builds(name, size):
    config = load(name, size)
    assert set(config.policies) <= set(POLICIES)
    problem = Problem(config, toy_scene())
    train = jax.eval_shape(problem.trainer.init, jax.random.key(0))
    assert jax.tree.leaves(train.model.params)


@pytest.mark.parametrize("name", SIZED)
def test_the_laptop_size_is_the_default_and_the_smaller_one(name):
    laptop, paper = load(name), load(name, "paper")
    assert laptop.to_dict() == load(name, "laptop").to_dict()
    assert laptop.train.num_steps < paper.train.num_steps
    assert laptop.image_size < (paper.image_size or np.inf)


def test_the_protocols_are_the_printed_ones():
    tables = {name: load(name, "paper") for name in SIZED}
    views = {
        name: (c.num_initial, c.num_initial + c.num_rounds * c.batch_size)
        for name, c in tables.items()
    }
    assert views["table_1"] == views["figure_6"] == (4, 20)
    assert views["table_2"] == views["table_4"] == views["figure_8"] == (50, 60)
    assert views["figure_7"] == (10, 100)
    assert tables["table_1"].train.num_steps == 40_000
    assert tables["figure_7"].train.num_steps * (tables["figure_7"].num_rounds + 1) == 30_000
    assert (tables["table_2"].load.pool_size, tables["table_4"].load.pool_size) == (200.0, 300.0)
    for name, rows in PAPER.items():
        assert {row.policy for row in rows if row.policy} <= set(tables[name].policies)


def test_an_unknown_size_ends_in_one_line():
    config = "experiments/configs/paper/table_1.py:big"
    done = run_script("experiments.active_selection", f"--config={config}")
    assert done.returncode != 0 and len(done.stderr.strip().splitlines()) == 1
    assert "size 'big': use one of laptop, paper" in done.stderr


@pytest.mark.parametrize("name", ["table_1", "table_2", "figure_8"])
@pytest.mark.parametrize("size", [(), ("paper",)])
def test_a_file_that_results_name_is_its_protocol(name, size):
    file = importlib.import_module(f"experiments.configs.paper.{name}")
    assert file.get_config(*size).to_dict() == load(name, *size).to_dict()


def test_an_unknown_name_is_told_the_known_ones():
    with pytest.raises(ValueError, match=r"name 'table_5': use one of .*table_1"):
        get_config("table_5")


def test_table_3_follows_its_scene():
    config = load("table_3")
    config.scene = "torch"
    assert config.load.split == "torch" and config.loader == "lightfield"
    config.load.split = "basket-cfnerf"
    assert config.scene == "torch"


@pytest.mark.slow
def test_table_3_runs_on_the_layout_with_true_depth(tmp_path):
    root = write_nerfstudio(tmp_path / "africa", num=14, width=24, height=16)
    rng = np.random.default_rng(0)
    for n in range(4):
        np.save(root / f"depth_gt_{n:02d}.npy", rng.uniform(3.0, 5.0, (16, 24)).astype(np.float32))
    (root / "scale_parameters.txt").write_text("1.0")
    kept = {k: v for k, v in OVERRIDES.items() if k.split(".")[0] in ("field", "march", "train")}
    options = kept | {"image_size": 24, "data_dir": tmp_path, "scene": "africa", "seeds": "(0,)"}
    options |= {"evaluation.models": "('laplace','entropy')", "uncertainty.log2_cells": 3}
    work = tmp_path / "work"
    done = run_script(
        *("experiments.evaluate_uncertainty", f"--workdir={work}"),
        "--config=experiments/configs/paper/protocols.py:table_3",
        *(f"--config.{name}={value}" for name, value in options.items()),
    )
    assert done.returncode == 0, done.stderr
    result = json.loads((work / "uncertainty.json").read_text())
    assert [(row["model"], row["num_views"], row["num_test_views"]) for row in result["rows"]] == [
        ("laplace", 5, 4),
        ("entropy", 5, 4),
    ]
    depth = [row["own"]["depth_mae_per_image"] for row in result["rows"]]
    assert all(np.isfinite(list(numbers.values())).all() for numbers in depth)
