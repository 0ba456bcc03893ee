"""Scripts on a trained run, end to end on a tiny one: clean-up, posterior draws, export."""

import io
import json

import nrrd
import numpy as np
import pytest
import trimesh
from PIL import Image

from experiments.build import Problem, load_config_scene
from experiments.runtime import WorkdirError
from experiments.trained import choose_runs, field_kind, find_runs, load_run, saved_config
from tests.script_server import run_script
from tests.toy_runs import toy_config, toy_flags

POLICY = "random"
OVERRIDES = {"policies": (POLICY,), "num_rounds": 1}


@pytest.fixture(scope="module")
def cleaned(tmp_path_factory):
    """A folder that `clean_up` has filled from nothing, and what it printed."""
    folder = tmp_path_factory.mktemp("posthoc")
    flags = (f"--workdir={folder}", "--num_test=3", "--num_thresholds=6")
    done = run_script("experiments.clean_up", *toy_flags(**OVERRIDES), *flags)
    assert done.returncode == 0, done.stderr
    return folder, done.stdout


@pytest.fixture(scope="module")
def run(cleaned, cache):
    """The same, taken up in this process."""
    folder, _ = cleaned
    config = saved_config(folder)
    scene = load_config_scene(config, cache_dir=str(cache / "bavs_jax" / "scenes"))
    problem = Problem(config, scene, field_kind(POLICY))
    return load_run(problem, folder, POLICY, 0)


def is_picture(path):
    with Image.open(path) as image:
        return min(image.size) > 300 and np.asarray(image).std() > 0


@pytest.mark.slow
def test_clean_up_trains_measures_and_writes(cleaned):
    folder, out = cleaned
    assert "remaining" in out and f"the end of {POLICY} seed 0, 4 training views" in out
    value = json.loads((folder / "cleanup.json").read_text())
    assert value["command"].startswith("python -m experiments.clean_up --config=")
    assert value["config"] == json.loads((folder / "config.json").read_text())
    (row,) = value["rows"]
    assert (row["policy"], row["seed"], row["round"], row["completed"]) == (POLICY, 0, 1, True)
    assert row["num_views"] == 4
    for split in ("training", "test"):
        sweep = row["sweep"][split]
        assert len(sweep["thresholds"]) == 7 and sweep["thresholds"][-1] is None
        assert sweep["content_kept"][-1] == 1.0
        assert row["before"][split]["psnr"] == sweep["psnr"][-1]
        assert row["before"][split].keys() == row["after"][split].keys()
    loss = row["before"]["training"]["psnr"] - row["after"]["training"]["psnr"]
    assert loss <= row["options"]["max_loss"] == 0.1
    pictures = folder / POLICY / "seed_0" / "cleanup"
    assert {path.name for path in pictures.iterdir()} == {"views.png"}
    assert "| change |" in out
    assert all(map(is_picture, pictures.iterdir()))


@pytest.mark.slow
def test_posterior_draws_takes_up_the_run(cleaned):
    folder, _ = cleaned
    flags = (f"--workdir={folder}", "--num_draws=2", "--num_views=2")
    done = run_script("experiments.posterior_draws", *flags)
    assert done.returncode == 0, done.stderr
    assert "train on" not in done.stdout
    assert "| training views |" in done.stdout and "| test views |" in done.stdout
    (row,) = json.loads((folder / "draws.json").read_text())["rows"]
    assert row["options"]["scale"] > 0 and row["options"]["num_draws"] == 2
    assert row["training"]["num_views"] == 2 and row["test"]["num_views"] in (2, 3)
    for split in ("training", "test"):
        assert np.isfinite(row[split]["spread_all"]) and row[split]["spread_all"] > 0
    assert is_picture(folder / POLICY / "seed_0" / "draws" / "draws.png")


def read_vertices(path):
    shape = trimesh.load(io.BytesIO(path.read_bytes()), file_type="ply", process=False)
    return shape.metadata["_ply_raw"]["vertex"]["data"]


