"""Image files to arrays: reading, area-averaged down-scaling, compositing over a background.

Pixels are taken as they are stored, whatever a file's EXIF orientation says: that is how COLMAP
and nerfstudio read them, so their poses and intrinsics belong to the stored pixels. Such files are
named in a warning (`look_over`), since poses from elsewhere may belong to the turned picture.
"""

import contextlib
import hashlib
import os
import pathlib
import warnings
from collections import defaultdict
from collections.abc import Iterator, Sequence

import imageio.v3 as iio
import numpy as np
from PIL import Image

from bavs_jax.scenes.base import SceneError, printable
from bavs_jax.scenes.texts import is_file, one_line

# What a name without a suffix may mean; some cameras write capitals.
SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")  # of what counts as an image in a folder
# Pillow knows many more, and some of them start other programs (EPS: Ghostscript),
# and turns TIFF by its orientation.
FORMATS = ("PNG", "JPEG", "WEBP", "BMP")
MAX_PIXELS = 100_000_000  # of one image
MODES = ("1", "L", "LA", "P", "RGB", "RGBA", "I;16", "I")
STRIP = 1 << 21  # pixels in float64 at a time
ORIENTATION = 0x0112  # the tag's number in EXIF
NAMES_IN_WARNING = 3


def find_image(root: pathlib.Path, file_path: str) -> pathlib.Path | None:
    """The image that a frame's `file_path` means, or None.

    The name itself, else with a suffix added, else with its own suffix in the other case.
    """
    stem, suffix = pathlib.PurePosixPath(file_path), pathlib.PurePosixPath(file_path).suffix
    names = [f"{file_path}{added}" for added in SUFFIXES]
    if suffix:
        names += [str(stem.with_suffix(s)) for s in (suffix.lower(), suffix.upper())]
    paths = [root / name for name in names]
    found = next((path for path in paths if is_file(path)), None)
    if found is None and (folder := next((path for path in paths if os.path.isdir(path)), None)):
        raise SceneError(f"{folder}: is a folder: put an image file in its place")
    return found


def list_images(folder: pathlib.Path) -> list[pathlib.Path]:
    """The image files of a folder, sorted by name."""
    files = sorted(f for f in folder.iterdir() if f.suffix.lower() in IMAGE_SUFFIXES)
    if not files:
        raise SceneError(f"{folder}: holds no images: add them as PNG or JPEG")
    return files


@contextlib.contextmanager
def open_image(path: pathlib.Path) -> Iterator[Image.Image]:
    """An image file whose header is read and whose pixels are not decoded yet.

    Raises:
      SceneError: the file is missing, damaged, of a format that is not one of `FORMATS`, of more
        than `MAX_PIXELS` or of several pictures; or what the block does with it fails.
    """
    if not is_file(path):
        raise SceneError(f"{path}: image is missing: add the file or remove its frame")
    try:
        with warnings.catch_warnings():
            # Of large images, which are bounded here, and of odd tags, which are not read.
            warnings.filterwarnings("ignore", module=r"PIL\.")
            with Image.open(path, formats=FORMATS) as image:
                check_extent(image, path)
                yield image
    except SceneError:
        raise
    except Image.DecompressionBombError as error:
        raise SceneError(
            f"{path}: image cannot be read ({one_line(error)}): reduce it to "
            f"{MAX_PIXELS // 10**6} million pixels"
        ) from error
    except Image.UnidentifiedImageError as error:
        raise SceneError(
            f"{path}: image cannot be read (it is none of {', '.join(FORMATS)}): "
            "save it again as PNG or JPEG"
        ) from error
    except Exception as error:  # of many kinds: Pillow lets through what its decoders raise
        raise SceneError(
            f"{path}: image cannot be read ({one_line(error)}): save it again"
        ) from error


def check_extent(image: Image.Image, path: pathlib.Path) -> None:
    """An image must be a single picture of at most `MAX_PIXELS`."""
    width, height = image.size
    if width * height > MAX_PIXELS:
        raise SceneError(
            f"{path}: image is {width} x {height}, {width * height / 1e6:.0f} million pixels: "
            f"reduce it to {MAX_PIXELS // 10**6}"
        )
    num = getattr(image, "n_frames", 1)
    if num > 1 and image.format != "MPO":  # a phone's JPEG, whose first picture is the photo
        raise SceneError(
            f"{path}: image holds {num} pictures, as an animation does: save one of them"
        )


def decode(path: pathlib.Path) -> np.ndarray:
    """An image file's values as they are stored, of a colour model that is known."""
    with open_image(path) as image:
        if image.mode not in MODES:
            raise SceneError(
                f"{path}: image has colour model {image.mode}: save it as 8-bit RGB or RGBA"
            )
        mode = image.mode
        if mode == "P":  # imageio fails at palettes with transparency
            values = np.array(image.convert("RGBA" if image.has_transparency_data else "RGB"))
        else:
            values = iio.imread(path, index=0, plugin="pillow")  # of a phone's MPO the photo
    if values.dtype == bool:
        return values.astype(np.uint8) * 255
    if mode == "I" and values.min() >= 0 and values.max() < 1 << 16:  # 16-bit PNG in older Pillow
        return values.astype(np.uint16)
    return values


def read_image(path: pathlib.Path) -> np.ndarray:
    """Reads an image file as straight sRGB values, its pixels as they are stored.

    Args:
      path: a file in one of `FORMATS`.

    Returns:
      [H, W, C] uint8 with C = 3, or 4 where the file has alpha.

    Raises:
      SceneError: see `open_image`; or values that are no 8-bit or 16-bit colour.
    """
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
    """Width and height of an image file in pixels as they are stored, from its header alone."""
    with open_image(path) as image:
        return image.size


