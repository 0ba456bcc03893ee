"""What a field is trained for: from a batch of rays and samples to a loss.

An `Objective` is a pure function of a field's parameters. The samples' own losses and the field's
penalty are added by `ray_field.py`.
"""

from functools import partial
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from bavs_jax.devices import over_rays
from bavs_jax.fields.base import Field, Params
from bavs_jax.fields.flow_field import FlowField, base_draws
from bavs_jax.models.losses import colour_loss, flow_loss, gaussian_nll, weighted_mean
from bavs_jax.numerics import MIN_VARIANCE
from bavs_jax.pixel_table import PixelBatch
from bavs_jax.rendering.compositing import rendered_variance
from bavs_jax.rendering.render import RayRendering, render_rays
from bavs_jax.rendering.sampling import Samples


class Outcome(NamedTuple):
    """What an objective found."""

    loss: jax.Array  # [] what is made small
    rgb: jax.Array  # [P, 3] the colours of pixels, for the report
    weights: jax.Array  # [R, S] rendering weights, for the losses of samplers
    ray_mask: jax.Array  # [R] bool, false for rays that did not fit the sample buffer


class Objective(Protocol):
    """The loss of a field's parameters on a batch of pixels, whose R rays are seen at [R, S].

    `capacity` are the places of each device's buffer for valid samples; a dense sampler needs none.
    """

    def __call__(
        self,
        key: jax.Array,
        params: Params,
        batch: PixelBatch,
        samples: Samples,
        /,
        *,
        capacity: int,
    ) -> Outcome: ...


def _render_batch(
    field: Field,
    mesh: Mesh | None,
    params: Params,
    batch: PixelBatch,
    samples: Samples,
    *,
    capacity: int,
) -> RayRendering:
    def render(params: Params, batch: PixelBatch, samples: Samples) -> RayRendering:
        return render_rays(
            batch.rays,
            samples,
            partial(field.apply, params),
            background=batch.background,
            capacity=capacity,
            exact=False,
            inputs=field.inputs(batch.rays, samples, batch.view_ids),
        )

    return over_rays(render, mesh, sharded=(False, True, True))(params, batch, samples)


def make_colour_objective(field: Field, *, mesh: Mesh | None = None) -> Objective:
    """Mean squared colour error (Eq 5).

    Args:
      mesh: devices that share the rays (see `devices.py`).
    """

    def objective(key, params, batch, samples, *, capacity):
        del key
        out = _render_batch(field, mesh, params, batch, samples, capacity=capacity)
        rgb = batch.mean(out.rgb)
        loss = colour_loss(rgb, batch.rgb, batch.pixel_weight * batch.whole(out.ray_mask))
        return Outcome(loss, rgb, out.weights, out.ray_mask)

    return objective


def make_variance_objective(
    field: Field,
    *,
    density_weight: float = 0.01,
    through_weights: bool = False,
    mesh: Mesh | None = None,
) -> Objective:
    """Likelihood of the colours under the rendered variance (ActiveNeRF, Pan et al. 2022).

    `mean_rc (C - C*)^2 / (2 U) + mean_r log(U) / 2 + density_weight mean_i sigma_i`, with
    `U = sum_i w_i^2 beta_i + (1 - sum_i w_i)^2 0.01` of the field's `beta`.

    Differs from ActiveNeRF: U moves the variances alone, not the weights (`through_weights`). Fog
    of n equal samples has an n-th of a wall's U, and where colours are known better than the least
    variance, 0.01, likelihood prefers fog: lego from 20 views had 18 dB so, and 27 dB else. And the
    background counts as one more sample, of the least variance a sample can have; without it U
    vanishes on rays that meet nothing, and they outweigh all others.

    Args:
      field: one whose `apply` also returns `beta`.
      density_weight: of the mean density over all slots, which keeps empty space empty.
      through_weights: whether the geometry is moved to make U likelier too, as published.
      mesh: see `make_colour_objective`.
    """

    def objective(key, params, batch, samples, *, capacity):
        del key
        out = _render_batch(field, mesh, params, batch, samples, capacity=capacity)
        rgb, weight = batch.mean(out.rgb), batch.pixel_weight * batch.whole(out.ray_mask)
        weights = out.weights if through_weights else jax.lax.stop_gradient(out.weights)
        variance = rendered_variance(weights, out.values["beta"])
        variance = variance + jnp.square(1.0 - weights.sum(-1)) * MIN_VARIANCE
        loss = gaussian_nll(rgb, batch.rgb, batch.mean(variance), weight)
        # Over all slots, the empty ones too: over the occupied alone it would thin out surfaces.
        density = weighted_mean(batch.mean(out.density.mean(-1)), weight)
        return Outcome(loss + density_weight * density, rgb, out.weights, out.ray_mask)

    return objective


def make_flow_objective(
    flow: FlowField,
    *,
    num_draws: int = 32,
    entropy_weight: float = 0.01,
    floor: float = 1e-5,
    mesh: Mesh | None = None,
) -> Objective:
    """Likelihood of the colours under K draws of a distribution over fields (CF-NeRF).

    Args:
      num_draws: K, of the base, shared by all points; new ones in each step.
      entropy_weight, floor: see `flow_loss`.
      mesh: see `make_colour_objective`.
    """

    def objective(key, params, batch, samples, *, capacity):
        def render(params, noise, batch, samples):
            return render_rays(
                batch.rays,
                samples,
                partial(flow.apply, params, noise=noise),
                background=batch.background,
                capacity=capacity,
                exact=False,
            )

        render_draw = over_rays(render, mesh, sharded=(False, False, True, True))
        render_draws = jax.vmap(render_draw, in_axes=(None, 0, None, None))
        draws = render_draws(params, base_draws(key, num_draws), batch, samples)
        ray_mask, rgb = draws.ray_mask[0], jax.vmap(batch.mean)(draws.rgb)
        loss = flow_loss(
            rgb,
            batch.rgb,
            batch.pixel_weight * batch.whole(ray_mask),
            draws.values["log_prob"],
            samples.sample_mask & ray_mask[:, None],
            entropy_weight=entropy_weight,
            floor=floor,
        )
        return Outcome(loss, rgb.mean(0), draws.weights.mean(0), ray_mask)

    return objective
