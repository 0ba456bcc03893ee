"""Lens models by the names that files give them, and intrinsics at the size of an image."""

import pathlib

from bavs_jax.scenes import checks, images
from bavs_jax.scenes.base import SceneError

COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")  # in the order of `Cameras.distortion`
# A model's name in COLMAP and nerfstudio: the lens of `lenses.LENSES`, and its coefficients in the
# order of COLMAP's parameters, after focal lengths and centre.
MODELS = {
    "SIMPLE_PINHOLE": ("pinhole", ()),
    "PINHOLE": ("pinhole", ()),
    "SIMPLE_RADIAL": ("opencv", ("k1",)),
    "RADIAL": ("opencv", ("k1", "k2")),
    "OPENCV": ("opencv", ("k1", "k2", "p1", "p2")),
    "FULL_OPENCV": ("opencv", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", ("k1",)),
    "RADIAL_FISHEYE": ("fisheye", ("k1", "k2")),
    "OPENCV_FISHEYE": ("fisheye", ("k1", "k2", "k3", "k4")),
}


def common_lens(lenses: list[str], names: list[str], path: pathlib.Path) -> str:
    """One lens that serves all views of a capture.

    A pinhole is an opencv lens without distortion, so these may be mixed; a fisheye may not.

    Args:
      lenses: [V] keys of `lenses.LENSES`.
      names: [V] how to call the views in messages.
      path: the file that gives the lenses.

    Raises:
      SceneError: fisheyes are mixed with other lenses.
    """
    fisheyes = [name for name, lens in zip(names, lenses) if lens == "fisheye"]
    others = [name for name, lens in zip(names, lenses) if lens != "fisheye"]
    if fisheyes and others:
        fewer, kind = (
            (others, "no fisheye") if len(others) < len(fisheyes) else (fisheyes, "fisheye")
        )
        listed = images.some_names(fewer)
        raise SceneError(
            f"{path}: camera_model: {len(fewer)} of {len(names)} views are {kind} ({listed}) and "
            "the rest is not: load each lens as a capture of its own"
        )
    return "fisheye" if fisheyes else "opencv" if "opencv" in lenses else "pinhole"


def check_fisheye(distortion: list[float], path: pathlib.Path, field: str) -> None:
    """A fisheye has no tangential coefficients."""
    for name, value in zip(COEFFICIENTS[4:], distortion[4:]):
        if value != 0.0:
            raise SceneError(
                f"{path}: {field}{name}: is {value:g}, which a fisheye does not have: make it 0"
            )


def fit_to_image(
    intrinsics, stated, size: tuple[int, int], image_path: pathlib.Path, path: pathlib.Path
) -> list[float]:
    """`fx, fy, cx, cy` for an image of `size`, from those for the stated (width, height).

    Raises:
      SceneError: the proportions differ by over a pixel.
    """
    checks.check_proportions(size, stated, image_path, path)
    scale_x, scale_y = size[0] / stated[0], size[1] / stated[1]
    fx, fy, cx, cy = intrinsics
    return [fx * scale_x, fy * scale_y, cx * scale_x, cy * scale_y]
