"""What is measured: one scene, its compiled parts, the views trained on, and how much of all."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from ml_collections import ConfigDict

from bavs_jax.cameras import Cameras, reduced_cameras, take
from bavs_jax.candidates import scene_hemisphere
from bavs_jax.pixel_table import training_pixels, view_mask
from bavs_jax.scenes import Scene
from bavs_jax.training.train import TrainState
from bavs_jax.uncertainty.model import RECONSTRUCTION, Acquired
from experiments.build import Problem, initial_views, run_key, stream_key
from experiments.build_model import train_aside
from experiments.runtime import track
from experiments.schema import MAX_LOG2_CELLS, MAX_WIDTH, check_options, leaves, several, whole


def default_sizes() -> ConfigDict:
    """Sizes for a few minutes on two cores; tests and big machines take others."""
    sizes = ConfigDict()
    sizes.repeats = 5  # runs of each stage, of which the median counts
    sizes.train_calls = 4  # compiled training calls of one run
    sizes.render_rays = 65536
    sizes.curvature_rays = 32768
    sizes.candidates = 100  # that are scored
    sizes.candidate_pixels = 50  # image width of a candidate
    sizes.select_candidates = 1000  # that a batch is selected from
    sizes.batch_size = 16
    sizes.matmul = 4096  # side of the square matrices of the ceiling
    sizes.copy_mb = 256  # 10^6 bytes of the array of the other ceiling

    sizes.growth = ConfigDict()
    sizes.growth.repeats = 3
    sizes.growth.train_calls = 2
    sizes.growth.train_rays = (512, 1024, 2048, 4096)  # of one step
    sizes.growth.render_rays = (4096, 16384, 65536, 131072)
    sizes.growth.curvature_rays = (4096, 16384, 32768, 65536)
    sizes.growth.grid_log2 = (5, 6, 7, 8)  # L: grids of 2^L cells per side
    sizes.growth.grid_rays = 16384  # whose curvature each grid gets
    sizes.growth.candidates = (25, 100, 250, 1000)
    sizes.growth.candidate_pixels = 25
    sizes.growth.batch_size = (1, 4, 16, 64)
    return sizes


def check_sizes(sizes: ConfigDict) -> None:
    """Raises ConfigError for a size that cannot be used."""
    limits = {"candidate_pixels": MAX_WIDTH, "grid_log2": MAX_LOG2_CELLS, "matmul": 1 << 16}
    limits |= {"copy_mb": 1 << 16, "repeats": 1000, "train_calls": 1000}
    schema = {}
    for name, value in leaves(default_sizes()).items():
        one = whole(1, limits.get(name.rpartition(".")[2], 1 << 24))
        schema[name] = several(one, 1, 16) if isinstance(value, tuple) else one
    check_options(sizes, schema, "sizes")


SEED = 0


class Subject(NamedTuple):
    """The parts of a run of `experiments.active_selection` with the same config."""

    config: object
    problem: Problem
    is_training_view: np.ndarray  # [V] bool

    @property
    def scene(self) -> Scene:
        return self.problem.scene


def changed(config, **values):
    """A copy of a config with other values; `__` in a name stands for a dot."""
    copy = config.copy_and_resolve_references()
    copy.update_from_flattened_dict({k.replace("__", "."): v for k, v in values.items()})
    return copy


def make_subject(config, scene: Scene, num_views: int) -> Subject:
    """Puts the parts together; compiles nothing yet.

    Args:
      config: see `experiments/configs/base.py`.
      scene: the scene.
      num_views: training views, drawn as those that a run begins with.
    """
    problem = Problem(changed(config, lpips_net=""), scene)
    is_training = view_mask(problem.table, initial_views(scene, SEED, num_views))
    return Subject(config, problem, is_training)


def train_field(subject: Subject) -> TrainState:
    """The field at the end of its training."""
    acquired = Acquired(
        None, subject.problem.table, subject.is_training_view, 0, label=subject.scene.name
    )
    key = run_key(SEED)
    return train_aside(
        subject.config, subject.problem.trainer, key, acquired, RECONSTRUCTION, track
    )


def draw_training_pixels(subject: Subject, num: int) -> tuple[np.ndarray, np.ndarray]:
    """View ids and row numbers [num] of pixels, uniform over those that are trained on."""
    view_ids, pixel_ids = training_pixels(subject.problem.table, subject.is_training_view)
    rows = np.random.default_rng(SEED).integers(0, len(view_ids), num)
    return view_ids[rows], pixel_ids[rows]


def pixel_centres(cameras: Cameras, view_ids: np.ndarray, pixel_ids: np.ndarray) -> np.ndarray:
    """Pixel coordinates [num, 2] of row numbers."""
    width = np.asarray(cameras.sizes)[view_ids, 0]
    return np.stack([pixel_ids % width, pixel_ids // width], axis=-1).astype(np.float32) + 0.5


def draw_candidates(subject: Subject, num: int, width: int) -> Cameras:
    """Cameras on the hemisphere (Eq 14) with images `width` pixels wide, shaped like the photos."""
    scene = subject.scene
    first = take(scene.cameras, np.full(num, scene.pool[0]))
    poses = scene_hemisphere(stream_key(SEED, "places"), scene, num)
    scale = width / float(first.sizes[0, 0])
    return reduced_cameras(first.replace(world_from_cam=poses), scale)
