"""A radiance field that is sampled along rays: the paper's own kind of model (Eqs 1-5)."""

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from bavs_jax.arrays import Array
from bavs_jax.cameras import Rays
from bavs_jax.devices import num_shards, over_rays, shard_rays
from bavs_jax.fields.base import Field
from bavs_jax.models.base import ModelState, RayTerms, StepReport
from bavs_jax.models.losses import colour_loss
from bavs_jax.models.objectives import Objective
from bavs_jax.pixel_table import PixelTable, sample_pixels, training_sizes
from bavs_jax.rendering.render import Channel, DisplaceFn, RayRendering, render_rays
from bavs_jax.rendering.samplers import Sampler
from bavs_jax.rendering.sampling import Samples, first_slots, sample_positions, visible_samples
from bavs_jax.rendering.slopes import colour_jacobian, depth_jacobian, field_slopes

LEAST_LIGHT = 0.01  # that must reach a sample for it to be trained


class RayTraining(NamedTuple):
    """What a step of training looks at, and what it makes small."""

    objective: Objective  # from `objectives.py`
    num_rays: int  # R, rays of one step
    capacity: int  # K, samples that each device evaluates in a step; see `places_needed`
    rays_per_pixel: int = 1  # see `sample_pixels`
    random_background: bool = False  # see `sample_pixels`
    penalty_weight: float = 0.0  # of the field's own penalty
    # Of the field's roughness, for one training pixel: as a prior should, it counts the less the
    # more pixels there are.
    roughness_weight: float = 0.0
    # Times K samples whose density is looked at in a step, to leave out those that are hidden
    # behind others (`visible_samples`); 0 leaves out none.
    look_ahead: int = 0


