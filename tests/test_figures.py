"""Figures of an experiment as files."""

import numpy as np
import pytest
from PIL import Image

from experiments.reporting.pictures import first_pictures, views_figure, write_figures
from experiments.reporting.results import load_runs
from experiments.runtime import ReportError
from tests.report_files import make_pictures, make_result, write_workdir


@pytest.fixture
def workdir(tmp_path):
    return write_workdir(tmp_path, [make_result(p, s) for p in ("random", "bavs") for s in (0, 1)])


@pytest.mark.parametrize("form, start", [("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml")])
def test_each_measure_and_the_views_have_a_file_of_the_format(workdir, form, start):
    files = write_figures(workdir, form=form, policies=["bavs", "random"], num_views=2)
    # No run has LPIPS, so there is no figure of it.
    assert [path.name for path in files] == [
        f"{n}.{form}" for n in ("psnr", "ssim", "depth_mae", "views")
    ]
    assert all(path.read_bytes().startswith(start) for path in files)


def test_views_grow_with_views_and_policies(workdir):
    def size(policies, num_views):
        *_, path = write_figures(workdir, policies=policies, num_views=num_views)
        with Image.open(path) as image:
            assert np.asarray(image).std() > 0
            return image.size

    width, height = size(["bavs"], 1)
    assert size(["bavs"], 3)[1] > 2 * height
    assert size(["bavs", "random"], 1)[0] > 1.4 * width


def test_views_are_those_that_all_policies_show():
    bavs, random = make_pictures(0), make_pictures(1)
    random = {name: np.asarray(v)[2:4] if np.ndim(v) else v for name, v in random.items()}
    figure = views_figure({"bavs": bavs, "random": random}, 4)
    images = [axes for axes in figure.axes if axes.images and axes.get_ylabel()]
    assert [axes.get_ylabel() for axes in images] == ["r_2", "r_3"]
    shown = images[0].images[0].get_array()
    np.testing.assert_array_equal(shown, bavs["truth"][2] / 255.0)
    other = random | {"view_ids": np.array([0, 1])}
    with pytest.raises(ReportError, match="no test view in common"):
        views_figure({"bavs": bavs, "random": other}, 4)


def test_each_policy_shows_the_first_run_that_has_pictures(workdir):
    runs = load_runs(workdir)
    missing = next(r for r in runs if (r.policy, r.seed) == ("bavs", 0))
    (missing.folder / "pictures.npz").unlink()
    found = {policy: run.seed for policy, (run, _) in first_pictures(runs).items()}
    assert found == {"random": 0, "bavs": 1}


def test_a_policy_without_a_run_is_named(workdir):
    with pytest.raises(ReportError, match="no run of warp; there are random, bavs"):
        write_figures(workdir, policies=["warp"], num_views=1)
