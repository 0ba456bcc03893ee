"""Scripts on a finished run: clean-up and posterior draws, end to end on a tiny one."""

import json
import os
import pathlib
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from experiments import workdir
from experiments.build import build_problem
from experiments.build_scene import load_config_scene
from experiments.errors import WorkdirError
from experiments.posthoc.trained_run import load_run, read_config
from experiments.runner import Run
from tests.toy_runs import toy_config

ROOT = pathlib.Path(__file__).parents[1]
POLICY = "random"


def script(name, *flags, cache):
    """Runs a script to its end; `cache` keeps compiled programs between the tests."""
    env = os.environ | {"XDG_CACHE_HOME": str(cache)}
    return subprocess.run(
        [sys.executable, "-m", f"experiments.{name}", *flags],
        cwd=ROOT,
        env=env,
        capture_output=True,
        text=True,
        timeout=1200,
    )


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run of one round on four views: its folder, and the state that it ended with."""
    folder = tmp_path_factory.mktemp("finished")
    config = toy_config(policies=(POLICY,), num_rounds=0, num_initial=4)
    workdir.claim(folder, config)
    problem = build_problem(config, load_config_scene(config, cache_dir=None))
    first = Run(config, problem, folder, None, 0)
    first.finish()
    Run(config, problem, folder, POLICY, 0).finish(first)
    return folder, config


def test_a_finished_run_is_taken_up_as_it_was(finished):
    folder, config = finished
    assert read_config(folder / "config.json").to_dict() == config.to_dict()
    run = load_run(folder)
    assert (run.policy, run.seed, len(run.training_views)) == (POLICY, 0, 4)
    result = json.loads((run.folder / "result.json").read_text())
    assert run.training_views.tolist() == sorted(result["rounds"][0]["selected"])
    view = int(run.training_views[0])
    np.testing.assert_allclose(run.truth(view), run.problem.scene.image(view) / 255.0)
    assert run.pixel_mask(view).all() and run.num_rays == 4 * run.truth(view)[..., 0].size


def test_clean_up_writes_numbers_and_pictures(finished):
    folder, _ = finished
    flags = (f"--workdir={folder}", "--num_test=3", "--num_thresholds=6")
    done = script("clean_up", *flags, cache=folder / "cache")
    assert done.returncode == 0, done.stderr
    assert "remaining" in done.stdout and "results:" in done.stdout
    out = folder / POLICY / "seed_0" / "cleanup"
    value = json.loads((out / "cleanup.json").read_text())
    assert value["num_training_views"] == 4 and value["options"]["keep"] == 0.99
    for split in ("training", "test"):
        sweep = value["sweep"][split]
        assert len(sweep["thresholds"]) == 7 and sweep["thresholds"][-1] is None
        assert sweep["content_kept"][-1] == 1.0
        assert value["before"][split]["psnr"] == sweep["psnr"][-1]
        assert value["before"][split].keys() == value["after"][split].keys()
    assert value["after"]["training"]["content_kept"] >= 0.99
    for name in ("sweep.png", "views.png"):
        with Image.open(out / name) as image:
            assert min(image.size) > 300 and np.asarray(image).std() > 0
    assert not list(out.glob(".*")), "no temporary file is left"


def test_posterior_draws_writes_numbers_and_a_picture(finished):
    folder, _ = finished
    flags = (f"--workdir={folder}", "--num_draws=2", "--num_views=2")
    done = script("posterior_draws", *flags, cache=folder / "cache")
    assert done.returncode == 0, done.stderr
    assert "training views:" in done.stdout and "test views:" in done.stdout
    out = folder / POLICY / "seed_0" / "draws"
    value = json.loads((out / "draws.json").read_text())
    assert value["options"]["scale"] > 0 and value["options"]["num_draws"] == 2
    assert value["training"]["num_views"] == 2 and value["test"]["num_views"] in (2, 3)
    for split in ("training", "test"):
        assert np.isfinite(value[split]["spread_all"]) and value[split]["spread_all"] > 0
    with Image.open(out / "draws.png") as image:
        assert min(image.size) > 300 and np.asarray(image).std() > 0


def test_wrong_flags_end_in_one_line(finished):
    folder, _ = finished
    done = script("clean_up", f"--workdir={folder}", "--keep=1.5", cache=folder / "cache")
    assert done.returncode != 0 and "--keep: 1.5" in done.stderr
    assert "Traceback" not in done.stderr


def test_runs_that_cannot_be_used_are_errors(finished, tmp_path):
    folder, _ = finished
    with pytest.raises(WorkdirError, match=r"config\.json: is missing"):
        load_run(tmp_path)
    with pytest.raises(WorkdirError, match=r"one of the finished runs: .*random/seed_0"):
        load_run(folder, seed=7)
    (tmp_path / "config.json").write_text('{"no_such_option": 1}')
    with pytest.raises(WorkdirError, match="cannot be read"):
        read_config(tmp_path / "config.json")
    (tmp_path / "config.json").write_bytes((folder / "config.json").read_bytes())
    half = tmp_path / POLICY / "seed_0"
    half.mkdir(parents=True)
    (half / "result.json").write_text('{"completed": false}')
    with pytest.raises(WorkdirError, match="completed: is false"):
        load_run(tmp_path)
