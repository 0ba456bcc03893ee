"""Pictures of photos of different sizes: written in one file, shown each at its own size."""

from __future__ import annotations

import imageio.v3 as iio
import numpy as np
import pytest

from bavs_jax.scenes import load_nerfstudio
from experiments.evaluate import image_arrays, picture_arrays
from experiments.files import cut_pictures, stack_pictures, write_arrays
from experiments.reporting import pictures
from experiments.reporting.results import load_pictures, load_runs
from experiments.reporting.uncertainty import view_plots
from tests.report_files import make_result, write_workdir
from tests.scene_files import random_image, write_nerfstudio

VIEWS = [2, 3, 4]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """The photo of view 3 is half as large as the others."""
    root = write_nerfstudio(tmp_path_factory.mktemp("mixed") / "scene")
    iio.imwrite(root / "images/003.png", random_image(3, 6, 4, 3))
    return load_nerfstudio(root)


def render(rays):
    """Something that differs from ray to ray."""
    values = np.abs(np.asarray(rays.directions))
    return {"rgb": values, "uncertainty": values[:, 0], "depth": values[:, 1]}


def test_a_report_shows_each_view_at_its_own_size(scene, tmp_path):
    arrays = picture_arrays(render, scene, VIEWS)
    workdir = write_workdir(tmp_path, [make_result()], arrays=False)
    run = load_runs(workdir)[0]
    write_arrays(run.folder / "pictures.npz", **arrays, round=4)
    found = load_pictures(run)
    for i, view in enumerate(VIEWS):
        np.testing.assert_array_equal(found["truth"][i], scene.image(view))
        shape = scene.image(view).shape
        assert found["rgb"][i].shape == shape
        for name in ("error", "uncertainty", "depth"):
            assert found[name][i].shape == shape[:2]
            assert (found[name][i] > 0.0).any()
    figure = pictures.views_figure({"bavs": found}, 3, errors=True)
    titles = [axes.get_title("center") for axes in figure.axes if axes.images]
    words = pictures.psnr_words(found["rgb"][1], scene.image(3))
    assert f"bavs, {words}" in titles
    shapes = [axes.images[0].get_array().shape[:2] for axes in figure.axes if axes.images]
    # A row has a truth, a render, an error and an uncertainty.
    assert shapes == [scene.image(view).shape[:2] for view in VIEWS for _ in range(4)]


def test_the_page_of_uncertainties_shows_each_view_at_its_own_size(scene):
    shapes = [scene.image(view).shape for view in VIEWS]
    rng = np.random.default_rng(0)
    images = [
        {"rgb": rng.random(s), "uncertainty": rng.random(s[:2]), "depth": rng.random(s[:2])}
        for s in shapes
    ]
    halves = [image["depth"] for image in images]
    arrays = image_arrays(scene, VIEWS, images) | {"half": stack_pictures(halves)}
    assert arrays["sizes"].tolist() == [[12, 8], [6, 4], [12, 8]]
    assert arrays["truth"].shape == (3, 8, 12, 3)
    cut = cut_pictures(arrays)
    assert [image.shape for image in cut["rgb"]] == shapes
    assert [image.shape for image in cut["half"]] == [shape[:2] for shape in shapes]
    assert len(view_plots({"model": cut})) == 3


def test_pictures_of_one_size_stay_arrays(scene):
    arrays = picture_arrays(render, scene, [2, 4])
    np.testing.assert_array_equal(arrays["truth"], [scene.image(2), scene.image(4)])
