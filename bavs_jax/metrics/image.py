"""Image and depth measures: PSNR, SSIM and depth errors."""

import functools
import operator

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.arrays import Array
from bavs_jax.metrics.perceptual import LpipsFn, check_images

SSIM_TAPS = 11  # pixels, the window of Wang et al. 2004
SSIM_SIGMA = 1.5  # pixels
SSIM_K1, SSIM_K2 = 0.01, 0.03


def quantise_uint8(image: Array) -> jax.Array:
    """What is left of an image once it is saved with 8 bits: `round(255 clip(image, 0, 1)) / 255`.

    Published numbers are measured on saved files (nerfbaselines' protocol), hence also these.
    The image [...] is sRGB, nominally in [0, 1].
    """
    return jnp.round(255.0 * jnp.clip(image, 0.0, 1.0)) / 255.0


def psnr(prediction: Array, truth: Array, mask: Array | None = None) -> jax.Array:
    """Peak signal-to-noise ratio for a data range of 1: `-10 log10(mean (prediction - truth)^2)`.

    Args:
      prediction, truth: [..., H, W, 3] in [0, 1].
      mask: [..., H, W] bool, the pixels that the mean is over; None for all.

    Returns:
      [...] dB; infinite where the two are identical, NaN where no pixel counts.

    Raises:
      ValueError: the shapes differ or are not those of images.
    """
    check_images(prediction, truth)
    where = None if mask is None else mask[..., None]
    mse = jnp.mean(jnp.square(prediction - truth), axis=(-3, -2, -1), where=where)
    return -10.0 * jnp.log10(mse)


