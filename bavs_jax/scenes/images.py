"""Image files to arrays: reading, area-averaged down-scaling, compositing over a background."""

from __future__ import annotations

import pathlib

import imageio.v3 as iio
import numpy as np

from bavs_jax.scenes.base import SceneError

SUFFIXES = ("", ".png", ".jpg", ".jpeg")  # file_path is mostly written without one


def find_image(root: pathlib.Path, file_path: str) -> pathlib.Path | None:
    """The image that a frame's `file_path` means, or None."""
    for suffix in SUFFIXES:
        path = root / f"{file_path}{suffix}"
        if path.is_file():
            return path
    return None


def read_image(path: pathlib.Path) -> np.ndarray:
    """Reads an image file as straight sRGB values.

    Args:
      path: a PNG, JPEG or other format that imageio reads.

    Returns:
      [H, W, C] uint8 with C = 3, or 4 where the file has alpha.

    Raises:
      SceneError: the file is missing, damaged or of an unknown format.
    """
    if not path.is_file():
        raise SceneError(f"{path}: image is missing: add the file or remove its frame")
    try:
        image = iio.imread(path, plugin="pillow")
    except (OSError, SyntaxError, ValueError) as error:  # what Pillow raises on damaged files
        raise SceneError(f"{path}: image cannot be read ({error}): save it again") from error
    if image.dtype == np.uint16:
        image = (image // 257).astype(np.uint8)
    if image.ndim == 2:
        image = image[..., None]
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[-1] not in (1, 2, 3, 4):
        raise SceneError(
            f"{path}: image has shape {image.shape} of {image.dtype}: save it as 8-bit RGB or RGBA"
        )
    if image.shape[-1] <= 2:  # grey, or grey with alpha
        grey, alpha = image[..., :1], image[..., 1:]
        image = np.concatenate([grey, grey, grey, alpha], axis=-1)
    return image


def image_size(path: pathlib.Path) -> tuple[int, int]:
    """Width and height of an image file in pixels, from its header alone."""
    if not path.is_file():
        raise SceneError(f"{path}: image is missing: add the file or remove its frame")
    try:
        height, width = iio.improps(path, plugin="pillow").shape[:2]
    except (OSError, SyntaxError, ValueError) as error:
        raise SceneError(f"{path}: image cannot be read ({error}): save it again") from error
    return width, height


def box_weights(size_in: int, size_out: int) -> np.ndarray:
    """How much each input pixel counts in each output pixel, along one axis.

    Output pixel i covers the interval `[i, i + 1] size_in / size_out`; its weights are the shares
    of that interval that fall onto each input pixel, so each row sums to 1.

    Args:
      size_in: pixels before, at least `size_out`.
      size_out: pixels after, at least 1.

    Returns:
      [size_out, size_in] float32.
    """
    if not 1 <= size_out <= size_in:
        raise ValueError(f"cannot box filter {size_in} pixels to {size_out}: only shrinking works")
    edges = np.arange(size_out + 1) * (size_in / size_out)
    pixel = np.arange(size_in)
    upper = np.minimum(edges[1:, None], pixel + 1)
    lower = np.maximum(edges[:-1, None], pixel)
    overlap = np.maximum(upper - lower, 0.0)
    return (overlap * (size_out / size_in)).astype(np.float32)


def area_resize(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Down-scales by exact area averaging, for any ratio.

    Args:
      image: [H, W, C] values that may be averaged; colour must be premultiplied by alpha.
      width: at most W, pixels.
      height: at most H, pixels.

    Returns:
      [height, width, C] float32.
    """
    image = image.astype(np.float32)
    if image.shape[:2] == (height, width):
        return image
    rows, columns = box_weights(image.shape[0], height), box_weights(image.shape[1], width)
    # Two plain matrix products; einsum would not use BLAS for the three-index operand.
    image = (rows @ image.reshape(image.shape[0], -1)).reshape(height, *image.shape[1:])
    return np.matmul(columns, image)


def nearest_resize(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Down-scales by taking the sample at each new pixel's centre.

    Right for depth, where an average across a silhouette lies on neither surface. A centre that
    falls between two samples takes the one to the right or below.
    """
    row = ((np.arange(height) + 0.5) * image.shape[0] / height).astype(int)
    column = ((np.arange(width) + 0.5) * image.shape[1] / width).astype(int)
    return image[row[:, None], column[None, :]]


def shrink_over(image: np.ndarray, width: int, height: int, background) -> np.ndarray:
    """An image at a smaller size over a background colour, as it enters the pixel table.

    Colour is premultiplied by alpha before it is averaged, so that the colour of invisible pixels
    never counts: `sum a c / n + (1 - sum a / n) background`, all in sRGB values.

    Args:
      image: [H, W, 3 or 4] uint8, straight alpha.
      width: at most W, pixels.
      height: at most H, pixels.
      background: [3] sRGB in [0, 1]; unused where there is no alpha.

    Returns:
      [height, width, 3] uint8, rounded to nearest.
    """
    values = image.astype(np.float32) / 255.0
    if image.shape[-1] == 3:
        colour = area_resize(values, width, height)
    else:
        alpha = values[..., 3:]
        premultiplied = np.concatenate([values[..., :3] * alpha, alpha], axis=-1)
        small = area_resize(premultiplied, width, height)
        colour = small[..., :3] + (1.0 - small[..., 3:]) * np.asarray(background, np.float32)
    return np.rint(np.clip(colour, 0.0, 1.0) * 255.0).astype(np.uint8)
