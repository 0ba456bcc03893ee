"""Scenes as configs name them: every layout, every option of how files are read."""

import numpy as np
import pytest

from bavs_jax.scenes import SceneError
from experiments.build import load_config_scene
from experiments.configs import base
from tests.scene_layouts import LAYOUTS


def load(tmp_path, layout, pool=None, **options):
    layout.write(tmp_path / "scene")
    config = base.get_config()
    config.loader, config.data_dir, config.scene = layout.kind, str(tmp_path), "scene"
    config.image_size = 8
    config.load.update(options)
    config.pool.update(pool or {})
    return load_config_scene(config, cache_dir=None)


@pytest.mark.parametrize("name", LAYOUTS)
def test_every_layout_loads_with_the_default_options(tmp_path, name):
    if LAYOUTS[name].kind == "colmap":
        pytest.importorskip("pycolmap")
    scene = load(tmp_path, LAYOUTS[name])
    assert len(scene.pool) and len(scene.test)
    assert int(np.asarray(scene.cameras.sizes).max()) == 8


def test_the_split_follows_the_config(tmp_path):
    nerfstudio = LAYOUTS["nerfstudio"]
    assert len(load(tmp_path / "a", nerfstudio, pool_size=4.0).pool) == 4
    num_views = load(tmp_path / "b", nerfstudio, test_every=3).num_views
    share = load(tmp_path / "c", nerfstudio, pool_size=0.5)
    assert len(share.pool) == round(0.5 * num_views)
    other = load(tmp_path / "d", nerfstudio, pool_size=0.5, seed=1)
    assert set(other.pool) != set(share.pool)


def test_an_option_that_a_loader_does_not_have_is_an_error(tmp_path):
    with pytest.raises(SceneError, match="'blender': option test_every is unknown"):
        load(tmp_path, LAYOUTS["blender"], test_every=3)


def test_the_pool_follows_the_config(tmp_path):
    nerfstudio = LAYOUTS["nerfstudio"]  # a ring of cameras
    even = load(tmp_path / "a", nerfstudio)
    assert even.start is None
    arc = load(tmp_path / "b", nerfstudio, {"kind": "arc", "degrees": 100.0})
    assert 0 < len(arc.start) < len(arc.pool) == len(even.pool)
    zoom = load(tmp_path / "c", nerfstudio, {"kind": "zoom", "factor": 1.4})
    ratios = zoom.cameras.intrinsics[:, 0] / even.cameras.intrinsics[:, 0]
    assert 1.0 <= ratios.min() < 1.2 < ratios.max() < 1.6
    other = load(tmp_path / "d", nerfstudio, {"kind": "zoom", "factor": 1.4, "seed": 1})
    assert (other.cameras.intrinsics != zoom.cameras.intrinsics).any()
    with pytest.raises(SceneError, match=r"pool\.kind: 'unbalanced' needs a pool of several"):
        load(tmp_path / "e", nerfstudio, {"kind": "unbalanced"})
