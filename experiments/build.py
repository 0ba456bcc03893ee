"""From a config to a scene, its first views and candidates, and all that a run needs of it."""

import os
from collections.abc import Callable
from functools import cache, cached_property, partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from bavs_jax import pools
from bavs_jax.active import Acquisition, ActiveState
from bavs_jax.candidates import (
    candidate_cameras,
    captured_candidates,
    dataset_candidates,
    reachable_candidates,
    scene_hemisphere,
    with_empty_views,
)
from bavs_jax.devices import num_shards, put_on_all
from bavs_jax.fields.deformation import DeformationGrid, offset_unit
from bavs_jax.metrics.perceptual import make_lpips_fn
from bavs_jax.models.base import RadianceModel
from bavs_jax.pixel_table import make_pixel_table, num_training_pixels
from bavs_jax.policy_inputs import InputMaker, LookOptions
from bavs_jax.scenes import Scene, SceneError, load_scene
from bavs_jax.scenes.pose_files import read_pose_file
from bavs_jax.scenes.poses import transform_poses
from bavs_jax.scenes.procedural import capture, subject
from bavs_jax.scenes.zoom import Zoom
from bavs_jax.selection.distances import Radii
from bavs_jax.selection.policies import get_policy
from bavs_jax.target_inputs import GAP_TARGETS, MakeTargets
from bavs_jax.training.fit import Trainer, is_stuck, single_colour_error
from bavs_jax.training.train import TrainInfo, TrainState
from bavs_jax.uncertainty.channel import make_render_chunk_fn
from bavs_jax.uncertainty.measures import make_true_error_fn
from bavs_jax.uncertainty.model import RECONSTRUCTION, LaplaceOptions, ModelFns, SceneSetup
from bavs_jax.uncertainty.models import MODELS
from bavs_jax.uncertainty.models.laplace import laplace_variance
from bavs_jax.uncertainty.posterior import default_prior_weight
from bavs_jax.uncertainty.streaming import CurvatureOfRays, curvature_group_size
from experiments.build_model import (
    KINDS,
    RENDER_CHUNK,
    build_flow,
    build_model,
    build_trainer,
    only,
    train_aside,
)
from experiments.runtime import ConfigError
from experiments.runtime import track as show_progress

TARGET_KINDS = ("pool", "hemisphere", "file")
MAX_NEW_PIXELS = 1 << 30  # of pictures taken on the way, for which room is made at the start

# The streams of randomness of a run: one key for each purpose, all of them from its seed. The key
# of the run itself goes to `active.py`, which folds in the number of the round, 0, 1, ...; every
# other purpose folds in a number of its own from the far end, so that no two ever draw the same.
STREAMS = {
    "init": 2**31 - 1,  # the parameters before training
    "pictures": 2**31 - 2,  # uncertainty of a trained field: pictures, clean-up, exports
    "evaluation": 2**31 - 3,  # uncertainty models that are measured on the test views
    "surface": 2**31 - 4,  # points on a true surface and on a mesh
    "draws": 2**31 - 5,  # fields drawn from the posterior
    "photos": 2**31 - 6,  # curvature of all photos of a capture
    "places": 2**31 - 7,  # poses that are suggested
    "choice": 2**31 - 8,  # policies that choose among these
}


def run_key(seed: int) -> jax.Array:
    """The key from which all of a run's randomness comes."""
    return jax.random.key(seed)


def stream_key(seed: int, stream: str) -> jax.Array:
    """The key of one of `STREAMS` of a run."""
    return jax.random.fold_in(run_key(seed), STREAMS[stream])


# --- the scene and its views -----------------------------------------------------------------


def load_config_scene(config, *, cache_dir: str | None) -> Scene:
    """The scene that a config names, with the pool that it asks for.

    SceneError if its files cannot be used, or have no such pool.
    """
    pool = config.pool
    scene = _load(config, cache_dir, Zoom(pool.factor, pool.seed) if pool.kind == "zoom" else None)
    if pool.kind == "unbalanced":
        return pools.unbalanced(scene, share=pool.share, seed=pool.seed)
    if pool.kind == "arc":
        return pools.arc(scene, degrees=pool.degrees, seed=pool.seed)
    return scene


