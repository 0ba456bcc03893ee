"""Image files to arrays: reading, area-averaged down-scaling, compositing over a background."""

from __future__ import annotations

import pathlib

import imageio.v3 as iio
import numpy as np
from PIL import Image

from bavs_jax.scenes.base import SceneError

# What a name without a suffix may mean; some cameras write capitals.
SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")  # of what counts as an image in a folder
# What Pillow raises on damaged files, and on images of absurd size.
DAMAGE = (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError)
MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "I;16", "I;16B", "I")


def find_image(root: pathlib.Path, file_path: str) -> pathlib.Path | None:
    """The image that a frame's `file_path` means, or None."""
    for suffix in SUFFIXES:
        path = root / f"{file_path}{suffix}"
        if path.is_file():
            return path
    for suffix in SUFFIXES:
        path = root / f"{file_path}{suffix}"
        if path.is_dir():
            raise SceneError(f"{path}: is a folder: put an image file in its place")
    return None


def list_images(folder: pathlib.Path) -> list[pathlib.Path]:
    """The image files of a folder, sorted by name."""
    files = sorted(f for f in folder.iterdir() if f.suffix.lower() in IMAGE_SUFFIXES)
    if not files:
        raise SceneError(f"{folder}: holds no images: add them as PNG or JPEG")
    return files


def one_line(error: Exception) -> str:
    """A foreign error's message without its line breaks."""
    return " ".join(str(error).split())


def decode(path: pathlib.Path) -> np.ndarray:
    """An image file's values as they are stored, of a colour model that is known."""
    try:
        with iio.imopen(path, "r", plugin="pillow") as file:
            mode = file.metadata(exclude_applied=False).get("mode")
            image = file.read()
    except DAMAGE as error:
        raise SceneError(
            f"{path}: image cannot be read ({one_line(error)}): save it again"
        ) from error
    if mode not in MODES:
        raise SceneError(f"{path}: image has colour model {mode}: save it as 8-bit RGB or RGBA")
    if image.dtype == bool:
        return image.astype(np.uint8) * 255
    if mode == "I" and image.min() >= 0 and image.max() < 1 << 16:  # 16-bit PNG in older Pillow
        return image.astype(np.uint16)
    return image


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
    image = decode(path)
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
    except DAMAGE as error:
        raise SceneError(
            f"{path}: image cannot be read ({one_line(error)}): save it again"
        ) from error
    return width, height


def box_filter(image: np.ndarray, size: int) -> np.ndarray:
    """Averages along the first axis over equal intervals, for any ratio.

    Output i is the mean over `[i, i + 1] n / size` of the step function that the n inputs are,
    taken as a difference of its integral.

    Args:
      image: [n, ...].
      size: from 1 to n.

    Returns:
      [size, ...] float64.
    """
    num = image.shape[0]
    if not 1 <= size <= num:
        raise ValueError(f"cannot box filter {num} pixels to {size}: only shrinking works")
    integral = np.zeros((num + 1, *image.shape[1:]))
    for row in range(num):  # ten times as fast as np.cumsum along a first axis
        np.add(integral[row], image[row], out=integral[row + 1])
    edges = np.arange(size + 1) * num / size
    below = np.minimum(edges.astype(int), num - 1)
    part = (edges - below).reshape(-1, *[1] * (image.ndim - 1))
    at_edges = (1.0 - part) * integral[below] + part * integral[below + 1]
    return np.diff(at_edges, axis=0) * (size / num)


def area_resize(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Down-scales by exact area averaging, for any ratio.

    Args:
      image: [H, W, C] values that may be averaged; colour must be premultiplied by alpha.
      width: at most W, pixels.
      height: at most H, pixels.

    Returns:
      [height, width, C] float64.
    """
    if image.shape[:2] == (height, width):
        return image.astype(np.float64)
    return box_filter(box_filter(image, height).swapaxes(0, 1), width).swapaxes(0, 1)


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
      [height, width, 3] uint8, rounded to nearest, and where there is alpha the opacity
      [height, width] uint8, else None.
    """
    values = image / 255.0
    if image.shape[-1] == 3:
        return _as_bytes(area_resize(values, width, height)), None
    values[..., :3] *= values[..., 3:]
    small = area_resize(values, width, height)
    colour = small[..., :3] + (1.0 - small[..., 3:]) * np.asarray(background)
    return _as_bytes(colour), _as_bytes(small[..., 3])


def _as_bytes(values: np.ndarray) -> np.ndarray:
    return np.rint(np.clip(values, 0.0, 1.0) * 255.0).astype(np.uint8)
