"""Trains a field less by what is near to a camera, where the camera's rays lie densest."""

import jax
import jax.numpy as jnp

from bavs_jax.fields.base import Field


def with_even_gradients(field: Field, *, distance: float) -> Field:
    """The same field, whose gradients at a sample are scaled by `min(1, (t / distance)^2)`.

    A camera has `1 / t^2` as many rays through an area at the distance t, so what is near to one is
    moved more often than what is far, whatever other cameras see of it: fog before the lens comes
    first, and stays. The scale evens that out (Philip and Deschaintre 2023, "Floaters no more").
    Values are those of the field.

    Args:
      field: any field; how its densities alone are read does not change.
      distance: from which on gradients are whole, scene units.
    """

    def inputs(rays, samples, view_ids=None):
        share = jnp.square(jnp.minimum(samples.t_mids / distance, 1.0))
        return {**field.inputs(rays, samples, view_ids), "gradient_share": share}

    def apply(params, positions, directions, gradient_share, **more):
        def scaled(x):
            share = gradient_share.reshape(-1, *[1] * (x.ndim - 1))
            return share * x + jax.lax.stop_gradient((1.0 - share) * x)

        return jax.tree.map(scaled, field.apply(params, positions, directions, **more))

    return field._replace(apply=apply, inputs=inputs)