@dataclasses.dataclass(frozen=True, eq=False)
class RayField:
    """A field, and how rays are sampled for it; a `RadianceModel`.

    `ModelState.params` are {"field", "sampler"}, both trained; `carried` is the sampler's state.
    """

    field: Field
    sampler: Sampler
    background: Array | None  # [3] colour behind everything, or None (see `composite_colour`)
    box: Array | None  # [2, 3] scene units, where rays are sampled; None: everywhere
    capacity: int  # places of each device's buffer in which samples are evaluated when rendering
    training: RayTraining | None = None  # None: the model is only looked at
    mesh: Mesh | None = None  # devices that share the rays of a step (see `devices.py`)

    @property
    def most_points(self) -> int:
        return self.sampler.num_slots

    @property
    def always_most(self) -> bool:
        return self.sampler.dense

    @property
    def reads_views(self) -> bool:
        return self.field.reads_views

    def init(self, key) -> ModelState:
        params = {
            "field": self.field.init(key),
            "sampler": self.sampler.init(jax.random.fold_in(key, 1)),
        }
        return ModelState(params, self.sampler.init_state())

    # --- training ---

    def loss(
        self, key, state: ModelState, table: PixelTable, is_training_view
    ) -> tuple[jax.Array, StepReport]:
        """Of random pixels, R rays in all: the objective, and what field and sampler add."""
        training, params = self._how_trained(), state.params
        *keys, objective_key = jax.random.split(key, 3)
        batch, samples, aux = self._batch(keys, state, table, is_training_view)
        fits = jnp.ones(training.num_rays, bool)
        if self._leaves_out:
            samples, fits = self._visible(params["field"], batch.rays, samples)
            batch = batch.replace(pixel_weight=batch.pixel_weight * batch.whole(fits))
        outcome = training.objective(
            objective_key, params["field"], batch, samples, capacity=training.capacity
        )
        pixel_weight = batch.pixel_weight * batch.whole(outcome.ray_mask)

        def colour_loss_fn(ray_rgb):
            return colour_loss(batch.mean(ray_rgb), batch.rgb, pixel_weight)

        loss = outcome.loss
        loss += self.sampler.loss(aux, samples, outcome.weights, colour_loss_fn)
        penalty = training.penalty_weight * self.field.penalty(params["field"])
        if training.roughness_weight:
            roughness = self.field.roughness(params["field"])
            num_pixels = training_sizes(table, is_training_view).sum()
            penalty += training.roughness_weight / num_pixels * roughness
        return loss + penalty, StepReport(
            loss=colour_loss(outcome.rgb, batch.rgb, pixel_weight),
            rays=(outcome.ray_mask & fits).sum(),
            samples=(samples.sample_mask & outcome.ray_mask[:, None]).sum(),
            thinned=samples.thinned.mean(),
        )

    def places_needed(
        self, key, state: ModelState, table: PixelTable, is_training_view
    ) -> jax.Array:
        """The least `RayTraining.capacity` with which `loss` leaves out no ray of its batch, [].

        Another batch needs a few per cent more or less.
        """
        training = self._how_trained()
        *keys, _ = jax.random.split(key, 3)
        batch, samples, _ = self._batch(keys, state, table, is_training_view)
        places = self._on_one_device(samples)
        if self._leaves_out:
            looked_at = -(-places // training.look_ahead)
            seen, _ = self._visible(state.params["field"], batch.rays, samples)
            places = jnp.maximum(looked_at, self._on_one_device(seen))
        return places

    def _on_one_device(self, samples: Samples) -> jax.Array:
        """The most samples [] that a device has of its own."""
        by_device = samples.sample_mask.reshape(num_shards(self.mesh), -1)
        return by_device.sum(-1, dtype=jnp.int32).max()

    def _batch(self, keys, state: ModelState, table: PixelTable, is_training_view):
        """Random pixels with their rays, the samples of these, and what the sampler's loss needs;
        `keys` [2]."""
        training = self._how_trained()
        pixel_key, sample_key = keys
        batch = sample_pixels(
            pixel_key,
            table,
            is_training_view,
            training.num_rays,
            rays_per_pixel=training.rays_per_pixel,
            background=self.background,
            random_background=training.random_background,
        )
        batch = shard_rays(batch, self.mesh)
        params = state.params["sampler"]
        return batch, *self.sampler.sample(sample_key, params, state.carried, batch.rays)

    @property
    def _leaves_out(self) -> bool:
        """Whether a step looks ahead for samples that are hidden."""
        return self._how_trained().look_ahead > 0 and not self.sampler.dense

    def _how_trained(self) -> RayTraining:
        if self.training is None:
            raise ValueError("training: None, so this model is only looked at; give it one")
        return self.training

    def _visible(self, field_params, rays: Rays, samples: Samples):
        training = self._how_trained()

        def visible(params, rays, samples):
            return visible_samples(
                partial(self.field.density, params),
                rays,
                samples,
                capacity=training.look_ahead * training.capacity,
                least=LEAST_LIGHT,
            )

        sharded = (False, True, True)
        return over_rays(visible, self.mesh, sharded=sharded)(field_params, rays, samples)

    def refresh(self, key, state: ModelState, step) -> ModelState:
        density_fn = partial(self.field.density, state.params["field"])
        return state.replace(carried=self.sampler.update(key, state.carried, density_fn, step))

    # --- looking ---

    def samples(self, state: ModelState, rays: Rays) -> Samples:
        """Where rays are looked at, without jitter."""
        return self.sampler.sample(None, state.params["sampler"], state.carried, rays)[0]

    def render(
        self,
        state: ModelState,
        rays: Rays,
        *,
        channels: Mapping[str, Channel] | None = None,
        displace_fn: DisplaceFn | None = None,
    ) -> RayRendering:
        samples = self.samples(state, rays)
        return render_rays(
            rays,
            samples,
            partial(self.field.apply, state.params["field"]),
            background=self.background,
            capacity=self.capacity,
            exact=True,
            inputs=self.field.inputs(rays, samples),
            displace_fn=displace_fn,
            channels=channels,
        )

    def num_points(self, state: ModelState, rays: Rays) -> jax.Array:
        return self.samples(state, rays).sample_mask.sum(-1)

    def ray_terms(
        self, state: ModelState, rays: Rays, *, most_points: int, view_ids=None
    ) -> RayTerms:
        """Samples are held where they are: what moves is where the field is read (Eq 10)."""
        samples = first_slots(self.samples(state, rays), most_points)
        slopes = field_slopes(
            partial(self.field.apply, state.params["field"]),
            rays,
            samples,
            inputs=self.field.inputs(rays, samples, view_ids),
        )
        background = self.background
        if background is not None:
            background = np.asarray(background, np.float32)
        by_colour, rgb = colour_jacobian(slopes, samples.deltas, background=background)
        by_depth, depth, opacity = depth_jacobian(slopes, samples)
        return RayTerms(
            positions=sample_positions(rays, samples),
            colour_jacobian=by_colour,
            depth_jacobian=by_depth,
            rgb=rgb,
            depth=depth,
            opacity=opacity,
            thinned=samples.thinned,
        )

    def density(self, state: ModelState, positions) -> jax.Array:
        return self._inside(positions, self.field.density(state.params["field"], positions))

    def radiance(self, state: ModelState, positions, directions) -> tuple[jax.Array, jax.Array]:
        density, rgb, *_ = self.field.apply(state.params["field"], positions, directions)
        return self._inside(positions, density), rgb

    def _inside(self, positions, density):
        """0 outside of the box: a field reads its nearest face there, but no ray ever looks."""
        if self.box is None:
            return density
        lower, upper = jnp.asarray(self.box)
        return jnp.where(((positions >= lower) & (positions <= upper)).all(-1), density, 0.0)
