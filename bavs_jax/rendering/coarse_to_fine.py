"""Hierarchical sampling of NeRF (Eq 5 and section 5.2 of Mildenhall et al. 2020).

A coarse radiance field is rendered at stratified samples and trained on the colour of its own
rendering; the fine field is read at these samples and at more drawn from the coarse weights.
"""

import jax
import jax.numpy as jnp

from bavs_jax.fields.base import Field
from bavs_jax.rendering.compositing import composite_colour, render_weights
from bavs_jax.rendering.histograms import sample_histogram, stratified_quantiles
from bavs_jax.rendering.samplers import Sampler, dense_samples
from bavs_jax.rendering.sampling import flatten_inputs, sample_positions
from bavs_jax.rendering.spacing import IntervalFn

PADDING = 1e-5  # weight that each coarse interval gets on top, as in NeRF


def make_coarse_to_fine_sampler(
    coarse: Field, interval_fn: IntervalFn, *, background, num_coarse: int = 64, num_fine: int = 128
) -> Sampler:
    """Stratified samples, and more of them where a coarse field found weight.

    Args:
      coarse: a radiance field of its own.
      interval_fn: near and far of each ray, and the spacing between.
      background: [3] colour behind everything, or None (see `composite_colour`).
      num_coarse, num_fine: samples of each kind; the fine field is read at both together.
    """

    def sample(key, params, state, rays):
        del state
        num_rays = rays.origins.shape[0]
        keys = (None, None) if key is None else jax.random.split(key)
        interval = interval_fn(rays)
        s_edges = jnp.tile(jnp.linspace(0.0, 1.0, num_coarse + 1), (num_rays, 1))
        t_edges = interval.distance(s_edges)
        s_coarse = _stratified(keys[0], num_rays, num_coarse)
        t_coarse = interval.distance(s_coarse)
        samples = dense_samples(t_coarse, jnp.diff(t_edges), interval.is_empty)
        weights, rgb = _render_coarse(coarse, params, rays, samples, background)

        padded = jax.lax.stop_gradient(weights) + PADDING
        s_fine = sample_histogram(
            s_edges, padded, stratified_quantiles(keys[1], num_rays, num_fine)
        )
        s_all = jnp.sort(jnp.concatenate([s_coarse, s_fine], axis=-1), axis=-1)
        # Each sample stands for the way up to the middles between it and its neighbours.
        ends = jnp.ones((num_rays, 1))
        middles = 0.5 * (s_all[:, 1:] + s_all[:, :-1])
        cells = interval.distance(jnp.concatenate([0.0 * ends, middles, ends], axis=-1))
        return (
            dense_samples(interval.distance(s_all), jnp.diff(cells), interval.is_empty),
            {"rgb": rgb},
        )

    return Sampler(
        init=coarse.init,
        init_state=lambda: {},
        sample=sample,
        update=lambda key, state, density_fn, step: state,
        loss=lambda aux, samples, weights, colour_loss_fn: colour_loss_fn(aux["rgb"]),
        num_slots=num_coarse + num_fine,
        dense=True,
    )


def _stratified(key, num_rays: int, count: int) -> jax.Array:
    """One place in each of `count` equal parts of [0, 1], [R, count]; its middle without a key."""
    jitter = 0.5 if key is None else jax.random.uniform(key, (num_rays, count))
    return jnp.broadcast_to((jnp.arange(count) + jitter) / count, (num_rays, count))


def _render_coarse(coarse: Field, params, rays, samples, background):
    positions = sample_positions(rays, samples)
    directions = jnp.broadcast_to(rays.directions[:, None], positions.shape)
    inputs = flatten_inputs(coarse.inputs(rays, samples))
    density, rgb = coarse.apply(
        params, positions.reshape(-1, 3), directions.reshape(-1, 3), **inputs
    )
    shape = samples.t_mids.shape
    weights = render_weights(density.reshape(shape), samples.deltas)
    return weights, composite_colour(weights, rgb.reshape(*shape, 3), background)
