"""Image measures that need no posterior: entropy, disagreement, coverage and true error."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image

from bavs_jax.arrays import Array
from bavs_jax.cameras import Cameras, project, reduced_cameras, take
from bavs_jax.numerics import opacity_or_empty, safe_divide, unit_vectors, x_log_x
from bavs_jax.rendering.images import RenderChunk, render_views
from bavs_jax.scenes.base import Scene
from bavs_jax.training.train import TrainState


def ray_entropy(weights: jax.Array, *, by_opacity: bool = True) -> jax.Array:
    """Entropy of where a ray ends, `-sum_i what_i log what_i` with `what = w / sum_i w_i`.

    Times the ray's opacity o (`by_opacity`): what is not there cannot be uncertain in its place.
    A ray that ends surely has the authors' value, and thin fog over an empty background, whose
    depth is anybody's guess, fades out with its opacity instead of deciding the score.

    Args:
      weights: [..., S] rendering weights >= 0, summing to at most 1.
      by_opacity: False leaves the factor out, as published.

    Returns:
      [...] in [0, log S], nats; 0 on a ray that meets nothing.

    Numerics: computed as `o log o - sum_i w_i log w_i`, whose gradient is finite and 0 at empty
    samples; rounding below 0 is clipped. Without `by_opacity` the gradient grows as 1 / o, and a
    ray of an opacity below 1e-6 counts as empty.
    """
    entropy = jnp.maximum(x_log_x(weights.sum(-1)) - x_log_x(weights).sum(-1), 0.0)
    return entropy if by_opacity else safe_divide(entropy, opacity_or_empty(weights))


def colour_variance(rgb: jax.Array) -> jax.Array:
    """How far E fields disagree on a ray's colour, `mean_c Var_k(C_kc)`.

    Args:
      rgb: [E, ..., 3] colours of the same rays in each field, in [0, 1].

    Returns:
      [...] in [0, 1/4], colour unit^2; the variance of the members themselves (divided by E).
    """
    return rgb.var(axis=0).mean(axis=-1)


def missing_density(opacity: jax.Array, *, known_background: bool = True) -> jax.Array:
    """What the members do not know for lack of any surface, `(1 - mean_k o_k)^2`, [...].

    The authors' term says that every ray should end somewhere, and where none does the field was
    never told what is there. That holds in rooms and landscapes. In front of a known background
    an empty ray is an answer: members that agree on it are certain. There the term counts in
    proportion to the largest opacity, `max_k o_k (1 - mean_k o_k)^2`: unchanged if any member
    sees a surface that others miss, and 0 if none does.

    Args:
      opacity: [E, ...] of the same rays in each field, in [0, 1].
      known_background: False for the published form, which is 1 on a ray that meets nothing.
    """
    missing = (1.0 - opacity.mean(axis=0)) ** 2
    return opacity.max(axis=0) * missing if known_background else missing


def ensemble_uncertainty(
    rgb: jax.Array, opacity: jax.Array, *, known_background: bool = True
) -> jax.Array:
    """Uncertainty of a ray by E fields, `mean_c Var_k(C) + (1 - mean_k sum_i w_ki)^2`.

    Args:
      rgb: see `colour_variance`.
      opacity, known_background: see `missing_density`.

    Returns:
      [...] >= 0; 0 where all members see the same background and nothing else, or 1 there
      without a known background.
    """
    return colour_variance(rgb) + missing_density(opacity, known_background=known_background)


def variance_reduction(
    weights: jax.Array, beta: jax.Array, *, by_opacity: bool = True
) -> jax.Array:
    """Variance along a ray that its observation would remove.

    The observation has the variance U of the rendered colour (`rendered_variance`); by Bayes' rule
    sample i keeps `1 / (1 / beta_i + w_i^2 / U)`, so the gain is

        sum_i beta_i - sum_i 1 / (1 / beta_i + w_i^2 / U)
            = sum_i beta_i^2 w_i^2 / (U + beta_i w_i^2).

    U scales with the square of the weights, hence the formula makes no difference between a wall
    and the thinnest fog. Times the ray's opacity (`by_opacity`) it is as published for rays that
    end surely, and fades out with what is there.

    Args:
      weights: [..., S] rendering weights >= 0, summing to at most 1.
      beta: [..., S] > 0, colour unit^2.
      by_opacity: False leaves the factor out, as published.

    Returns:
      [...] >= 0, colour unit^2; 0 on a ray that meets nothing.

    Numerics: the second form has no difference of near numbers, and weights enter relative to
    their sum, so that small ones do not vanish when they are squared. A ray of an opacity below
    1e-6 counts as empty.
    """
    opacity = opacity_or_empty(weights)
    share = safe_divide(weights, opacity[..., None])
    information = share * share * beta
    variance = information.sum(-1)[..., None]
    gain = safe_divide(beta * information, variance + information).sum(-1)
    return opacity * gain if by_opacity else gain


# Of a point's distance: how far behind the rendered surface it still counts as on it. A pixel of a
# reduced image covers as much of a slanted surface.
DEFAULT_TOLERANCE = 0.05


def at_nearest_pixel(image: Array, pixels: jax.Array) -> jax.Array:
    """Values of an image [H, W] at pixels [..., 2] without blending: [...].

    For depth, where a blend of two surfaces lies on neither. Pixels outside get the edge's value.
    """
    column, row = (jnp.floor(pixels[..., i]).astype(jnp.int32) for i in (0, 1))
    height, width = image.shape
    return image[jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)]


def look_at_points(
    camera: Cameras,
    points: Array,
    depth_map: Array | None = None,
    *,
    tolerance: float = DEFAULT_TOLERANCE,
) -> tuple[jax.Array, jax.Array]:
    """Whether a camera sees each point, and at which pixel.

    A point is hidden if the camera's rendered surface is nearer than it by more than the
    tolerance. Where the camera rendered nothing, it looks through the point, and so it sees it.

    Args:
      camera: one camera without the axis of views, its image as large as `depth_map`.
      points: [..., 3] scene units.
      depth_map: [H, W] distance along the ray, scene units, 0 where empty; None: nothing hides.
      tolerance: share of the point's distance, in [0, 1]; 1 lets nothing hide.

    Returns:
      is_seen [...] bool, pixels [..., 2] (0 outside of the image).
    """
    pixels, is_seen = project(camera, points)
    if depth_map is not None:
        surface = at_nearest_pixel(depth_map, pixels)
        distance = jnp.linalg.norm(points - camera.positions, axis=-1)
        is_seen &= (surface == 0.0) | (surface >= (1.0 - tolerance) * distance)
    return is_seen, pixels


def direction_novelty(
    points: jax.Array,
    directions: jax.Array,
    cameras: Cameras,
    mask: jax.Array,
    depth_maps: jax.Array | None = None,
    *,
    tolerance: float = DEFAULT_TOLERANCE,
) -> jax.Array:
    """How differently points are looked at than from any camera that sees them, [K] in [0, 1].

    `1 - (1 + max_c d_c . d) / 2`, the squared sine of half the angle to the nearest direction
    from which the point is seen: 0 if it is seen from just there, 1/2 at a right angle, 1 from the
    opposite side, and 1 where no camera sees it. Composited along a ray over a floor of 0
    (`sum_i w_i value_i`), a ray that meets nothing is worth 0.

    Args:
      points: [K, 3] scene units.
      directions: [K, 3] unit, in which each point is looked at: from the camera to the point.
      cameras: V cameras.
      mask: [V] bool, which of them count; the others cost nothing.
      depth_maps: [V, H, W] rendered distances along the rays of `cameras`, whose images must be of
        that size, 0 where empty; with them a camera does not see what is hidden from it.
      tolerance: see `look_at_points`.

    Numerics: computed as `min_c |d - d_c|^2 / 4`, exact for near directions.
    """

    def apart_from(camera, depth_map):
        is_seen, _ = look_at_points(camera, points, depth_map, tolerance=tolerance)
        difference = directions - directions_from(camera, points)
        return jnp.where(is_seen, 0.25 * (difference * difference).sum(-1), 1.0)

    never_seen = jnp.ones(points.shape[:-1], points.dtype)
    return least_over_cameras(apart_from, never_seen, mask, (cameras, depth_maps))


def directions_from(camera: Cameras, points: Array) -> jax.Array:
    """Unit directions [..., 3] from one camera to points [..., 3]; 0 for a point on it."""
    return unit_vectors(points - camera.positions)


def least_over_cameras(
    value_fn: Callable[..., jax.Array], start: jax.Array, mask: Array, sources: tuple
) -> jax.Array:
    """The least of `start` [K] and of the values [K] for each marked camera.

    One camera after the other: memory does not grow with V, and those not marked cost nothing.

    Args:
      value_fn: values [K] from one camera's part of the sources.
      start: [K].
      mask: [V] bool, which cameras count.
      sources: arrays [V, ...], `Cameras` among them, or None.
    """

    def add_camera(least, source):
        is_used, parts = source
        return jax.lax.cond(
            is_used, lambda x: jnp.minimum(x, value_fn(*parts)), lambda x: x, least
        ), None

    return jax.lax.scan(add_camera, start, (mask, sources))[0]


# From a state of training and view ids [n], the mean squared errors [n] of renders of these views.
TrueErrorFn = Callable[[TrainState, np.ndarray], np.ndarray]


def make_true_error_fn(
    render_fn: Callable[[TrainState], RenderChunk], scene: Scene, *, image_scale: float, chunk: int
) -> TrueErrorFn:
    """Makes the mean squared colour error of renders against the photos themselves.

    Args:
      render_fn: from a state of training, what renders "rgb" of `chunk` rays.
      scene: the scene with its photos.
      image_scale: of width and height; photos are reduced by the mean over areas.
      chunk: rays of one compiled call.
    """

    def true_error(state, view_ids):
        view_ids = np.asarray(view_ids)
        small = reduced_cameras(take(scene.cameras, view_ids), image_scale)
        chunk_fn = render_fn(state)
        rows = np.arange(len(view_ids))
        images = render_views(lambda rays: {"rgb": chunk_fn(rays)["rgb"]}, small, rows, chunk=chunk)
        errors = []
        for view, image in zip(view_ids, images):
            height, width = image["rgb"].shape[:2]
            photo = Image.fromarray(scene.image(view)).resize((width, height), Image.Resampling.BOX)
            errors.append(np.square(image["rgb"] - np.asarray(photo) / 255.0).mean())
        return np.array(errors, np.float32)

    return true_error
