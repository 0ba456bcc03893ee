"""COLMAP models that the test writes through pycolmap: text, binary, lenses, names, places."""

from __future__ import annotations

import builtins

import numpy as np
import pytest

from bavs_jax.cameras import pixel_rays
from bavs_jax.scenes import SceneError, detect_kind, load_colmap, load_nerfstudio
from bavs_jax.scenes.poses import user_transforms
from tests.scene_files import (
    orbit,
    random_image,
    write_colmap,
    write_colmap_model,
    write_colmap_text,
    write_images,
    write_nerfstudio,
)

pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is in the extra [colmap]")


@pytest.mark.parametrize("write", [write_colmap, write_colmap_text])
def test_poses_lens_and_pixels(tmp_path, write):
    root = write(tmp_path / "toy")
    assert detect_kind(root) == "colmap"
    scene = load_colmap(root)
    assert scene.cameras.lens == "opencv"
    assert scene.unbounded
    assert scene.names[3] == "images/003.png"
    np.testing.assert_allclose(scene.cameras.intrinsics, [[15.0, 16.0, 5.5, 4.5]] * 9)
    np.testing.assert_allclose(scene.cameras.distortion, [[0.1, 0, 0, 0, 0, 0.01]] * 9)
    np.testing.assert_array_equal(scene.image(4), random_image(4, 12, 8, 3))
    user = user_transforms(scene, scene.cameras.world_from_cam)
    np.testing.assert_allclose(user, orbit(9), atol=1e-5)  # float32 poses of size 4


@pytest.mark.parametrize("folder", ["sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse"])
def test_places_of_the_model(tmp_path, folder):
    assert load_colmap(write_colmap(tmp_path, folder=folder)).num_views == 9


MODELS = {
    "SIMPLE_PINHOLE": ((15.0, 6.0, 4.0), "pinhole", [0, 0, 0, 0, 0, 0]),
    "PINHOLE": ((15.0, 16.0, 6.0, 4.0), "pinhole", [0, 0, 0, 0, 0, 0]),
    "SIMPLE_RADIAL": ((15.0, 6.0, 4.0, 0.1), "opencv", [0.1, 0, 0, 0, 0, 0]),
    "RADIAL": ((15.0, 6.0, 4.0, 0.1, 0.2), "opencv", [0.1, 0.2, 0, 0, 0, 0]),
    "OPENCV": (
        (15.0, 16.0, 6.0, 4.0, 0.1, 0.2, 0.03, 0.04),
        "opencv",
        [0.1, 0.2, 0, 0, 0.03, 0.04],
    ),
    "FULL_OPENCV": (
        (15.0, 16.0, 6.0, 4.0, 0.1, 0.2, 0.03, 0.04, 0.05, 0.0, 0.0, 0.0),
        "opencv",
        [0.1, 0.2, 0.05, 0, 0.03, 0.04],
    ),
    "OPENCV_FISHEYE": (
        (15.0, 16.0, 6.0, 4.0, 0.1, 0.2, 0.03, 0.04),
        "fisheye",
        [0.1, 0.2, 0.03, 0.04, 0, 0],
    ),
    "SIMPLE_RADIAL_FISHEYE": ((15.0, 6.0, 4.0, 0.1), "fisheye", [0.1, 0, 0, 0, 0, 0]),
    "RADIAL_FISHEYE": ((15.0, 6.0, 4.0, 0.1, 0.2), "fisheye", [0.1, 0.2, 0, 0, 0, 0]),
}


@pytest.mark.parametrize("model", MODELS)
def test_lens_models_mean_what_colmap_means(tmp_path, model):
    params, lens, distortion = MODELS[model]
    scene = load_colmap(write_colmap(tmp_path, model=model, params=params))
    assert scene.cameras.lens == lens
    np.testing.assert_allclose(scene.cameras.distortion[0], distortion)

    camera = pycolmap.Camera(model=model, width=12, height=8, params=list(params))
    pixels = np.array([[1.0, 2.0], [6.0, 4.0], [11.0, 7.5]])
    rays = pixel_rays(scene.cameras, np.full(3, 2), pixels.astype(np.float32))
    local = np.asarray(rays.directions) @ np.asarray(scene.cameras.world_from_cam)[2, :, :3]
    theirs = np.array([camera.cam_ray_from_img(pixel) for pixel in pixels]) * [1.0, -1.0, -1.0]
    theirs /= np.linalg.norm(theirs, axis=-1, keepdims=True)
    np.testing.assert_allclose(local, theirs, atol=1e-5)  # float32


def camera(model: str, *params: float, width: int = 12, height: int = 8) -> dict:
    return {"model": model, "width": width, "height": height, "params": list(params)}


