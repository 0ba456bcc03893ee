"""The loaders on public benchmark scenes, where they are at hand."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from bavs_jax.cameras import image_pixels, pixel_rays
from bavs_jax.scenes import load_blender, load_nerfstudio
from tests.scene_files import DATA


def folder(name: str):
    """A scene's folder, or a skip with the reason."""
    path = DATA / name
    if not path.is_dir():
        pytest.skip(f"{path} is absent: set BAVS_DATA to a folder that holds {name}")
    return path


@pytest.fixture(scope="module")
def lego():
    return load_blender(folder("blender/lego"), image_size=100)


def test_lego_has_its_splits(lego):
    assert (len(lego.pool), len(lego.test)) == (100, 200)
    assert lego.pixels.shape == (300 * 100 * 100, 3)
    assert lego.name == "lego"
    corners = lego.pixels[lego.offsets[:-1]]
    np.testing.assert_array_equal(corners, 255)  # white background


def test_lego_depth_is_distance_along_the_ray(lego):
    """Surface points of one test view, seen from a neighbouring one, have its depth there."""
    agree = {}
    for kind in ("ray", "axis"):
        differences = []
        for view, other in ((150, 155), (200, 215), (250, 262)):
            rays = pixel_rays(lego.cameras, np.full(10000, view), image_pixels(100, 100))
            directions = np.asarray(rays.directions)
            depth = lego.depth_image(view).ravel()
            forward = -np.asarray(lego.cameras.world_from_cam[view])[:, 2]
            along = depth if kind == "ray" else depth / (directions @ forward)
            points = (np.asarray(rays.origins) + along[:, None] * directions)[depth > 0]
            pose = np.asarray(lego.cameras.world_from_cam[other])
            local = (points - pose[:, 3]) @ pose[:, :3]
            focal = lego.cameras.intrinsics[other, 0]
            x, y = (50 + focal * local[:, :2].T * [[-1], [1]] / local[:, 2]).astype(int)
            inside = (x >= 0) & (x < 100) & (y >= 0) & (y < 100)
            seen = lego.depth_image(other)[y[inside], x[inside]]
            there = np.linalg.norm(local, axis=-1) if kind == "ray" else -local[:, 2]
            differences.append((there[inside] - seen)[seen > 0])
        agree[kind] = np.mean(np.abs(np.concatenate(differences)) < 0.05)
    # The rest is hidden from the other view, or beside a pixel's centre at 100 x 100.
    assert agree["ray"] > 0.6
    assert agree["ray"] > agree["axis"] + 0.05  # and it is no distance along the optical axis


def test_fox_skips_what_has_no_file():
    root = folder("nerfstudio/fox")
    with pytest.warns(UserWarning, match="17 of 67 images have no file") as caught:
        scene = load_nerfstudio(root, image_size=27)
    assert len(caught) == 1
    assert scene.num_views == 50
    assert scene.cameras.lens == "opencv"
    np.testing.assert_array_equal(scene.cameras.sizes, [[27, 48]] * 50)


def test_egypt_loads_with_the_protocol_of_200_views():
    root = folder("nerfstudio/Egypt")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = load_nerfstudio(root, image_size=48, pool_size=200)
    assert (len(scene.pool), len(scene.test)) == (200, 102)
    np.testing.assert_allclose(np.abs(scene.cameras.positions).max(), 1.0, rtol=1e-6)
    np.testing.assert_array_equal(scene.cameras.sizes[0], [48, 27])
