"""The stages of a run on a trained field: how fast each is, and what two devices make of them."""

import dataclasses
import itertools
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from ml_collections import ConfigDict

from bavs_jax import active
from bavs_jax.cameras import Cameras, reduced_cameras, take, view_pixels
from bavs_jax.candidates import scene_hemisphere
from bavs_jax.pixel_table import training_pixels, view_mask
from bavs_jax.rendering.images import render_pixels
from bavs_jax.scenes import Scene
from bavs_jax.selection.batch import acquire
from bavs_jax.selection.context import make_context
from bavs_jax.selection.policies import get_policy
from bavs_jax.uncertainty.channel import mean_uncertainty
from bavs_jax.uncertainty.model import FLOW, RECONSTRUCTION, VARIANCE, Acquired
from bavs_jax.uncertainty.streaming import table_rays
from experiments.build import Problem, initial_views, load_config_scene, run_key, stream_key
from experiments.build_model import RENDER_CHUNK, train_aside
from experiments.configs import base
from experiments.runtime import peak_device_memory_mb, peak_memory_mb, scene_cache, track
from experiments.schema import MAX_WIDTH, check_options, whole

SEED = 0

# --- how much is measured --------------------------------------------------------------------


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
    return sizes


def check_sizes(sizes: ConfigDict) -> None:
    """Raises ConfigError for a size that cannot be used."""
    limits = {"candidate_pixels": MAX_WIDTH, "matmul": 1 << 16, "copy_mb": 1 << 16}
    limits |= {"repeats": 1000, "train_calls": 1000}
    schema = {name: whole(1, limits.get(name, 1 << 24)) for name in default_sizes()}
    check_options(sizes, schema, "sizes")


# --- one run of each stage -------------------------------------------------------------------


class Subject:
    """What is measured: a scene, a field, and what a run of `active_selection` does with them.

    `training`, `rendering`, `curvature`, `scoring` and `selection` make a function that does one
    piece of such work and returns the result; it compiles when it is first called.
    """

    def __init__(self, config, scene: Scene, num_views: int, kind: str = RECONSTRUCTION):
        self.config, self.scene = config, scene
        self.problem = Problem(config, scene, kind)
        self.initial = initial_views(scene, SEED, num_views)
        self.is_training = view_mask(self.problem.table, self.initial)
        self.state = self.problem.trainer.init(stream_key(SEED, "init"))
        self.jac_sq_sum, self.num_rays = None, 0  # of `curvature`, for `scoring`

    def train(self) -> None:
        """Trains the field as one round does."""
        problem, key = self.problem, run_key(SEED)
        acquired = Acquired(None, problem.table, self.is_training, 0, label=self.scene.name)
        self.state = train_aside(self.config, problem.trainer, key, acquired, problem.kind, track)

    def draw_cameras(self, num: int, width: int) -> Cameras:
        """Cameras on the hemisphere (Eq 14) with images `width` pixels wide, as photos are."""
        first = take(self.scene.cameras, np.full(num, self.scene.pool[0]))
        poses = scene_hemisphere(stream_key(SEED, "places"), self.scene, num)
        scale = width / float(first.sizes[0, 0])
        return reduced_cameras(first.replace(world_from_cam=poses), scale)

    def training(self, num_calls: int) -> Callable[[], np.ndarray]:
        """Trains on from a copy; the result is (rays that fitted the buffer, samples)."""
        # A training call is given its state for good, and others still need this one.
        state, numbers = jax.tree.map(jnp.copy, self.state), itertools.count()
        steps, key = self.config.train.steps_per_call, jax.random.fold_in(run_key(SEED), 1)
        call, views = self.problem.trainer.call, (self.problem.table, self.is_training)

        def run():
            nonlocal state
            infos = []
            for number in itertools.islice(numbers, num_calls):
                state, info = call(jax.random.fold_in(key, number), state, *views)
                infos.append(info)
            jax.block_until_ready(state)
            return steps * np.sum([[float(i.rays), float(i.samples)] for i in infos], axis=0)

        return run

    def rendering(self, num_rays: int) -> Callable[[], Any]:
        """Renders training pixels, drawn uniformly: colour and depth."""
        cameras, chunk_fn = self.problem.table.cameras, self.problem.render(self.state)
        view_ids, pixels = view_pixels(cameras, np.flatnonzero(self.is_training))
        rows = np.random.default_rng(SEED).integers(0, len(view_ids), num_rays)
        pixels, view_ids = pixels[rows], view_ids[rows]
        return lambda: render_pixels(chunk_fn, cameras, view_ids, pixels, chunk=RENDER_CHUNK)

    def curvature(self, num_rays: int) -> Callable[[], jax.Array]:
        """The summed squared Jacobian of training pixels, drawn uniformly (Eq 13)."""
        setup, table = self.problem.setup, self.problem.table
        view_ids, pixel_ids = training_pixels(table, self.is_training)
        rows = np.random.default_rng(SEED).integers(0, len(view_ids), num_rays)
        weighting = setup.laplace.weighting
        rays = table_rays(table, view_ids[rows], pixel_ids[rows], weighting)
        return lambda: setup.curvature(self.state.model, label=None, weighting=weighting, **rays)

    def scoring(self, num_candidates: int, width: int) -> Callable[[], Any]:
        """Scores candidates (Eq 15): every one, as no distance filter has gone before."""
        cameras = self.draw_cameras(num_candidates, width)
        chunk_fn = self.problem.render(self.state, self.jac_sq_sum, self.num_rays)
        return lambda: mean_uncertainty(chunk_fn, cameras, chunk=RENDER_CHUNK)

    def selection(self, num_candidates: int, batch_size: int) -> Callable[[], tuple]:
        """`bavs` with scores that cost nothing: the max-min distance filter (Fig 5), and top-k."""
        scores = np.random.default_rng(SEED).uniform(size=num_candidates).astype(np.float32)
        ctx = make_context(
            self.draw_cameras(num_candidates, 1).positions,
            training_positions=self.problem.table.cameras.positions,
            is_training_view=self.is_training,
            centre=self.scene.centre,
            mean_uncertainty_fn=lambda indices, picked: scores[indices],
        )
        policy, key = get_policy("bavs"), run_key(SEED)
        return lambda: acquire(policy, key, ctx, batch_size)


