"""Lens models: where a direction is seen, and which direction a point is seen from.

A lens maps a point of its undistorted plane to where it is seen, both [2] and in focal lengths.
A direction at the angle `theta` from the optical axis lies at the radius `tan(theta)` of the plane
of a pinhole or opencv lens, and at the radius `theta` of a fisheye's, which holds all directions.
"""

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.arrays import Array

RADII = 64  # among which a radius is looked up before Newton's method refines it
RADIUS_STEPS = 8
TANGENTIAL_STEPS = 5


def distort_pinhole(xy: Array, distortion: Array) -> Array:
    """The ideal lens: points are seen where they are."""
    del distortion
    return xy


def radial_polynomial(radius: Array, distortion: Array) -> Array:
    """Seen radius `r (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8)`."""
    k1, k2, k3, k4 = (distortion[..., i] for i in range(4))
    r2 = radius * radius
    return radius * (1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4))))


def radial_slope(radius: Array, distortion: Array) -> Array:
    """Derivative of `radial_polynomial` by the radius."""
    k1, k2, k3, k4 = (distortion[..., i] for i in range(4))
    r2 = radius * radius
    return 1.0 + r2 * (3.0 * k1 + r2 * (5.0 * k2 + r2 * (7.0 * k3 + r2 * 9.0 * k4)))


def distort_opencv(xy: Array, distortion: Array) -> Array:
    """Brown-Conrady: radial `1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8` and tangential `p1, p2`.

    Differs from OpenCV: `k4` is the `r^8` term, as in nerfstudio, not a denominator.
    """
    k1, k2, k3, k4, p1, p2 = (distortion[..., i] for i in range(6))
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    yd = y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y)
    return jnp.stack([xd, yd], axis=-1)


def distort_fisheye(xy: Array, distortion: Array) -> Array:
    """Kannala-Brandt: `theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)`.

    The plane is that of angles, `xy = theta (cos phi, sin phi)`; there is no tangential part.
    """
    k1, k2, k3, k4 = (distortion[..., i] for i in range(4))
    theta2 = (xy * xy).sum(axis=-1)
    radial = 1.0 + theta2 * (k1 + theta2 * (k2 + theta2 * (k3 + theta2 * k4)))
    return xy * radial[..., None]


LENSES = {"pinhole": distort_pinhole, "opencv": distort_opencv, "fisheye": distort_fisheye}


def rising_radii(distortion: Array, *, lens: str) -> Array:
    """Radii from 0 up to where a lens stops to show each direction at a place of its own.

    The last one is where the radial polynomial first stops to rise: beyond it the image folds
    back over itself, an artefact of the polynomial. At most `pi` for a fisheye and
    `tan(88 degrees)` for an opencv lens.

    Args:
      distortion: [6] coefficients.
      lens: "opencv" or "fisheye".

    Returns:
      [RADII + 1] ascending radii in equal steps of the angle; the last one fills what is left.

    Numerics: between two radii the slope of the polynomial counts as straight.
    """
    angles = np.linspace(0.0, np.pi if lens == "fisheye" else np.deg2rad(88.0), RADII + 1)
    radii = jnp.asarray(angles if lens == "fisheye" else np.tan(angles), distortion.dtype)
    slope = radial_slope(radii, distortion)
    folds = slope <= 0.0
    after = jnp.where(folds.any(), jnp.argmax(folds), RADII)  # at 0 the slope is 1
    before = after - 1
    share = slope[before] / jnp.where(folds[after], slope[before] - slope[after], slope[before])
    return jnp.minimum(radii, radii[before] + share * (radii[after] - radii[before]))