def _load(config, cache_dir: str | None, zoom: Zoom | None) -> Scene:
    if config.loader == "procedural":
        options = {"image_size": config.image_size, "cache_dir": cache_dir, "zoom": zoom}
        return load_scene("procedural", scene=config.scene, **options)
    folder, default = config.data_dir, os.environ.get("BAVS_DATA")
    if not folder and not default:
        raise SceneError(
            "config.data_dir: is empty and BAVS_DATA is not set: "
            "pass --config.data_dir=FOLDER_OF_SCENES"
        )
    root = os.path.join(folder or os.path.join(default, config.loader), config.scene)
    options = {name: value for name, value in [*config.load.items(), ("zoom", zoom)] if value}
    if options.get("pool_size", 0.0) >= 1:
        options["pool_size"] = int(options["pool_size"])
    return load_scene(config.loader, root=root, image_size=config.image_size or None, **options)


def true_surface(config) -> Callable | None:
    """Signed distance to the surface of a config's scene, where it is known: [..., 3] -> [...]."""
    return subject(config.scene).signed_distance if config.loader == "procedural" else None


def initial_views(scene: Scene, seed: int, num: int) -> np.ndarray:
    """Which views a run starts with: a function of seed and scene alone, never of the policy.

    A `num` of 0 takes all of the pool, or of the arc that a run begins in.
    """
    start, where, fix = scene.pool, "the pool has", ""
    if scene.start is not None:
        start, where, fix = scene.start, "the arc to begin in has", ", or a larger pool.degrees"
    num = num or len(start)
    if not 1 <= num <= len(start):
        raise SceneError(
            f"{scene.name}: num_initial is {num}, but {where} {len(start)} views: "
            f"give a number between 1 and that{fix}"
        )
    return np.random.default_rng(seed).permutation(np.asarray(start))[:num]


def _takes_pictures(config) -> bool:
    """Whether candidates are free poses, whose pictures are taken when they are chosen."""
    return config.candidates.source != "dataset" and config.loader == "procedural"


def check_views(config, scene: Scene) -> None:
    """Raises an error, before any training, if a scene has fewer views than the rounds ask for."""
    batch, num_rounds, options = config.batch_size, config.num_rounds, config.candidates
    left = len(scene.pool) - len(initial_views(scene, 0, config.num_initial))
    taken, draws = num_rounds * batch, options.hemisphere_draws
    rounds = f"config.batch_size: {num_rounds} rounds of {batch} take {taken}"
    if options.source != "dataset" and num_rounds and batch > draws:
        raise ConfigError(
            f"config.batch_size: is {batch}; give at most candidates.hemisphere_draws, {draws}"
        )
    if not _takes_pictures(config):
        if taken > left:
            raise ConfigError(
                f"{rounds} views, but {scene.name} has {left} in its {config.pool.kind} pool "
                "beside the initial ones; give fewer"
            )
    elif taken * int(np.diff(scene.offsets).max()) > MAX_NEW_PIXELS:
        raise ConfigError(
            f"{rounds} pictures, more than {MAX_NEW_PIXELS:,} pixels; give fewer, or a smaller "
            "image_size"
        )


def check_shards(config, mesh: Mesh | None) -> None:
    """Raises ConfigError if rays cannot be spread evenly over the devices of a mesh."""
    num_pixels, rest = divmod(config.train.num_rays, config.rays_per_pixel)
    if rest:
        raise ConfigError(
            f"config.train.num_rays: {config.train.num_rays} is no multiple of "
            f"config.rays_per_pixel, {config.rays_per_pixel}"
        )
    for name, num in (("config.train.num_rays", num_pixels), ("images", RENDER_CHUNK)):
        if num % num_shards(mesh):
            raise ConfigError(
                f"{name}: {num} pixels at once cannot be spread over {num_shards(mesh)} devices: "
                "take a number of --devices that divides them"
            )