# --- the clock -------------------------------------------------------------------------------


def timed(run: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of one call until all that it returns is there, and what that is."""
    start = time.perf_counter()
    value = jax.block_until_ready(run())
    return time.perf_counter() - start, value


def timed_runs(run: Callable[[], Any], repeats: int) -> tuple[float, list[float], list[Any]]:
    """Seconds of a first call, which compiles; those of some more, and what these return."""
    first, _ = timed(run)
    seconds, values = zip(*(timed(run) for _ in range(repeats)))
    return first, list(seconds), list(values)


def measure_stages(subject: Subject, sizes) -> tuple[dict[str, dict], float, dict[str, Callable]]:
    """Trains the field to its end, so that its sampler skips what is empty, then times each stage.

    Returns:
      numbers of each stage, by name; the median of training samples per second; a run of each.
    """
    run = subject.training(1)
    compile_s = timed(run)[0] - timed(run)[0]
    subject.train()
    stages, runs = {}, {}

    def measure(name: str, unit: str, run: Callable, amount: float | None = None) -> list:
        """Notes a stage; its amount of units in a run, if not given, is the first of its values."""
        first, seconds, values = timed_runs(run, sizes.repeats)
        amounts = np.array([value[0] for value in values] if amount is None else [amount])
        runs[name] = run
        stages[name] = {
            "unit": unit,
            f"{unit}_per_run": float(np.median(amounts)),
            f"{unit}_per_s": float(np.median(amounts / seconds)),
            "run_s": seconds,
            "median_run_s": float(np.median(seconds)),
            "compile_s": first - float(np.median(seconds)),
            "peak_memory_so_far_mb": peak_memory_mb(),
            "peak_device_memory_so_far_mb": peak_device_memory_mb(),
        }
        bar.advance(1)
        return values

    with track(5, "measure", "stages") as bar:
        values = measure("train", "rays", subject.training(sizes.train_calls))
        stages["train"]["compile_s"] = compile_s  # its programs had been compiled before
        samples = np.array([num for _, num in values]) / stages["train"]["run_s"]
        measure("render", "rays", subject.rendering(sizes.render_rays), sizes.render_rays)
        num_rays = sizes.curvature_rays
        values = measure("curvature", "rays", subject.curvature(num_rays), num_rays)
        subject.jac_sq_sum, subject.num_rays = values[-1], num_rays
        run = subject.scoring(sizes.candidates, sizes.candidate_pixels)
        measure("score", "candidates", run, sizes.candidates)
        run = subject.selection(sizes.select_candidates, sizes.batch_size)
        measure("select", "batches", run, 1)
    return stages, float(np.median(samples)), runs


def measure_ceilings(sizes) -> dict[str, float]:
    """What the plainest programs reach; the best of several runs.

    A product of square float32 matrices of side n, at JAX's default precision, is `2 n^3`
    operations. An array is read once and written once; one is added on the way, which costs nothing
    beside the traffic: XLA would hand over the same array for a plain copy.
    """
    square = jnp.ones((sizes.matmul, sizes.matmul), jnp.float32)
    array = jnp.ones(sizes.copy_mb * 10**6 // 4, jnp.float32)
    product, copied = jax.jit(jnp.matmul), jax.jit(lambda x: x + 1.0)
    runs = (lambda: product(square, square), lambda: copied(array))
    product_s, copy_s = (min(timed_runs(run, sizes.repeats)[1]) for run in runs)
    return {
        "matmul_flops_per_s": 2.0 * sizes.matmul**3 / product_s,
        "copy_bytes_per_s": 2.0 * array.nbytes / copy_s,
    }


# --- the same numbers on two devices ----------------------------------------------------------

# Fields of each kind: options of the config, whether the scene has no bounds, and what is trained.
FIELDS = {
    "hash_grid": ({}, False, RECONSTRUCTION),
    "proposals": ({"sampler_kind": "proposal"}, False, RECONSTRUCTION),
    "unbounded": ({"hash_grid.appearance_features": 2}, True, RECONSTRUCTION),
    "nerf_mlp": ({"field_kind": "nerf_mlp"}, False, RECONSTRUCTION),
    "mip_mlp": ({"field_kind": "mip_mlp"}, False, RECONSTRUCTION),
    "learned_variance": ({}, False, VARIANCE),
    "flow": ({}, False, FLOW),
}
SMALL = {
    **{"image_size": 16, "lpips_net": "", "num_initial": 6, "batch_size": 4},
    **{"train.num_rays": 128, "train.capacity": 4096, "train.num_steps": 96},
    **{"hash_grid.num_levels": 4, "uncertainty.log2_cells": 4, "flow_training.num_draws": 4},
    **{"march.num_steps": 48, "march.num_slots": 16, "march.occupancy_resolution": 16},
    **{"nerf_mlp.depth": 2, "nerf_mlp.skip": 1, "mip_mlp.depth": 2, "mip_mlp.skip": 1},
    "train.steps_per_call": 1,
}
NUM_RAYS, NUM_CANDIDATES, WIDTH = 1024, 16, 8  # that are rendered and scored
POLICIES = ("bavs", "bavs_spread")


def numbers_on(
    device, config, scene: Scene, kind: str, policies: tuple[str, ...], trained=None
) -> tuple[dict, dict]:
    """What a device makes of a state.

    Args:
      device: one of JAX's.
      config, scene, kind: see `Problem`.
      policies: that choose a batch.
      trained: the state in numpy's arrays; None: trained here.

    Returns:
      the state, and by name arrays to compare; those named `views, ...` hold whole numbers.
    """
    with jax.default_device(device):
        subject = Subject(config, scene, config.num_initial, kind)
        problem, table = subject.problem, subject.problem.table
        if trained is None:
            subject.train()
            trained = jax.tree.map(np.asarray, subject.state)
        subject.state = state = jax.device_put(trained, device)
        subject.jac_sq_sum, subject.num_rays = subject.curvature(NUM_RAYS)(), NUM_RAYS
        images, scores = subject.rendering(NUM_RAYS)(), subject.scoring(NUM_CANDIDATES, WIDTH)()
        found = {"colours": images["rgb"], "depths": images["depth"], "scores": scores}
        found["curvature"] = subject.jac_sq_sum
        key, init_key = run_key(SEED), stream_key(SEED, "init")
        whole = active.init(state, table, subject.initial)
        for name in policies:
            acquisition = problem.acquisition(name, subject.initial, "check")
            choice = active.select(active.round_keys(key, 1)[0], whole, acquisition)
            found[f"views, {name}"] = choice.candidates.view_ids[choice.selected]
        # Adam's first mean is a share of the gradient. Last, since the state is given away.
        state = state.replace(opt_state=problem.trainer.init(init_key).opt_state)
        state, info = problem.trainer.call(key, state, table, subject.is_training)
        moments = jax.tree.leaves(optax.tree_utils.tree_get(state.opt_state, "mu"))
        found["loss"] = info.loss
        found["gradient"] = np.concatenate([np.ravel(moment) for moment in moments])
        return trained, {name: np.asarray(value) for name, value in found.items()}


def difference(value: np.ndarray, wanted: np.ndarray) -> float:
    """`|value - wanted| / |wanted|`, Euclidean; for whole numbers the share that differs."""
    if np.issubdtype(wanted.dtype, np.integer):
        return float(np.mean(value != wanted))
    value, wanted = value.astype(np.float64), wanted.astype(np.float64)
    return float(np.linalg.norm(value - wanted) / np.linalg.norm(wanted))


def check_field(name: str, device, reference) -> dict[str, float]:
    """Differences between two devices, by what is compared; `name` is one of `FIELDS`."""
    options, unbounded, kind = FIELDS[name]
    config = base.get_config()
    config.update_from_flattened_dict({**SMALL, **options})
    scene = load_config_scene(config, cache_dir=scene_cache())
    scene = dataclasses.replace(scene, unbounded=unbounded)
    policies = () if options or kind != RECONSTRUCTION else POLICIES
    trained, wanted = numbers_on(reference, config, scene, kind, policies)
    _, numbers = numbers_on(device, config, scene, kind, policies, trained)
    return {key: difference(numbers[key], wanted[key]) for key in wanted}


def too_large(differences: dict[str, dict[str, float]], tolerance: float) -> list[str]:
    """`field: what` of all that is above the tolerance; of views, none may differ."""
    return [
        f"{name}: {what}"
        for name, row in differences.items()
        for what, value in row.items()
        if not value <= (0.0 if what.startswith("views") else tolerance)
    ]