def ssim(prediction: jax.Array, truth: jax.Array) -> jax.Array:
    """Structural similarity (Wang et al. 2004): agreement of local mean, contrast and structure.

    `(2 mx my + C1) (2 vxy + C2) / ((mx^2 + my^2 + C1) (vxx + vyy + C2))` with the means `m` and
    (co)variances `v` under an 11 x 11 Gaussian window of sigma 1.5 pixels, `C1 = 0.01^2`,
    `C2 = 0.03^2`; averaged over channels and over the pixels whose window lies inside of the image.

    Args:
      prediction, truth: [..., H, W, 3] in [0, 1].

    Returns:
      [...] in [-1, 1]; 1 where the two are identical.

    Raises:
      ValueError: the shapes differ, or a side is shorter than the window.

    *Numerics*: (co)variances do not change when a constant is taken off, and `E[x^2] - E[x]^2`
    cancels least near 0, so they are computed about mid-grey.
    """
    check_images(prediction, truth)
    if min(truth.shape[-3:-1]) < SSIM_TAPS:
        raise ValueError(
            f"image: {truth.shape[-2]} x {truth.shape[-3]} pixels are fewer than SSIM's window of "
            f"{SSIM_TAPS} x {SSIM_TAPS}; measure larger images"
        )
    c1, c2 = SSIM_K1**2, SSIM_K2**2
    x, y = prediction - 0.5, truth - 0.5
    mean_x, mean_y = _window_mean(x), _window_mean(y)
    var_x = _window_mean(x * x) - mean_x**2
    var_y = _window_mean(y * y) - mean_y**2
    cov_xy = _window_mean(x * y) - mean_x * mean_y
    mean_x, mean_y = mean_x + 0.5, mean_y + 0.5
    luminance = (2.0 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    structure = (2.0 * cov_xy + c2) / (var_x + var_y + c2)
    return jnp.mean(luminance * structure, axis=(-3, -2, -1))


def measure_images(
    prediction: Array, truth: Array, *, mask: Array | None = None, lpips_fn: LpipsFn | None = None
) -> dict[str, jax.Array | None]:
    """All image measures by the 8-bit protocol: both images are quantised, then compared.

    Args:
      prediction: [..., H, W, 3] sRGB as rendered.
      truth: [..., H, W, 3] sRGB in [0, 1].
      mask: [..., H, W] bool, the pixels that count; None for all. The others leave the PSNR's
        mean; SSIM and LPIPS, which look at neighbourhoods, see the true colour there.
      lpips_fn: from `perceptual.make_lpips_fn`, or None where it is not installed.

    Returns:
      `psnr` [...] dB, `ssim` [...], and `lpips` [...], None without `lpips_fn`.

    Raises:
      ValueError: as `ssim`.
    """
    prediction, truth = quantise_uint8(prediction), quantise_uint8(truth)
    if mask is not None:
        prediction = jnp.where(mask[..., None], prediction, truth)
    return {
        "psnr": psnr(prediction, truth, mask),
        "ssim": ssim(prediction, truth),
        "lpips": None if lpips_fn is None else lpips_fn(prediction, truth),
    }


def match_exposure(
    prediction: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None
) -> np.ndarray:
    """A prediction with the gain and offset of each channel that suit the truth's exposure.

    A view that was not trained on has no code for its own exposure. Those of the left half of the
    image are fitted by least squares on the right half, and the other way round, so that no pixel
    has a part in its own fit. (Martin-Brualla et al. 2021 fit a code on the left half and measure
    the right one.)

    Args:
      prediction, truth: [H, W, 3] sRGB in [0, 1].
      mask: [H, W] bool, the pixels that are fitted; None for all.

    Returns:
      [H, W, 3]; a half whose counterpart has no pixel to fit stays as it is, and a counterpart of
      one colour alone gives the offset only.
    """
    check_images(prediction, truth)
    matched = np.array(prediction, np.float64)
    middle = truth.shape[1] // 2
    halves = (slice(None, middle), slice(middle, None))
    for half, other in (halves, halves[::-1]):
        fitted = np.ones(truth[:, other].shape[:2], bool) if mask is None else mask[:, other]
        if not fitted.any():
            continue
        x = np.asarray(prediction, np.float64)[:, other][fitted]
        y = np.asarray(truth, np.float64)[:, other][fitted]
        mean_x, mean_y, variance = x.mean(0), y.mean(0), x.var(0)
        covariance = ((x - mean_x) * (y - mean_y)).mean(0)
        gain = np.where(variance > 1e-8, covariance / np.maximum(variance, 1e-8), 1.0)
        matched[:, half] = gain * (matched[:, half] - mean_x) + mean_y
    return matched


def _window_mean(image: jax.Array) -> jax.Array:
    """Gaussian-weighted mean over each whole window, [..., H - 10, W - 10, 3]."""
    offsets = np.arange(SSIM_TAPS) - SSIM_TAPS // 2
    weights = np.exp(-0.5 * (offsets / SSIM_SIGMA) ** 2)
    weights = weights / weights.sum()
    # Two passes of shifted sums: a convolution would lose digits to TF32 on some accelerators.
    for axis in (-3, -2):
        length = image.shape[axis] - SSIM_TAPS + 1
        shifted = (
            float(weight) * jax.lax.slice_in_dim(image, i, i + length, axis=axis)
            for i, weight in enumerate(weights)
        )
        image = functools.reduce(operator.add, shifted)
    return image


def depth_mae(depth: jax.Array, true_depth: jax.Array) -> jax.Array:
    """Mean absolute depth error over the pixels whose true depth is known.

    `sum_p known_p |depth_p - true_depth_p| / sum_p known_p` with `known_p = true_depth_p > 0`:
    a scene writes 0 where a ray hits nothing or was not measured.

    Args:
      depth: [..., H, W] rendered distance along the unit ray, scene units.
      true_depth: [..., H, W] true distance along the unit ray, scene units, 0 where unknown.

    Returns:
      [...] scene units; NaN where no pixel of an image has a known depth.

    Raises:
      ValueError: the shapes differ.
    """
    if depth.shape != true_depth.shape:
        raise ValueError(
            f"depth: rendered {depth.shape} and true {true_depth.shape} must have one shape"
        )
    known = true_depth > 0.0
    error = jnp.where(known, jnp.abs(depth - true_depth), 0.0)
    return error.sum(axis=(-2, -1)) / known.sum(axis=(-2, -1))