@pytest.mark.slow
def test_exported_files_agree_with_the_field(cleaned, run):
    base, _ = cleaned
    flags = ("--resolution=9", "--num_samples=300", "--density_threshold=0.5")
    done = run_script("experiments.export_field", f"--workdir={base}", *flags, "--min_opacity=0.01")
    assert done.returncode == 0, done.stderr
    folder = run.folder / "export"
    names = {"grid.npz", "density.nrrd", "sigma.nrrd", "uncertainty.nrrd"}
    names |= {"points.ply", "mesh.ply", "geometry.json"}
    assert {path.name for path in folder.iterdir()} == names
    assert all(str(folder / name) in done.stdout for name in names)

    point_fn = run.point_fn()
    # The script compiles by itself; float32 sums in another order.
    tolerance = {"rtol": 1e-3, "atol": 1e-5}
    with np.load(folder / "grid.npz") as data:
        assert data["density"].shape == (9, 9, 9) and data["names"].tolist() == ["density", "sigma"]
        corner = [[data[a][2] for a in "xyz"]]
        at_corner = point_fn(corner)  # the procedural scene's own coordinates are the user's
        for name in ("density", "sigma"):
            np.testing.assert_allclose(data[name][2, 2, 2], at_corner[name][0], **tolerance)
        volume, _ = nrrd.read(str(folder / "sigma.nrrd"))
        np.testing.assert_allclose(volume, data["sigma"], rtol=1e-6)

    for name in ("points.ply", "mesh.ply"):
        vertices = read_vertices(folder / name)
        assert len(vertices) > 3
        positions = np.stack([vertices[a] for a in "xyz"], -1)
        sigma = point_fn(positions)["sigma"]
        np.testing.assert_allclose(vertices["sigma"], sigma, **tolerance)
        expected = np.clip((np.log10(1.5 * sigma) + 3.0) / 9.0, 0.0, 1.0)  # of a box of side 2
        np.testing.assert_allclose(vertices["uncertainty"], expected, atol=1e-3)
    (geometry,) = json.loads((folder / "geometry.json").read_text())["rows"]
    assert geometry["round"] == 1 and geometry["num_views"] == 4
    assert geometry["whole"]["chamfer"] > geometry["floor"]["chamfer"] > 0.0


@pytest.mark.slow
def test_a_run_is_taken_up_as_it_was(cleaned, run):
    folder, _ = cleaned
    assert saved_config(folder).to_dict() == toy_config(**OVERRIDES).to_dict()
    assert run.completed and len(run.training_views) == 4
    rounds = json.loads((run.folder / "result.json").read_text())["rounds"]
    selected = np.concatenate([row["selected"] for row in rounds])
    assert run.training_views.tolist() == sorted(selected)
    view = int(run.training_views[0])
    truth, mask = run.photo(view)
    np.testing.assert_allclose(truth, run.problem.scene.image(view) / 255.0)
    assert mask.shape == truth.shape[:2] and mask.all() and run.num_rays == 2 * mask.size


@pytest.mark.slow
def test_which_runs_are_taken_up(cleaned):
    folder, _ = cleaned
    config = saved_config(folder)
    assert find_runs(folder) == [("initial", 0), (POLICY, 0)]
    assert choose_runs(folder, config, "", None) == [(POLICY, 0)]
    assert choose_runs(folder, config, "initial", 0) == [("initial", 0)]
    known = f"--policy=initial --seed=0, --policy={POLICY} --seed=0"
    for policy, seed in (("bavs", None), ("", 7)):
        with pytest.raises(WorkdirError, match=f"holds no checkpoint; runs that do: {known}"):
            choose_runs(folder, config, policy, seed)
    assert not (folder / "bavs").exists()
    config.policies = ("bavs",)  # not started: what there is of it is round 0
    assert choose_runs(folder, config, "", None) == [("initial", 0)]


def test_configs_that_cannot_be_used_are_errors(tmp_path):
    with pytest.raises(WorkdirError, match=r"config\.json: does not exist: give the --workdir"):
        saved_config(tmp_path)
    for text in ("{", '{"no_such_option": 1}', '{"num_rounds": "two"}', "[]"):
        (tmp_path / "config.json").write_text(text)
        with pytest.raises(WorkdirError, match="cannot be read"):
            saved_config(tmp_path)


@pytest.mark.parametrize(
    "name, flag, message",
    [
        ("clean_up", "--keep=1.5", "--keep=1.5: 1.5 is not a number in the range [1e-06, 1.0]"),
        ("export_field", "--what=grid,voxels", "--what: ['grid', 'voxels'] cannot be used"),
        ("posterior_draws", "--num_draws=2", "config.json: does not exist"),
    ],
)
def test_wrong_flags_end_in_one_line(tmp_path, name, flag, message):
    done = run_script(f"experiments.{name}", f"--workdir={tmp_path}", flag)
    assert done.returncode != 0 and "Traceback" not in done.stderr
    assert done.stderr.startswith("error: ") and message in done.stderr