def build_targets(config, scene: Scene) -> MakeTargets:
    """Makes the target views of a scene, with the lens and the image size of its photos.

    Poses of a file are fixed, those on the hemisphere are drawn anew in each round.

    Raises:
      SceneError: a file of poses that cannot be used.
    """
    kind = config.targets.kind
    if kind == "hemisphere":
        num = config.targets.num or GAP_TARGETS
        return lambda key: candidate_cameras(scene, scene_hemisphere(key, scene, num))
    if kind == "file":
        try:
            poses = read_pose_file(config.targets.poses_file)
        except SceneError as error:
            raise SceneError(f"config.targets.poses_file: {error}") from error
        poses = transform_poses(np.linalg.inv(scene.user_from_scene), poses)
        cameras = candidate_cameras(scene, poses)
        return lambda key: cameras
    return lambda key: None


# --- all of it together ----------------------------------------------------------------------


class Problem:
    """One scene with everything that is compiled for it; shared by all policies and seeds."""

    def __init__(
        self,
        config,
        scene: Scene,
        kind: str = RECONSTRUCTION,
        mesh: Mesh | None = None,
        track: Callable = show_progress,
    ):
        """Puts models, training, curvature and selection together; compiles nothing yet.

        Args:
          config: see `experiments/configs/base.py`; raises ConfigError where it does not fit.
          scene: the scene.
          kind: of the field that is trained and measured, one of `KINDS`.
          mesh: devices that share the rays, from `make_mesh`.
          track: how progress is shown: (total, label, unit) -> a context with `advance(n)`.
        """
        check_shards(config, mesh)
        self.config, self.scene, self.kind = config, scene, kind
        self.mesh, self.track = mesh, track
        # Where candidates come from, and the table with room for pictures taken on the way.
        options, table = config.candidates, make_pixel_table(scene)
        draws = options.hemisphere_draws if options.source != "dataset" else None
        if _takes_pictures(config):
            self.source = captured_candidates(
                scene,
                lambda cameras: capture(cameras, config.scene)[:2],
                num_candidates=draws,
                first_slot=len(table.cameras),
                draw_poses=subject(config.scene).draw_poses if options.source == "free" else None,
            )
            table = with_empty_views(table, config.num_rounds * config.batch_size)
        else:
            self.source = dataset_candidates(scene, hemisphere_draws=draws)
        self.table = put_on_all(table, mesh)
        self.make_targets = build_targets(config, scene)
        # The distribution over fields whose mean is the field of kind FLOW.
        self.flow = flow = build_flow(config, scene)
        num_views = len(table.cameras)
        self.models = {k: build_model(config, scene, num_views, k, flow, mesh) for k in KINDS}
        self.trainers = {k: build_trainer(config, model) for k, model in self.models.items()}
        uncertainty = config.uncertainty
        self.grid = DeformationGrid(
            jnp.asarray(scene.box), uncertainty.log2_cells, contracted=scene.unbounded
        )
        prior_weight = uncertainty.prior_weight
        if prior_weight is None:
            prior_weight = default_prior_weight(uncertainty.log2_cells)
        self.laplace = LaplaceOptions(
            prior_weight=prior_weight / float(offset_unit(scene.box)) ** 2,
            max_rays=uncertainty.max_rays or None,
            **only(uncertainty, "weighting", "offset_cells", "variant", "scale", "extent"),
        )
        self._density = jax.jit(self.model.density)
        self.lpips_fn, self.lpips_reason = None, "switched off: config.lpips_net is empty"
        if config.lpips_net:
            self.lpips_fn, self.lpips_reason = make_lpips_fn(config.lpips_net)
        self.model_fns: Callable[[str], ModelFns] = cache(lambda n: MODELS[n].make_fns(self.setup))

    @property
    def model(self) -> RadianceModel:
        return self.models[self.kind]

    @property
    def trainer(self) -> Trainer:
        return self.trainers[self.kind]

    @property
    def has_empty_views(self) -> bool:
        """Whether the table has room for pictures taken on the way."""
        return len(self.table.cameras) > self.scene.num_views

    def restart(self, key, state: TrainState) -> TrainState:
        """Where a later round begins: a fresh optimiser, and a fresh field if so asked."""
        fresh = self.trainer.init(key)
        if self.config.from_scratch:
            return fresh
        params = jax.tree.map(jnp.copy, state.model.params)  # training donates both of them
        return fresh.replace(model=state.model, last_params=params)

    def is_stuck(self, info: TrainInfo, state: ActiveState) -> bool:
        """Whether a field at the end of its round has learnt nothing."""
        if self.trainer.check_call is None:
            return False  # too short a round to have learnt anything
        return is_stuck(info, single_colour_error(state.table, state.is_training_view))

    def render(self, train: TrainState, jac_sq_sum=None, num_rays: int = 0) -> Callable:
        """Makes `Rays` [chunk] -> images, with the uncertainty channel where curvature is given."""
        variance = None
        if jac_sq_sum is not None:
            variance = laplace_variance(jac_sq_sum, num_rays, self.laplace)
        return partial(self.setup.render_chunk, train.model, variance)

    def density(self, train: TrainState, positions) -> jax.Array:
        """At points [K, 3]: [K] 1 / scene unit, 0 where nothing is rendered."""
        return self._density(train.model, positions)

    @cached_property
    def setup(self) -> SceneSetup:
        """What uncertainty models may use."""
        config = self.config

        def train(kind, key, acquired):
            return train_aside(config, self.trainers[kind], key, acquired, kind, self.track)

        channel = only(config.uncertainty, "variant", "scale", "extent")
        group_size = curvature_group_size(self.grid.num_vertices, len(self.table.cameras))
        return SceneSetup(
            models=self.models,
            flow=self.flow,
            kind=self.kind,
            grid=self.grid,
            laplace=self.laplace,
            curvature=CurvatureOfRays(
                self.model, self.grid, group_size=group_size, track=self.track, mesh=self.mesh
            ),
            render_chunk=make_render_chunk_fn(self.model, self.grid, mesh=self.mesh, **channel),
            train=train,
            image_scale=config.candidates.image_scale,
            chunk=RENDER_CHUNK,
            ensemble_size=config.uncertainty.ensemble_size,
            num_draws=config.uncertainty.flow_draws,
            mesh=self.mesh,
        )

    @cached_property
    def inputs(self) -> InputMaker:
        """Where the numbers of policies come from."""
        look = LookOptions(
            image_scale=self.config.candidates.image_scale,
            chunk=RENDER_CHUNK,
            num_targets=self.config.targets.num,
        )
        true_error_fn = None
        if not self.has_empty_views:
            true_error_fn = make_true_error_fn(
                self.render, self.scene, image_scale=look.image_scale, chunk=look.chunk
            )
        return InputMaker(
            self.setup,
            self.model_fns,
            look,
            track=self.track,
            true_error_fn=true_error_fn,
            make_targets=self.make_targets,
        )

    def acquisition(
        self, policy_name: str, initial, label: str, current: int | None = None
    ) -> Acquisition:
        """How a policy of the config chooses, in a run that began with the views `initial`.

        `current` is the row of the view taken last; None: the last of the initial ones.
        """
        options, pool, source = self.config.candidates, self.config.pool, self.source
        if pool.kind == "reachable":
            current = int(initial[-1]) if current is None else current
            source = reachable_candidates(source, current, pool.num_nearest)
        radii = (options.min_train_distance, options.min_candidate_distance)
        return Acquisition(
            get_policy(policy_name),
            source,
            self.inputs,
            centre=self.scene.centre,
            batch_size=self.config.batch_size,
            num_rays=int(num_training_pixels(self.scene, np.asarray(initial)).sum()),
            radii=None if None in radii else Radii(*radii),
            survivor_share=options.survivors,
            mode=options.mode,
            label=label,
        )
