"""Folders whose files are damaged or missing, full disks, and caches that cannot be used."""

import errno
import json
import os
import pathlib
import resource
import shutil
import subprocess
import sys

import numpy as np
import pytest

from bavs_jax.scenes import procedural
from experiments import files, runner, runtime
from experiments.files import append_line, read_arrays, read_json, write_arrays, write_json
from experiments.reporting.report import write_report
from experiments.runtime import ReportError, WorkdirError
from experiments.trained import saved_config
from tests.script_server import ROOT, run_script
from tests.toy_runs import TINY, same_results, toy_config, toy_flags

PART = "bavs/seed_0"


@pytest.fixture(scope="module")
def run_all(cache):
    """`run_all(folder)`: the script's work; scene and compiled programs are made once."""
    config = toy_config(policies=("bavs",), **TINY)
    scene = runner.load_config_scene(config, cache_dir=str(cache / "scenes"))
    problem = runner.Problem(config, scene)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "load_config_scene", lambda *args, **options: scene)
        patch.setattr(runner, "Problem", lambda *args: problem)
        yield lambda folder: runner.run_all(config, folder, "command", None)


@pytest.fixture(scope="module")
def finished(run_all, tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished")
    run_all(folder)
    return folder


@pytest.fixture
def copy(finished, tmp_path):
    return shutil.copytree(finished, tmp_path / "copy")


def cut(path):
    os.truncate(path, path.stat().st_size // 2)


def empty(path):
    path.write_bytes(b"")


def one_line(text, *names):
    assert text.count("\n") == 1 and all(str(name) in text for name in names), text


# --- files of a run ---


@pytest.mark.parametrize(
    "name, damage", [("result.json", cut), ("acquisition.npz", empty), ("pictures.npz", cut)]
)
def test_a_damaged_file_of_a_finished_run_is_made_again(
    run_all, finished, copy, capsys, name, damage
):
    before = (copy / PART / "result.json").read_bytes()
    damage(copy / PART / name)
    run_all(copy)
    one_line(capsys.readouterr().err, copy / PART / name, "damaged", "made again")
    same_results(copy, finished)
    if name != "result.json":  # which may hold what has been measured since
        assert (copy / PART / "result.json").read_bytes() == before
    with (
        np.load(copy / PART / "pictures.npz") as got,
        np.load(finished / PART / "pictures.npz") as want,
    ):
        np.testing.assert_allclose(got["rgb"], want["rgb"], atol=1)


def test_missing_files_of_a_finished_run_are_made_again(run_all, finished, copy):
    shutil.rmtree(copy / PART / "next_views")
    shutil.rmtree(copy / "next_views")
    (copy / PART / "acquisition.npz").unlink()
    (copy / "summary.json").unlink()
    run_all(copy)
    same_results(copy, finished)


def test_damaged_checkpoints_are_trained_again(run_all, finished, copy, capsys):
    """Of round 0 and of the run, all of them and without a result: the end is the same."""
    for path in copy.rglob("checkpoints/*/meta/metadata"):
        empty(path)
    (copy / PART / "result.json").unlink()
    run_all(copy)
    err = capsys.readouterr().err
    assert err.count("checkpoint is damaged") == err.count("\n") == 4
    assert len([*copy.rglob("checkpoints/bad_*")]) == 4
    same_results(copy, finished)


@pytest.mark.parametrize("damage", [cut, pathlib.Path.unlink])
def test_a_damaged_choice_is_named_before_any_work(run_all, copy, damage):
    damage(copy / PART / "choices" / "round_1.npz")
    (copy / PART / "acquisition.npz").unlink()
    with pytest.raises(
        WorkdirError, match=r"round_1\.npz.*delete .*seed_0 to run it anew"
    ) as error:
        run_all(copy)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("content", ["", '{"policies": ["ba', "[]", "null", "[" * 100_000])
def test_a_damaged_config_is_named_with_the_fix(run_all, copy, capsys, content):
    (copy / "config.json").write_text(content)
    with pytest.raises(WorkdirError, match=r"config\.json: damaged .*: delete it if"):
        run_all(copy)
    capsys.readouterr()
    with pytest.raises(WorkdirError, match=r"config\.json"):
        saved_config(copy)
    (copy / "config.json").unlink()
    files.claim(copy, toy_config(policies=("bavs",), **TINY))
    assert read_json(copy / "config.json")["policies"] == ["bavs"]


def test_stray_folders_and_damaged_results_of_others_are_left_out(copy, capsys):
    shutil.copytree(copy / PART, copy / "x" / "seed_abc")
    shutil.copytree(copy / PART, copy / "y" / "seed_7")
    empty(copy / "y" / "seed_7" / "result.json")
    assert [run["policy"] for run in files.collect(copy)["runs"]] == ["bavs"]
    files.collect(copy)  # says nothing more
    err = capsys.readouterr().err.splitlines()
    assert len(err) == 2 and "seed_abc: not seed_<number>" in "".join(err)


@pytest.mark.parametrize("name", ["acquisition.npz", "pictures.npz"])
@pytest.mark.parametrize("damage", [cut, empty])
def test_a_report_of_damaged_files_names_them(copy, name, damage):
    damage(copy / PART / name)
    with pytest.raises(ReportError, match=rf"{name}: damaged .*run the experiment again") as error:
        write_report(copy)
    assert "\n" not in str(error.value)


def test_half_a_line_in_the_log_spoils_no_other(tmp_path):
    event = {"event": "train", "policy": "bavs", "seed": 0, "round": 0, "step": 4}
    append_line(tmp_path / "metrics.jsonl", event)
    cut(tmp_path / "metrics.jsonl")
    append_line(tmp_path / "metrics.jsonl", event | {"step": 8})
    half, whole = (tmp_path / "metrics.jsonl").read_text().splitlines()
    assert json.loads(whole) == event | {"step": 8} and half[:4] == '{"ev'


def test_arrays_of_noise_in_an_archive_are_damaged_whatever_they_break(tmp_path):
    write_arrays(tmp_path / "whole.npz", a=np.arange(1000.0), b=np.ones(3))
    whole = (tmp_path / "whole.npz").read_bytes()
    path = tmp_path / "noise.npz"
    num_damaged = 0
    for i in range(0, len(whole), 7):
        path.write_bytes(whole[:i] + bytes([whole[i] ^ 0xFF]) + whole[i + 1 :])
        num_damaged += read_arrays(path, "a", "b") is None
    assert num_damaged > 50


# --- a refused option leaves nothing behind ---

REFUSED = [
    ("active_selection", ["--config.num_initial=1000"]),
    ("active_selection", ["--config.uncertainty.weighting=eq12"]),
    ("clean_up", ["--config.num_initial=1000"]),
    ("evaluate_uncertainty", ["--config.num_initial=1000"]),
    ("sweep", ["--axis=config.uncertainty.weighting=gauss_newton,eq12"]),
]


@pytest.mark.parametrize(
    "script, flags",
    [pytest.param(*r, marks=[] if r == REFUSED[0] else pytest.mark.slow) for r in REFUSED],
)
def test_a_refused_option_leaves_no_folder(tmp_path, script, flags):
    workdir = f"--workdir={tmp_path / 'new'}"
    done = run_script(f"experiments.{script}", workdir, *toy_flags(), *flags)
    assert done.returncode == 1 and done.stderr.startswith("error: ")
    one_line(done.stderr, flags[0][-4:])
    assert not (tmp_path / "new").exists()


def test_another_config_is_refused_only_where_something_was_made(copy, tmp_path):
    files.claim(tmp_path / "new", toy_config(scene="lgo"))
    files.claim(tmp_path / "new", toy_config(scene="lego"))
    assert read_json(tmp_path / "new" / "config.json")["scene"] == "lego"
    before = (copy / "config.json").read_bytes()
    with pytest.raises(WorkdirError, match="scene: differs"):
        files.claim(copy, toy_config(policies=("bavs",), scene="lego", **TINY))
    assert (copy / "config.json").read_bytes() == before


# --- full disks and caches ---


@pytest.fixture
def full_disk():
    """A limit on the size of files stands in for it: what is written fails in the same places."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_is_one_line_that_names_the_file(tmp_path, full_disk):
    append_line(tmp_path / "log", {"a": "b" * 900})
    write_json(tmp_path / "a.json", {"a": 1})
    noise = np.random.default_rng(0).normal(size=5000)
    for name, write in {
        "a.json": lambda path: write_json(path, {"a": "b" * 5000}),
        "a.npz": lambda path: write_arrays(path, a=noise),
        "log": lambda path: append_line(path, {"a": "b" * 900}),
    }.items():
        with pytest.raises(WorkdirError, match="cannot be written") as error:
            write(tmp_path / name)
        assert str(error.value).startswith(f"{tmp_path / name}: ") and "\n" not in str(error.value)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.json", "log"]
    assert read_json(tmp_path / "a.json") == {"a": 1}  # as it was


def test_a_script_on_a_full_disk_says_so_in_one_line(copy):
    command = f"ulimit -f 2; exec {sys.executable} -m experiments.figures --workdir={copy}"
    done = subprocess.run(["sh", "-c", command], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 1
    one_line(done.stderr, "error: ", copy / "figures" / "psnr.png", "cannot be written")


@pytest.mark.parametrize("name", ["file/cache", "dev/null"])
def test_a_cache_that_cannot_be_used_is_one_warning(tmp_path, monkeypatch, capsys, name):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / name if name[0] == "f" else f"/{name}"))
    assert runtime.cache_folder() is None and runtime.scene_cache() is None
    one_line(capsys.readouterr().err, "warning: ", os.environ["XDG_CACHE_HOME"], "without a cache")


def test_a_user_without_a_home_goes_without_a_cache(monkeypatch, capsys):
    def nobody(path):
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(pathlib.Path, "expanduser", nobody)
    assert runtime.scene_cache() is None
    one_line(capsys.readouterr().err, "warning: ", "XDG_CACHE_HOME")


def test_a_cache_on_a_full_disk_loses_no_scene(tmp_path, monkeypatch):
    def replace(*args):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(procedural.os, "replace", replace)
    with pytest.warns(UserWarning, match="cannot be written"):
        scene = procedural.load_procedural(image_size=4, cache_dir=tmp_path)
    assert scene.num_views > 0 and not [*tmp_path.iterdir()]


def test_parts_are_finished_only_with_all_files_whole(copy):
    part = files.Part("bavs", "reconstruction", 0)
    assert files.is_finished(copy, part) and files.is_finished(copy, part.initial)
    for path in (copy / PART / "result.json", copy / "initial" / "seed_0" / "round_0.json"):
        text = path.read_text()
        path.write_text(text[: len(text) // 2])
        assert not files.is_finished(copy, part if "bavs" in str(path) else part.initial)
        path.write_text(text)
    result = json.loads((copy / PART / "result.json").read_text())
    write_json(copy / PART / "result.json", result | {"completed": False})
    assert not files.is_finished(copy, part)
