"""Points to pixels: where a camera would see a point, the inverse of `cameras.pixel_rays`."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from bavs_jax.cameras import Cameras
from bavs_jax.lenses import LENSES, rising_radii
from bavs_jax.numerics import safe_divide


def project(camera: Cameras, points: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Pixel at which a camera sees each point, were nothing in between.

    `pixel = f distort(xy) + c` with `xy` the point on the lens's undistorted plane (`lenses.py`).

    Args:
      camera: one camera: `Cameras` without the axis of views, as under `jax.vmap` or a scan.
      points: [..., 3] scene units.

    Returns:
      pixels [..., 2] x (to the right) and y (down), 0 for what is not in the image;
      is_in_image [...] bool: in front of the camera, within the lens's range and within the image.
    """
    pose = camera.world_from_cam
    # Spelt out by components for the reasons given in `pixel_rays`.
    x, y, z = (points[..., i] - pose[i, 3] for i in range(3))
    right, up, back = (x * pose[0, i] + y * pose[1, i] + z * pose[2, i] for i in range(3))
    down, ahead = -up, -back
    across = jnp.stack([right, down], axis=-1)
    if camera.lens == "fisheye":
        radius = jnp.linalg.norm(across, axis=-1)
        is_shown = (radius > 0.0) | (ahead > 0.0)
        scale = safe_divide(jnp.arctan2(radius, ahead), radius)
    else:
        is_shown = ahead > 0.0
        scale = jnp.where(is_shown, 1.0, 0.0) / jnp.where(is_shown, ahead, 1.0)
    xy = scale[..., None] * across
    if camera.lens != "pinhole":
        # Beyond the lens's range its polynomial folds the outside back into the image.
        is_shown &= (
            jnp.linalg.norm(xy, axis=-1) < rising_radii(camera.distortion, lens=camera.lens)[-1]
        )
    seen_at = LENSES[camera.lens](xy, camera.distortion)
    pixels = camera.intrinsics[:2] * seen_at + camera.intrinsics[2:]
    is_in_image = is_shown & ((pixels >= 0.0) & (pixels <= camera.sizes)).all(axis=-1)
    return jnp.where(is_in_image[..., None], pixels, 0.0), is_in_image
