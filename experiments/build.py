"""From a config to the parts of a run. With `build_*` beside it, the only reader of configs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cached_property, partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from ml_collections import ConfigDict

from bavs_jax.active import Acquisition, ActiveState
from bavs_jax.candidates import CandidateSource
from bavs_jax.devices import num_shards, put_on_all
from bavs_jax.fields.deformation import DeformationGrid, offset_unit
from bavs_jax.fields.flow_field import FlowField
from bavs_jax.metrics.perceptual import make_lpips_fn
from bavs_jax.models.base import RadianceModel
from bavs_jax.pixel_table import PixelTable, make_pixel_table, num_training_pixels
from bavs_jax.policy_inputs import InputMaker, LookOptions
from bavs_jax.scenes import Scene
from bavs_jax.selection.distances import Radii
from bavs_jax.selection.policies import get_policy
from bavs_jax.training.fit import Trainer, is_stuck, single_colour_error
from bavs_jax.training.train import TrainInfo, TrainState
from bavs_jax.uncertainty.channel import make_render_chunk_fn
from bavs_jax.uncertainty.measures import make_true_error_fn
from bavs_jax.uncertainty.model import RECONSTRUCTION, LaplaceOptions, ModelFns, SceneSetup
from bavs_jax.uncertainty.models import MODELS
from bavs_jax.uncertainty.models.laplace import laplace_variance
from bavs_jax.uncertainty.posterior import default_prior_weight
from bavs_jax.uncertainty.streaming import CurvatureOfRays, curvature_group_size
from experiments.build_field import build_flow
from experiments.build_scene import make_source
from experiments.build_trainer import KINDS, RENDER_CHUNK, build_model, build_trainer, train_aside
from experiments.errors import ConfigError
from experiments.progress import track as show_progress


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """One scene with everything that is compiled for it; shared by all policies and seeds."""

    config: ConfigDict
    scene: Scene
    kind: str  # of the field that is trained and measured, one of `KINDS`
    source: CandidateSource
    table: PixelTable
    models: dict[str, RadianceModel]  # by kind
    flow: FlowField  # the distribution whose mean is the field of kind FLOW
    trainers: dict[str, Trainer]  # by kind
    grid: DeformationGrid
    laplace: LaplaceOptions
    lpips_fn: Callable | None
    lpips_reason: str | None  # why there is none
    track: Callable  # (total, label, unit) -> a context with `advance(n)`, for progress
    mesh: Mesh | None  # devices that share the rays

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

    # --- the field ---

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
        return self._density_fn(train.model, positions)

    @cached_property
    def _density_fn(self) -> Callable:
        return jax.jit(self.model.density)

    # --- uncertainty and choice ---

    @cached_property
    def setup(self) -> SceneSetup:
        """What uncertainty models may use."""
        config = self.config

        def train(kind, key, acquired):
            return train_aside(config, self.trainers[kind], key, acquired, kind, self.track)

        return SceneSetup(
            models=self.models,
            flow=self.flow,
            kind=self.kind,
            grid=self.grid,
            laplace=self.laplace,
            curvature=CurvatureOfRays(
                self.model,
                self.grid,
                group_size=curvature_group_size(self.grid.num_vertices, len(self.table.cameras)),
                track=self.track,
                mesh=self.mesh,
            ),
            render_chunk=make_render_chunk_fn(
                self.model,
                self.grid,
                variant=self.laplace.variant,
                scale=self.laplace.scale,
                extent=self.laplace.extent,
                mesh=self.mesh,
            ),
            train=train,
            image_scale=config.candidates.image_scale,
            chunk=RENDER_CHUNK,
            ensemble_size=config.uncertainty.ensemble_size,
            num_draws=config.uncertainty.flow_draws,
            mesh=self.mesh,
        )

    @cached_property
    def _made_models(self) -> dict[str, ModelFns]:
        return {}

    def model_fns(self, name: str) -> ModelFns:
        """An uncertainty model of this scene, made when first asked for."""
        if name not in self._made_models:
            self._made_models[name] = MODELS[name].make_fns(self.setup)
        return self._made_models[name]

    @cached_property
    def inputs(self) -> InputMaker:
        """Where the numbers of policies come from."""
        image_scale = self.config.candidates.image_scale
        true_error_fn = None
        if not self.has_empty_views:
            true_error_fn = make_true_error_fn(
                self.render, self.scene, image_scale=image_scale, chunk=RENDER_CHUNK
            )
        return InputMaker(
            self.setup,
            self.model_fns,
            LookOptions(image_scale=image_scale, chunk=RENDER_CHUNK),
            track=self.track,
            true_error_fn=true_error_fn,
        )

    def acquisition(self, policy_name: str, initial, label: str) -> Acquisition:
        """How a policy of the config chooses, in a run that began with the views `initial`."""
        options = self.config.candidates
        radii = (options.min_train_distance, options.min_candidate_distance)
        return Acquisition(
            get_policy(policy_name),
            self.source,
            self.inputs,
            centre=self.scene.centre,
            batch_size=self.config.batch_size,
            num_rays=int(num_training_pixels(self.scene, np.asarray(initial)).sum()),
            radii=Radii(*radii) if any(radii) else None,
            mode=options.mode or None,
            label=label,
        )


def build_problem(
    config,
    scene: Scene,
    kind: str = RECONSTRUCTION,
    mesh: Mesh | None = None,
    track: Callable = show_progress,
) -> Problem:
    """Puts models, training, curvature and selection together.

    Args:
      config: see `experiments/configs/base.py`; `check_config` has seen it.
      scene: the scene.
      kind: of the field that the run trains and is measured on, one of `KINDS`.
      mesh: devices that share the work, from `make_mesh`.
      track: how progress is shown.

    Raises:
      ConfigError: an option that cannot be used.
    """
    check_shards(config, mesh)
    source, table = make_source(config, scene, make_pixel_table(scene))
    flow = build_flow(config, scene)
    models = {k: build_model(config, scene, len(table.cameras), k, flow, mesh) for k in KINDS}
    lpips_fn, lpips_reason = (None, "switched off: config.lpips_net is empty")
    if config.lpips_net:
        lpips_fn, lpips_reason = make_lpips_fn(config.lpips_net)
    return Problem(
        config=config,
        scene=scene,
        kind=kind,
        source=source,
        table=put_on_all(table, mesh),
        models=models,
        flow=flow,
        trainers={k: build_trainer(config, model) for k, model in models.items()},
        grid=DeformationGrid(
            jnp.asarray(scene.box), config.uncertainty.log2_cells, contracted=scene.unbounded
        ),
        laplace=_laplace_options(config, scene),
        lpips_fn=lpips_fn,
        lpips_reason=lpips_reason,
        track=track,
        mesh=mesh,
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


def _laplace_options(config, scene: Scene) -> LaplaceOptions:
    options = config.uncertainty
    prior_weight = options.prior_weight or default_prior_weight(options.log2_cells)
    return LaplaceOptions(
        prior_weight=prior_weight / float(offset_unit(scene.box)) ** 2,
        weighting=options.weighting,
        variant=options.variant,
        scale=options.scale,
        extent=options.extent,
        max_rays=options.max_rays or None,
        offset_cells=options.offset_cells,
    )
