"""Proposal sampling (Mip-NeRF 360, section 3): small density fields say where to look closely."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from flax import struct

from bavs_jax.fields.base import DensityField
from bavs_jax.rendering.histograms import (
    PADDING,
    distortion_loss,
    interlevel_loss,
    sample_histogram,
    stratified_quantiles,
)
from bavs_jax.rendering.samplers import Sampler, dense_samples, field_weights
from bavs_jax.rendering.spacing import IntervalFn

ANNEAL_SLOPE = 10.0  # of Mip-NeRF 360 (Eq 18)


class ProposalState(struct.PyTreeNode):
    """How far proposals are trusted."""

    anneal: jax.Array  # [] exponent of their weights, from 0 (not at all) to 1


def anneal_exponent(progress: jax.Array) -> jax.Array:
    """`b p / ((b - 1) p + 1)` with b = 10, from 0 at p = 0 to 1 at p = 1 (Mip-NeRF 360, Eq 18)."""
    progress = jnp.clip(progress, 0.0, 1.0)
    return ANNEAL_SLOPE * progress / ((ANNEAL_SLOPE - 1.0) * progress + 1.0)


def make_proposal_sampler(
    proposals: Sequence[DensityField],
    interval_fn: IntervalFn,
    *,
    num_proposals: Sequence[int] = (64, 32),
    num_samples: int = 32,
    anneal_steps: int = 1000,
    interlevel_weight: float = 1.0,
    distortion_weight: float = 0.002,
    penalty_weight: float = 0.0,
) -> Sampler:
    """Rounds of even steps, each spaced by the histogram that the round before found.

    Args:
      proposals: one density field for each round before the last.
      interval_fn: near and far of each ray, and the spacing between.
      num_proposals: samples of each proposal.
      num_samples: S, what the field is read at.
      anneal_steps: optimiser steps until proposals are fully trusted.
      interlevel_weight, distortion_weight: of these losses, per ray.
      penalty_weight: of the proposals' own penalty.
    """
    if len(proposals) != len(num_proposals):
        raise ValueError(f"num_proposals: {len(num_proposals)} for {len(proposals)} proposals")
    counts = (*num_proposals, num_samples)

    def init(key):
        keys = jax.random.split(key, len(proposals))
        return [proposal.init(k) for proposal, k in zip(proposals, keys)]

    def sample(key, params, state, rays):
        num_rays = rays.origins.shape[0]
        interval = interval_fn(rays)
        edges = jnp.broadcast_to(jnp.array([0.0, 1.0]), (num_rays, 2))
        weights = jnp.ones((num_rays, 1))
        all_edges, all_weights = [], []
        for level, count in enumerate(counts):
            level_key = None if key is None else jax.random.fold_in(key, level)
            # No gradient through where samples lie: proposals learn by the interlevel loss alone.
            trusted = jax.lax.stop_gradient(_anneal(weights, state.anneal) + PADDING)
            edges = sample_histogram(edges, trusted, _even_edges(level_key, num_rays, count))
            t_edges = interval.distance(edges)
            samples = dense_samples(
                0.5 * (t_edges[:, 1:] + t_edges[:, :-1]), jnp.diff(t_edges), interval.is_empty
            )
            all_edges.append(edges)
            if level < len(proposals):
                weights = field_weights(proposals[level], params[level], rays, samples)
                all_weights.append(weights)
        penalty = sum(p.penalty(params[i]) for i, p in enumerate(proposals))
        return samples, {"edges": all_edges, "weights": all_weights, "penalty": penalty}

    def loss(aux, samples, weights, colour_loss_fn):
        del samples, colour_loss_fn
        last = aux["edges"][-1]
        interlevel = sum(
            interlevel_loss(edges, proposed, last, weights).mean()
            for edges, proposed in zip(aux["edges"], aux["weights"])
        )
        return (
            interlevel_weight * interlevel
            + distortion_weight * distortion_loss(last, weights).mean()
            + penalty_weight * aux["penalty"]
        )

    def update(key, state, density_fn, step):
        del key, state, density_fn
        return ProposalState(anneal_exponent(step / max(anneal_steps, 1)))

    return Sampler(
        init=init,
        init_state=lambda: ProposalState(jnp.float32(0.0)),
        sample=sample,
        update=update,
        loss=loss,
        num_slots=num_samples,
        dense=True,
    )


def _anneal(weights, exponent):
    """`weights^exponent`: 1 everywhere for an exponent of 0, also where there is no weight."""
    return jnp.maximum(weights, 1e-12) ** exponent


def _even_edges(key, num_rays: int, count: int) -> jax.Array:
    """Edges [R, count + 1] over all of [0, 1], the inner ones shifted by one jitter a ray.

    Differs from nerfacto, which leaves half an interval out at both ends: what is next to the
    camera, and what is far behind a surface, would never be looked at.
    """
    inner = stratified_quantiles(key, num_rays, count)[:, 1:] - 0.5 / count
    ends = jnp.ones((num_rays, 1))
    return jnp.concatenate([0.0 * ends, inner, ends], axis=-1)
