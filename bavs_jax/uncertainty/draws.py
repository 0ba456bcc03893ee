"""Scenes that the photos allow: offsets drawn from the posterior, and rendered (Fig 3)."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp

from bavs_jax.arrays import Array
from bavs_jax.cameras import Rays
from bavs_jax.fields.deformation import DeformationGrid, displace
from bavs_jax.models.base import ModelState, RadianceModel
from bavs_jax.rendering.render import basic_images


def draw_offsets(key, precision: jax.Array, num: int, *, scale=1.0, limit=jnp.inf) -> jax.Array:
    """Offsets from the Laplace posterior, `theta = scale * n / sqrt(H)`, `n ~ N(0, 1)` (Eqs 6-9).

    Args:
      precision: H [G, 3] > 0, 1 / scene unit^2, from `posterior_precision`.
      num: how many draws; each is as large as `precision`, so that large grids take one at a time.
      scale: temperature, in standard deviations. At 1 the energy is the mean loss itself, as in
        Eq 6, however many rays it is over; `noise_scale` makes it a posterior of the pixels.
      limit: largest offset along each axis, [] or [3], scene units.

    Returns:
      [num, G, 3] scene units.

    Numerics: clipped to `limit`. A vertex that no ray has seen has the prior's variance, which is
    far larger than the scene: its matter would be thrown out of the box, not moved. So has a vertex
    in empty space that rays do cross, where the colour does not change to first order; an offset
    of several cells would read matter there that the photos rule out.
    """
    noise = jax.random.normal(key, (num, *precision.shape), precision.dtype)
    return jnp.clip(scale * noise / jnp.sqrt(precision), -limit, limit)


def noise_scale(mse, num_rays) -> jax.Array:
    """The temperature at which draws are as wide as noisy pixels allow: `sqrt(2 s^2 / R)`.

    For R pixels whose channels have noise of variance `s^2`, the negative log likelihood is
    `(R / 2 s^2)` times the mean over rays of the squared colour error (summed over channels), whose
    curvature H is: the posterior's variance is then `(2 s^2 / R) / H`.

    Args:
      mse: s^2, the mean over training pixels and channels of the squared colour error.
      num_rays: R of `posterior_precision`.
    """
    return jnp.sqrt(2.0 * mse / num_rays)


def make_displaced_render_fn(
    model: RadianceModel, grid: DeformationGrid
) -> Callable[[ModelState, Array, Rays], dict[str, jax.Array]]:
    """Makes the compiled rendering of a model read at `x + D_theta(x)`.

    Samples lie where they lie for `theta = 0`, as they do for the curvature: what moves is where
    the field is read.

    Returns:
      `render(state, offsets [G, 3], rays)`, which gives the `basic_images` of R rays. Offsets are
      traced: no draw compiles anew.
    """

    @jax.jit
    def render(state, offsets, rays):
        return basic_images(model.render(state, rays, displace_fn=partial(displace, grid, offsets)))

    return render


def colour_deviation(rgb: jax.Array) -> jax.Array:
    """How far a pixel's colour moves over draws: `sqrt(mean_c var_d C_dc)`, [...] in [0, 1].

    The variance is the unbiased one.

    Args:
      rgb: [D, ..., 3] of D >= 2 draws, sRGB in [0, 1].
    """
    return jnp.sqrt(jnp.var(rgb, axis=0, ddof=1).mean(-1))
