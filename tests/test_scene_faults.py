"""Every fault of the table, on every layout that it reaches: one line with file, field and fix."""

from __future__ import annotations

import os
import pathlib
import warnings

import pytest

from bavs_jax.scenes import SceneError, load_blender, load_llff, load_nerfstudio, load_scene
from tests.scene_faults import FAULTS, TABLES
from tests.scene_files import write_blender, write_llff, write_nerfstudio
from tests.scene_layouts import COLMAP, LAYOUTS

CASES = [
    pytest.param(name, layout, id=f"{name} [{layout}]")
    for name, fault in FAULTS.items()
    for layout in fault.layouts
]


def check_message(error: SceneError, root: pathlib.Path) -> None:
    """One line: where it is, what is wrong, and how to mend it."""
    message = str(error)
    assert "\n" not in message
    assert str(root) in message
    assert len(message.removeprefix(str(root)).split(": ")) >= 3


def need_pycolmap(layout: str) -> None:
    if layout in COLMAP:
        pytest.importorskip("pycolmap", reason="pycolmap is in the extra [colmap]")


@pytest.mark.parametrize(("name", "layout"), CASES)
def test_fault(tmp_path, name, layout):
    need_pycolmap(layout)
    fault, layout = FAULTS[name], LAYOUTS[layout]
    root = layout.write(tmp_path / "scene")
    fault.damage(root, layout)
    with warnings.catch_warnings(), pytest.raises(SceneError, match=fault.message) as caught:
        warnings.simplefilter("error")
        load_scene(layout.kind, root=root, **fault.options)
    check_message(caught.value, root)


def test_there_are_many_faults():
    assert len(FAULTS) >= 40
    assert len(FAULTS) == sum(len(table) for table in TABLES)  # no name twice
    reached = {layout for fault in FAULTS.values() for layout in fault.layouts}
    assert reached == set(LAYOUTS)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_undamaged_files_load(tmp_path, layout):
    """So that no fault of the table is found because of something else."""
    need_pycolmap(layout)
    layout = LAYOUTS[layout]
    root = layout.write(tmp_path)
    layout.edit_poses(root, lambda poses: poses)
    assert load_scene(layout.kind, root=root).num_views >= 2


# --- the folder itself -----------------------------------------------------------------------


@pytest.mark.parametrize("kind", sorted({layout.kind for layout in LAYOUTS.values()} | {"auto"}))
def test_folder_that_is_missing_empty_or_a_file(tmp_path, kind):
    with pytest.raises(SceneError, match="nowhere: folder is missing: check the path") as caught:
        load_scene(kind, root=tmp_path / "nowhere")
    check_message(caught.value, tmp_path)
    with pytest.raises(SceneError, match="no known layout: looked for transforms") as caught:
        load_scene(kind, root=tmp_path)
    check_message(caught.value, tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(SceneError, match="file: is a file: give the scene's folder") as caught:
        load_scene(kind, root=tmp_path / "file")
    check_message(caught.value, tmp_path)


@pytest.mark.parametrize(
    ("kind", "write", "found"),
    [
        ("llff", write_nerfstudio, "nerfstudio"),
        ("colmap", write_blender, "blender"),
        ("nerfstudio", write_llff, "llff"),
        ("blender", write_nerfstudio, "nerfstudio"),
        ("mipnerf360", write_nerfstudio, "nerfstudio"),
        ("lightfield", write_blender, "blender"),
    ],
)
def test_wrong_kind_names_the_right_one(tmp_path, kind, write, found):
    root = write(tmp_path)
    with pytest.raises(SceneError, match=f"is no {kind} scene but a {found} one: load it as"):
        load_scene(kind, root=root)


@pytest.mark.parametrize(
    ("load", "write"),
    [(load_blender, write_blender), (load_nerfstudio, write_nerfstudio), (load_llff, write_llff)],
)
def test_files_without_permission_are_named(tmp_path, monkeypatch, load, write):
    """Refused by the operating system; root may read anything, so the refusal is acted."""
    root = write(tmp_path)

    def refuse(path, *args, **kwargs):
        raise PermissionError(13, "Permission denied", os.fspath(path))

    monkeypatch.setattr(pathlib.Path, "is_file", refuse)
    with pytest.raises(
        SceneError, match="Permission denied: check the file and its perm"
    ) as caught:
        load(root)
    check_message(caught.value, root)