def undistort_radius(seen: Array, distortion: Array, *, lens: str) -> Array:
    """Inverts the radial polynomial by Newton's method within a bracket.

    Args:
      seen: [] radius at which a point is seen, at least 0.
      distortion: [6] coefficients.
      lens: "opencv" or "fisheye".

    Returns:
      [] undistorted radius; the last of `rising_radii` where nothing is seen so far out.

    Numerics: steps stay between the two radii that enclose the solution, so that no lens is too
    strong; the slope there is kept away from 0.
    """
    radii = rising_radii(distortion, lens=lens)
    values = radial_polynomial(radii, distortion)
    index = jnp.clip((values < seen).sum(), 1, RADII)
    low, high = radii[index - 1], radii[index]
    rise = values[index] - values[index - 1]
    share = (seen - values[index - 1]) / jnp.where(rise > 0.0, rise, 1.0)

    def step(radius, _):
        error = radial_polynomial(radius, distortion) - seen
        slope = jnp.maximum(radial_slope(radius, distortion), 1e-6)
        return jnp.clip(radius - error / slope, low, high), None

    start = low + jnp.clip(share, 0.0, 1.0) * (high - low)
    radius, _ = jax.lax.scan(step, start, None, length=RADIUS_STEPS)
    return jnp.where(seen < values[-1], radius, radii[-1])


def undistort(xy_distorted: Array, distortion: Array, *, lens: str) -> Array:
    """Inverts a lens by Newton's method with its exact derivative.

    Solves `distort(xy) = xy_distorted`: first along the radius alone, then for both coordinates
    where the lens has a tangential part.

    Args:
      xy_distorted: [2] where a point is seen through the lens, in focal lengths.
      distortion: [6] coefficients.
      lens: a key of `LENSES`.

    Returns:
      [2] point of the lens's undistorted plane. Use `jax.vmap` for many.

    Numerics: a fixed number of steps, each by Cramer's rule and taken only where it lowers the
    error; a pixel beyond the lens's invertible range gets the range's edge.
    """
    if lens == "pinhole":
        return xy_distorted
    distort = LENSES[lens]
    seen2 = (xy_distorted * xy_distorted).sum()
    seen = jnp.sqrt(jnp.where(seen2 > 0.0, seen2, 1.0))  # so that the square root has a gradient
    ratio = jnp.where(seen2 > 0.0, undistort_radius(seen, distortion, lens=lens) / seen, 1.0)
    start = xy_distorted * ratio
    if lens == "fisheye":
        return start

    def step(xy, _):
        error = distort(xy, distortion) - xy_distorted
        jac = jax.jacfwd(distort)(xy, distortion)
        det = jac[0, 0] * jac[1, 1] - jac[0, 1] * jac[1, 0]
        det = jnp.where(jnp.abs(det) < 1e-6, 1e-6, det)
        dx = (jac[1, 1] * error[0] - jac[0, 1] * error[1]) / det
        dy = (jac[0, 0] * error[1] - jac[1, 0] * error[0]) / det
        moved = xy - jnp.stack([dx, dy])
        lower = jnp.abs(distort(moved, distortion) - xy_distorted).sum() < jnp.abs(error).sum()
        return jnp.where(lower, moved, xy), None

    xy, _ = jax.lax.scan(step, start, None, length=TANGENTIAL_STEPS)
    return xy


def lens_directions(xy: Array, *, lens: str) -> jax.Array:
    """Directions [..., 3], of any length, for points [..., 2] of a lens's undistorted plane.

    `[x, -y, -1]`, or `[sin(theta) x / theta, -sin(theta) y / theta, -cos(theta)]` with
    `theta = |xy|` for a fisheye, so that fields of view up to 360 degrees are right; OpenGL axes.

    `lens` is a key of `LENSES`.
    """
    x, y = xy[..., 0], xy[..., 1]
    if lens == "fisheye":
        theta = jnp.sqrt(jnp.maximum(x * x + y * y, 1e-20))  # so that 0 has a gradient
        sinc = jnp.sin(theta) / theta
        return jnp.stack([sinc * x, -sinc * y, -jnp.cos(theta)], axis=-1)
    return jnp.stack([x, -y, -jnp.ones_like(x)], axis=-1)
