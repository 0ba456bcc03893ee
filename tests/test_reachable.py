"""Runs in which each view is reached from the one before, also when they are killed on the way."""

import json

import numpy as np
import pytest

from experiments import runner
from experiments.files import claim
from tests.test_pools import nearest_unused
from tests.toy_rounds import silent
from tests.toy_runs import TINY, same_results, toy_config

REACHABLE = TINY | {"num_rounds": 3, "batch_size": 1, "pool__kind": "reachable", "num_pictures": 1}


class Killed(BaseException):
    """Not an Exception: nothing may catch it, as nothing outlives a kill."""


@pytest.fixture(scope="module")
def config():
    return toy_config(policies=("farthest",), **REACHABLE)


@pytest.fixture(scope="module")
def scene(config, cache):
    return runner.load_config_scene(config, cache_dir=str(cache / "scenes"))


@pytest.fixture(scope="module")
def problem(config, scene):
    return runner.Problem(config, scene, track=silent)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    return tmp_path_factory.mktemp("undisturbed")


@pytest.fixture
def run_all(config, scene, problem, monkeypatch):
    """`run_all(folder)`: the script's work; scene and compiled programs are made once."""
    monkeypatch.setattr(runner, "load_config_scene", lambda *args, **options: scene)
    monkeypatch.setattr(runner, "Problem", lambda *args: problem)
    return lambda folder: runner.run_all(config, folder, "command", None)


def check_moves(folder, scene, policy="farthest", num=5):
    """Every view that was on offer, or chosen, is among the nearest unused ones of the last."""
    result = json.loads((folder / policy / "seed_0" / "result.json").read_text())
    used = list(result["rounds"][0]["selected"])
    assert result["completed"] and len(used) == 2 and len(result["rounds"]) == 4
    for number, row in enumerate(result["rounds"][1:], start=1):
        wanted = nearest_unused(scene, set(used), used[-1], num)
        with np.load(folder / policy / "seed_0" / "choices" / f"round_{number}.npz") as choice:
            # Of a policy without a filter the survivors are what is on offer.
            assert set(choice["candidate_ids"][choice["survivors"]]) == wanted
        assert row["num_candidates"] == num
        (picked,) = row["selected"]
        assert picked in wanted
        used.append(picked)


@pytest.fixture
def undisturbed(run_all, finished):
    """The folder of a run to its end, made once."""
    run_all(finished)
    return finished


def test_each_view_is_reached_from_the_one_before(undisturbed, scene):
    check_moves(undisturbed, scene)
    page = (undisturbed / "report.html").read_text()
    assert "Pool: reachable, seed 0: on offer are the 5 unused views nearest to the last " in page


@pytest.mark.parametrize("method", ["_choose", pytest.param("_save", marks=pytest.mark.slow)])
def test_killed_anywhere_a_run_moves_on_from_where_it_was(
    run_all, undisturbed, scene, tmp_path, monkeypatch, method
):
    """Killed in a call, before what it does or after, each time with more of them behind it."""
    original, left = getattr(runner.Run, method), {"calls": 0, "before": False}

    def killed(self, *args, **options):
        left["calls"] -= 1
        if left["calls"] == 0 and left["before"]:
            raise Killed
        made = original(self, *args, **options)
        if left["calls"] == 0:
            raise Killed
        return made

    monkeypatch.setattr(runner.Run, method, killed)
    for calls, before in ((1, False), (1, True), (2, False)):
        left.update(calls=calls, before=before)
        with pytest.raises(Killed):
            run_all(tmp_path)
    monkeypatch.setattr(runner.Run, method, original)
    run_all(tmp_path)
    check_moves(tmp_path, scene)
    same_results(tmp_path, undisturbed)


def test_a_folder_of_before_there_were_pools_is_of_an_even_one(run_all, config, tmp_path):
    even = toy_config(policies=("farthest",), **TINY)
    run_all(tmp_path)
    saved = even.to_dict()
    del saved["pool"]
    (tmp_path / "config.json").write_text(json.dumps(saved))
    claim(tmp_path, even)
    (tmp_path / "config.json").write_text(json.dumps(saved))
    with pytest.raises(runner.WorkdirError, match=r"pool\.kind: differs from the run"):
        claim(tmp_path, toy_config(policies=("farthest",), **TINY, pool__kind="arc"))
