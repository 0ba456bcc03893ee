"""The loaders on public benchmark scenes, where they are at hand."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from bavs_jax.cameras import image_pixels, pixel_rays
from bavs_jax.scenes import detect_kind, load_blender, load_llff, load_nerfstudio, load_scene
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


def test_fern_loads_with_the_protocol_of_every_eighth_view():
    scene = load_llff(folder("llff/fern"))
    np.testing.assert_array_equal(scene.test, [0, 8, 16])
    assert len(scene.pool) == 17
    np.testing.assert_array_equal(scene.cameras.sizes[0], [504, 378])
    np.testing.assert_allclose(scene.cameras.intrinsics[0, :2], 3260.526 / 8, rtol=1e-5)
    # Forward-facing: cameras side by side, upright, and the box before them.
    forward = -np.asarray(scene.cameras.world_from_cam)[:, :, 2]
    assert (forward @ forward.mean(axis=0) > 0.9).all()
    assert scene.cameras.world_from_cam[:, 2, 1].min() > 0.9
    to_centre = scene.centre - np.asarray(scene.cameras.positions)
    assert ((to_centre * forward).sum(axis=-1) > scene.near).all()


@pytest.mark.parametrize(
    "name", ["llff/fern", "nerfstudio/fox", "nerfstudio/Egypt", "blender/lego"]
)
def test_kinds_are_told_apart(name):
    assert detect_kind(folder(name)) == name.split("/")[0]


def match_points(first: np.ndarray, second: np.ndarray, num: int) -> list[np.ndarray]:
    """Pixels [num, 2] of the same places in two photographs, the surest matches first."""
    cv2 = pytest.importorskip("cv2", reason="opencv-python-headless is in the extra [test]")
    sift = cv2.SIFT_create(800)
    points, features = zip(
        *(sift.detectAndCompute(cv2.cvtColor(i, cv2.COLOR_RGB2GRAY), None) for i in (first, second))
    )
    matches = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True).match(*features)
    matches = sorted(matches, key=lambda match: match.distance)[:num]
    pairs = [[points[0][m.queryIdx].pt, points[1][m.trainIdx].pt] for m in matches]
    return list(np.swapaxes(np.array(pairs, np.float32) + 0.5, 0, 1))  # centres at integers


@pytest.mark.parametrize(
    ("name", "image_size", "views"),
    [
        ("llff/fern", 252, (0, 1)),
        ("llff/fern", 252, (5, 16)),
        ("nerfstudio/fox", 270, (10, 12)),
        ("nerfstudio/Egypt", 480, (50, 53)),
    ],
)
@pytest.mark.filterwarnings("ignore:.*images have no file")
def test_rays_through_matching_points_meet(name, image_size, views):
    """Axes, focal length, centre and lens are right: rays of two views meet in front of both."""
    scene = load_scene("auto", root=folder(name), image_size=image_size)
    points = match_points(*(scene.image(view) for view in views), num=60)
    rays = [pixel_rays(scene.cameras, np.full(60, v), p) for v, p in zip(views, points)]
    (o1, d1), (o2, d2) = (
        (np.asarray(r.origins, np.float64), np.asarray(r.directions, np.float64)) for r in rays
    )
    normal = np.cross(d1, d2)
    gap = np.abs(((o2 - o1) * normal).sum(-1)) / np.linalg.norm(normal, axis=-1)
    t1 = (np.cross(o2 - o1, d2) * normal).sum(-1) / (normal**2).sum(-1)
    t2 = (np.cross(o2 - o1, d1) * normal).sum(-1) / (normal**2).sum(-1)
    assert np.mean((t1 > 0.0) & (t2 > 0.0)) > 0.8  # some matches are wrong
    pixels = gap / t1 * scene.cameras.intrinsics[views[0], 0]
    assert np.median(np.abs(pixels)) < 0.5
    if name == "llff/fern":
        assert np.mean((t1 > scene.near) & (t1 < scene.far)) > 0.8