def orientation(path: pathlib.Path) -> int:
    """How a viewer would turn an image, by its EXIF tag: 1 to 8; 1, upright, where it has none."""
    with open_image(path) as image:
        if image.format == "PNG" and "exif" not in image.info:
            return 1  # Pillow would decode all of it to look for a tag at the end
        try:
            value = image.getexif().get(ORIENTATION, 1)
        except Exception:  # a damaged block of EXIF says nothing of the pixels
            return 1
    return value if value in range(1, 9) else 1


def look_over(files: Sequence[pathlib.Path], root: pathlib.Path, path: pathlib.Path) -> None:
    """Warns of photos that carry an EXIF orientation, and of photos that are copies of others.

    Args:
      path: what gives their poses, for messages.
    """
    names = {file: os.path.relpath(file, root) for file in files}
    turned = [names[file] for file in files if orientation(file) != 1]
    if turned:
        warn(
            f"{path}: {len(turned)} of {len(files)} photos have an EXIF orientation "
            f"({some_names(turned)}): it is not applied, as in COLMAP and nerfstudio; if the poses "
            "belong to the turned pictures, turn the files' pixels"
        )
    same = [f"{names[first]} = {names[second]}" for first, second in copies(files)]
    if same:
        warn(
            f"{path}: {len(same)} of {len(files)} photos are copies of others "
            f"({some_names(same)}): each counts as a view of its own; remove one of each pair"
        )


def copies(files: Sequence[pathlib.Path]) -> list[tuple[pathlib.Path, pathlib.Path]]:
    """Pairs of files with the same content: each later one with the first."""
    by_size: defaultdict[int, list[pathlib.Path]] = defaultdict(list)
    first: dict[bytes, pathlib.Path] = {}
    pairs: list[tuple[pathlib.Path, pathlib.Path]] = []
    for file in files:
        by_size[file.stat().st_size].append(file)
    for group in by_size.values():
        for file in group if len(group) > 1 else ():
            with file.open("rb") as content:
                digest = hashlib.file_digest(content, "sha256").digest()
            if first.setdefault(digest, file) != file:
                pairs.append((first[digest], file))
    return pairs


def some_names(names: list[str]) -> str:
    """The first few of some names."""
    more = ", ..." if len(names) > NAMES_IN_WARNING else ""
    return ", ".join(names[:NAMES_IN_WARNING]) + more


def warn(message: str) -> None:
    """A warning of one line, whatever the names of files hold."""
    warnings.warn(printable(message), stacklevel=3)


def box_filter(image: np.ndarray, size: int) -> np.ndarray:
    """Averages over equal intervals of the first axis: [n, ...] to [size, ...] float64, size <= n.

    Output i is the mean over `[i, i + 1] n / size` of the step function that the n inputs are,
    taken as a difference of its integral.
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
    """Down-scales by exact area averaging, for any ratio, to [height, width, C] float64.

    Args:
      image: [H, W, C] values that may be averaged; colour must be premultiplied by alpha.
      width: at most W, pixels.
      height: at most H, pixels.
    """
    if image.shape[:2] == (height, width):
        return image.astype(np.float64)
    return box_filter(box_filter(image, height).swapaxes(0, 1), width).swapaxes(0, 1)


def nearest_resize(
    image: np.ndarray, width: int, height: int, *, part=((0.0, 0.0), (1.0, 1.0))
) -> np.ndarray:
    """Down-scales by taking the sample at each new pixel's centre.

    Right for depth, where an average across a silhouette lies on neither surface. A centre that
    falls between two samples takes the one to the right or below.

    Args:
      image: [H, W, ...].
      width, height: of the result, pixels.
      part: [2, 2] the corners of what is taken, as shares of the image's width and height.
    """
    low, extent = np.asarray(part)[0], np.diff(part, axis=0)[0]
    samples = [
        ((low[axis] * num + (np.arange(num) + 0.5) * extent[axis]) * size / num).astype(int)
        for axis, (num, size) in enumerate(((width, image.shape[1]), (height, image.shape[0])))
    ]
    return image[samples[1][:, None], samples[0][None, :]]


def strips(num: int, across: int) -> list[slice]:
    """Slices of `num` rows, each `across` pixels long, that hold some `STRIP` pixels each."""
    step = max(STRIP // across, 1)
    return [slice(start, min(start + step, num)) for start in range(0, num, step)]


def premultiplied(image: np.ndarray) -> np.ndarray:
    """[H, W, 3 or 4] uint8 as float64 in [0, 1], colour times alpha where there is alpha."""
    values = image / 255.0
    if image.shape[-1] == 4:
        for channel in range(3):  # three times as fast as all at once
            values[..., channel] *= values[..., 3]
    return values


def shrink_over(
    image: np.ndarray, width: int, height: int, background
) -> tuple[np.ndarray, np.ndarray | None]:
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

    Numerics: float64 in strips of columns, then of rows; a whole photo would take 32 bytes a pixel.
    """
    same = image.shape[:2] == (height, width)
    if not same:  # in the order of `area_resize`
        short = np.empty((height, *image.shape[1:]))
        for columns in strips(image.shape[1], image.shape[0]):
            short[:, columns] = box_filter(premultiplied(image[:, columns]), height)
    parts = []
    for rows in strips(height, image.shape[1]):
        if same:
            values = premultiplied(image[rows])
        else:
            values = box_filter(short[rows].swapaxes(0, 1), width).swapaxes(0, 1)
        if image.shape[-1] == 4:
            values[..., :3] += (1.0 - values[..., 3:]) * np.asarray(background)
        parts.append(np.rint(np.clip(values, 0.0, 1.0) * 255.0).astype(np.uint8))
    small = np.concatenate(parts)
    return small[..., :3], small[..., 3] if image.shape[-1] == 4 else None
