"""Checkpoints that are damaged in every way, on their own and under a run that goes on."""

import os
import shutil

import jax
import numpy as np
import pytest

from bavs_jax.training.checkpoints import Checkpoints

STATE = {"a": np.linspace(0.0, 1.0, 5000, dtype=np.float32), "b": {"c": np.ones((3, 4), np.int32)}}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Two checkpoints of the same state."""
    folder = tmp_path_factory.mktemp("whole")
    checkpoints = Checkpoints(folder)
    for number in (1, 2):
        checkpoints.save(number, STATE, {"number": number})
    checkpoints.close()
    return folder


def restored(folder):
    """(State, meta, what was said) of a folder as a later process finds it."""
    said = []
    checkpoints = Checkpoints(folder, warn_fn=said.append)
    found = checkpoints.restore(STATE)
    checkpoints.close()
    return (*(found or (None, None)), said)


def check_that_it_went_on(folder, capfd):
    """One of the two is found; if it is the older one, the other is named and kept aside."""
    state, meta, said = restored(folder)
    jax.tree.map(np.testing.assert_array_equal, state, STATE)
    if meta["number"] == 1:
        (line,) = said
        assert line.startswith(f"{folder / '2'}: ") and "bad_2" in line and "\n" not in line
        assert (folder / "bad_2").is_dir() and not (folder / "2").exists()
    else:
        assert said == []
    assert restored(folder)[1:] == (meta, [])  # said once
    assert capfd.readouterr() == ("", "")
    return meta["number"]


def test_a_damaged_file_of_the_newest_makes_the_older_one_count(whole, tmp_path, capfd):
    files = [p.relative_to(whole) for p in sorted((whole / "2").rglob("*")) if p.is_file()]
    size = {file: (whole / file).stat().st_size for file in files}
    damages = {
        "empty": lambda path, size: path.write_bytes(b""),
        "cut": lambda path, size: os.truncate(path, size // 2),
        "gone": lambda path, size: path.unlink(),
        "noise": lambda path, size: path.write_bytes(np.random.default_rng(0).bytes(size)),
    }
    found = {}
    for name, damage in damages.items():
        for file in files:
            folder = shutil.copytree(whole, tmp_path / name / str(len(found)))
            damage(folder / file, size[file])
            found[name, str(file)] = check_that_it_went_on(folder, capfd)
    # What matters is not there twice; the rest is what a checkpoint does without.
    for file in ("2/meta/metadata", "2/state/manifest.ocdbt"):
        assert {found[name, file] for name in damages} == {1}
    assert {*found.values()} == {1, 2}


@pytest.mark.parametrize("part", ["", "meta", "state", "state/d", "state/ocdbt.process_0"])
def test_a_folder_of_the_newest_that_is_empty_makes_the_older_one_count(
    whole, tmp_path, part, capfd
):
    folder = shutil.copytree(whole, tmp_path / "c")
    shutil.rmtree(folder / "2" / part)
    (folder / "2" / part).mkdir()
    assert check_that_it_went_on(folder, capfd) == 1


def test_an_empty_folder_with_a_higher_number_is_set_aside_and_saving_goes_on(whole, tmp_path):
    folder = shutil.copytree(whole, tmp_path / "c")
    (folder / "9").mkdir()
    (folder / "bad_9").mkdir()  # of an earlier time
    (folder / "bad_9" / "kept").touch()
    checkpoints = Checkpoints(folder, warn_fn=lambda line: None)
    assert checkpoints.restore(STATE)[1] == {"number": 2}
    checkpoints.save(3, STATE, {"number": 3})
    assert restored(folder)[1:] == ({"number": 3}, [])
    assert (folder / "bad_9" / "kept").exists() and (folder / "bad_9_2").is_dir()


def test_without_one_that_loads_there_is_none_and_all_are_kept(whole, tmp_path):
    folder = shutil.copytree(whole, tmp_path / "c")
    for number in "12":
        (folder / number / "meta" / "metadata").write_bytes(b"")
    state, meta, said = restored(folder)
    assert state is meta is None and len(said) == 2
    assert sorted(p.name for p in folder.iterdir()) == ["bad_1", "bad_2"]
    assert restored(folder) == (None, None, [])


def test_a_full_disk_is_one_line_that_names_the_folder(tmp_path, capfd):
    """A limit on the size of files stands in for the disk: it fails in the same places."""
    resource = pytest.importorskip("resource")
    noise = {"a": np.random.default_rng(0).normal(size=5000), "b": STATE["b"]}
    checkpoints = Checkpoints(tmp_path / "c")
    checkpoints.save(1, STATE, {"number": 1})
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (3000, before[1]))
    try:
        with pytest.raises(OSError, match="cannot be written") as error:
            checkpoints.save(2, noise, {"number": 2})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert str(error.value).startswith(f"{tmp_path / 'c'}: ") and "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")
    assert restored(tmp_path / "c")[1:] == ({"number": 1}, [])
