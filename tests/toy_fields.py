"""Small smooth fields with known form, for tests of rendering and curvature."""

import jax
import jax.numpy as jnp

from bavs_jax.cameras import Rays
from bavs_jax.fields.base import Field
from bavs_jax.models.base import ModelState
from bavs_jax.models.ray_field import RayField
from bavs_jax.rendering.samplers import Sampler, dense_samples


def smooth_field_fn(positions, directions):
    """Density and colour that vary with position in every axis, and with direction."""
    x, y, z = positions[..., 0], positions[..., 1], positions[..., 2]
    density = 1.5 + jnp.sin(2.0 * x + y) * jnp.cos(1.5 * z - 0.5 * x)
    rgb = jnp.stack(
        [
            0.5 + 0.4 * jnp.sin(3.0 * x + directions[..., 0]),
            0.5 + 0.3 * jnp.cos(2.0 * y - z),
            0.5 + 0.2 * jnp.sin(x * y + 2.0 * z),
        ],
        axis=-1,
    )
    return density, rgb


def smooth_field() -> Field:
    """`smooth_field_fn` behind the interface of a field; it has no parameters."""
    return Field(
        init=lambda key: {},
        apply=lambda params, x, d: smooth_field_fn(x, d),
        density=lambda params, x: smooth_field_fn(x, x)[0],
    )


NOTHING_LEARNT = ModelState({"field": {}, "sampler": {}}, {})  # of a model without parameters


def ray_model(field, sampler, background, *, box=None, capacity=10_000) -> RayField:
    """A field that is only looked at, through a sampler."""
    return RayField(field, sampler, background=background, box=box, capacity=capacity)


def rays_through(key, num, box_half_side=1.0):
    """Rays from outside of a cube towards random points inside of it."""
    outside_key, inside_key = jax.random.split(key)
    outside = jax.random.normal(outside_key, (num, 3))
    outside = 3.0 * outside / jnp.linalg.norm(outside, axis=-1, keepdims=True)
    inside = jax.random.uniform(inside_key, (num, 3), minval=-0.6, maxval=0.6) * box_half_side
    directions = inside - outside
    return Rays(outside, directions / jnp.linalg.norm(directions, axis=-1, keepdims=True))


def even_sampler(*, near, far, num) -> Sampler:
    """The same even steps along every ray."""

    def sample(key, params, state, rays):
        num_rays = rays.origins.shape[0]
        edges = jnp.tile(jnp.linspace(near, far, num + 1), (num_rays, 1))
        mids = 0.5 * (edges[:, 1:] + edges[:, :-1])
        return dense_samples(mids, jnp.diff(edges), jnp.zeros(num_rays, bool)), {}

    return Sampler(
        init=lambda key: {},
        init_state=lambda: {},
        sample=sample,
        update=lambda key, state, density_fn, step: state,
        loss=lambda aux, samples, weights, colour_loss_fn: 0.0,
        num_slots=num,
        dense=True,
    )
