"""How samples are chosen along rays: one protocol for occupancy grids, proposals and coarse nets.

The renderer, training, curvature and scoring know of no kind of sampler, only of this protocol.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from bavs_jax.arrays import DensityFn
from bavs_jax.cameras import Rays
from bavs_jax.fields.base import DensityField, Field, InitParams, Params
from bavs_jax.rendering.compositing import render_weights
from bavs_jax.rendering.occupancy import init_occupancy, update_occupancy
from bavs_jax.rendering.sampling import (
    MarchOptions,
    Samples,
    flatten_inputs,
    march,
    sample_positions,
)

State = Any  # a pytree, each sampler's own: carried but not trained, such as an occupancy grid
Aux = Any  # a pytree, each sampler's own: what its loss is made of


class InitState(Protocol):
    """The state of a sampler before any training."""

    def __call__(self) -> State: ...


class SampleFn(Protocol):
    """Samples [R, S] of R rays, through which no gradient runs; jitters by the key, and takes the
    middle of each step without one."""

    def __call__(
        self, key: jax.Array | None, params: Params, state: State, rays: Rays, /
    ) -> tuple[Samples, Aux]: ...


class UpdateState(Protocol):
    """The state by what has been trained; called once before each compiled run of steps, `step` []
    of them done."""

    def __call__(
        self, key: jax.Array, state: State, density_fn: DensityFn, step: jax.Array, /
    ) -> State: ...


ColourLossFn = Callable[[jax.Array], jax.Array]  # the loss [] of colours [R, 3] of the same pixels


class SamplerLoss(Protocol):
    """What training adds for a sampler, [], from the samples and their rendering weights [R, S]."""

    def __call__(
        self, aux: Aux, samples: Samples, weights: jax.Array, colour_loss_fn: ColourLossFn, /
    ) -> jax.Array | float: ...


class Sampler(NamedTuple):
    """A way to choose samples as pure functions."""

    init: InitParams  # trained along with the field; {} where there is nothing to train
    init_state: InitState
    sample: SampleFn
    update: UpdateState
    loss: SamplerLoss
    num_slots: int  # S, most samples of a ray
    dense: bool  # whether every ray fills all of its slots


def make_occupancy_sampler(
    box, options: MarchOptions, *, resolution: int, num_updated: int | None = None
) -> Sampler:
    """Even steps through the occupied cells of a box.

    Args:
      box: [2, 3] scene units.
      options: spacing and limits of the steps.
      resolution: cells per side of the occupancy grid.
      num_updated: cells looked at in each update; a quarter of all when None.
    """
    num_updated = num_updated or resolution**3 // 4

    def sample(key, params, state, rays):
        del params
        jitter = None if key is None else jax.random.uniform(key, rays.origins.shape[:1])
        return march(rays, state, options, jitter=jitter), {}

    def update(key, state, density_fn, step):
        del step
        return update_occupancy(
            key, state, density_fn, num_samples=num_updated, step_size=options.step_size
        )

    return Sampler(
        init=lambda key: {},
        init_state=lambda: init_occupancy(box, resolution=resolution),
        sample=sample,
        update=update,
        loss=lambda aux, samples, weights, colour_loss_fn: 0.0,
        num_slots=options.num_slots,
        dense=False,
    )


def dense_samples(t_mids: jax.Array, deltas: jax.Array, is_empty: jax.Array) -> Samples:
    """Samples that fill every slot [R, S], but for rays [R] with nothing to look at.

    No gradient runs through them.
    """
    sample_mask = jnp.broadcast_to(~is_empty[:, None], t_mids.shape)
    return jax.lax.stop_gradient(
        Samples(
            t_mids=t_mids,
            deltas=jnp.where(sample_mask, deltas, 0.0),
            sample_mask=sample_mask,
            thinned=jnp.zeros(t_mids.shape[:1], bool),
            dense=True,
        )
    )


def field_weights(
    field: DensityField | Field, params: Params, rays: Rays, samples: Samples
) -> jax.Array:
    """Rendering weights [R, S] of a density field at samples."""
    positions = sample_positions(rays, samples)
    inputs = flatten_inputs(field.inputs(rays, samples))
    density = field.density(params, positions.reshape(-1, 3), **inputs)
    return render_weights(density.reshape(samples.t_mids.shape), samples.deltas)