def test_a_capture_of_two_cameras(tmp_path):
    """Each view has its own intrinsics; a pinhole and an opencv lens go together."""
    write_images(tmp_path / "images", 4, 12, 8)
    cameras = [camera("PINHOLE", 15, 15, 6, 4), camera("SIMPLE_RADIAL", 20, 6, 4, 0.3)]
    write_colmap_model(tmp_path / "sparse", num=4, cameras=cameras, text=False)
    loaded = load_colmap(tmp_path, pool_size=2).cameras
    assert loaded.lens == "opencv"
    np.testing.assert_allclose(loaded.intrinsics[:, 0], [15, 20, 15, 20])
    np.testing.assert_allclose(loaded.distortion[:, 0], [0, 0.3, 0, 0.3], rtol=1e-6)


def test_down_scaled_copies_may_be_renamed(tmp_path):
    root = write_colmap(tmp_path)
    write_images(root / "images_2", 9, 6, 4)
    for file in sorted((root / "images_2").iterdir()):
        file.rename(file.with_name(f"image{file.name}"))
    scene = load_colmap(root, downscale=2)
    assert scene.names[5] == "images_2/image005.png"
    np.testing.assert_array_equal(scene.image(5), random_image(5, 6, 4, 3))
    np.testing.assert_allclose(scene.cameras.intrinsics[0], [7.5, 8.0, 2.75, 2.25])
    (root / "images_2/image003.png").unlink()
    with pytest.raises(SceneError, match="9 of 9 images have no file"):
        load_colmap(root, downscale=2)


def test_missing_images_are_skipped_with_one_warning(tmp_path):
    root = write_colmap(tmp_path)
    (root / "images/004.png").unlink()
    with pytest.warns(UserWarning, match=r"1 of 9 images have no file \(004\.png\)"):
        assert load_colmap(root).num_views == 8
    with pytest.raises(SceneError, match="1 of 9 images have no file"):
        load_colmap(root, strict=True)


def test_without_pycolmap_the_message_says_what_to_install(tmp_path, monkeypatch):
    root = write_colmap(tmp_path)
    real_import = builtins.__import__

    def without(name, *args, **kwargs):
        if name == "pycolmap":
            raise ImportError(name)
        return real_import(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(SceneError, match=r"pip install 'bavs_jax\[colmap\]'"):
        load_colmap(root)
    assert load_nerfstudio(write_nerfstudio(tmp_path / "other")).num_views == 8


# --- several models --------------------------------------------------------------------------

PINHOLE = {"model": "PINHOLE", "width": 12, "height": 8, "params": [15.0, 15.0, 6.0, 4.0]}


def write_model(folder, num: int, *, text: bool = False, focal: float = 15.0) -> None:
    camera = PINHOLE | {"params": [focal, focal, 6.0, 4.0]}
    write_colmap_model(folder, num=num, cameras=[camera], text=text)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("largest", ["sparse/1", "sparse/10", "sparse", "colmap/sparse/1"])
def test_of_several_models_the_largest_is_taken(tmp_path, largest, text):
    write_images(tmp_path / "images", 9, 12, 8)
    write_model(tmp_path / "sparse/0", 4, text=text)
    write_model(tmp_path / "sparse/2", 5, text=text)
    write_model(tmp_path / largest, 8, text=text)
    with pytest.warns(UserWarning) as caught:
        scene = load_colmap(tmp_path)
    models, unposed = (str(warning.message) for warning in caught)
    assert scene.num_views == 8
    assert models.startswith(f"{tmp_path / largest}: model taken, with 8 images; left out: ")
    assert models.endswith("sparse/2 with 5, sparse/0 with 4")
    assert unposed.endswith("1 of 9 photos in images have no pose (008.png): left out")


def test_photos_before_the_distortion_was_taken_out(tmp_path):
    """A model in `distorted` belongs to the photos in `input`, however many images it has."""
    write_images(tmp_path / "input", 9, 12, 8)
    write_model(tmp_path / "distorted/sparse/0", 4)
    write_model(tmp_path / "distorted/sparse/1", 9, focal=20.0)
    assert detect_kind(tmp_path) == "colmap"
    with pytest.warns(UserWarning, match=r"sparse/1: model taken, .*sparse/0 with 4"):
        scene = load_colmap(tmp_path)
    assert scene.names[3] == "input/003.png"
    np.testing.assert_allclose(scene.cameras.intrinsics[:, 0], 20.0)

    write_images(tmp_path / "images", 9, 12, 8)
    write_model(tmp_path / "sparse/0", 8)
    with pytest.warns(UserWarning, match="left out: distorted/sparse/1 with 9, distorted/sparse/0"):
        scene = load_colmap(tmp_path)
    assert scene.names[3] == "images/003.png"
    np.testing.assert_allclose(scene.cameras.intrinsics[:, 0], 15.0)


def test_photos_without_a_pose_are_counted_and_named(tmp_path):
    root = write_colmap(tmp_path)
    write_images(root / "images/more", 4, 12, 8, seed=100)
    with pytest.warns(UserWarning) as caught:
        assert load_colmap(root).num_views == 9
    assert len(caught) == 1
    assert str(caught[0].message).endswith(
        "4 of 13 photos in images have no pose (more/000.png, more/001.png, more/002.png, ...): "
        "left out"
    )
