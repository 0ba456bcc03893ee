"""Scenes in the layout of NeRF-synthetic: `transforms_{train,test}.json` and RGBA images."""

import math
import pathlib

import numpy as np

from bavs_jax.scenes import checks, images, texts
from bavs_jax.scenes.base import Scene, SceneError, alpha_table, pixel_table, printable
from bavs_jax.scenes.zoom import Zoom, check_zoom, cut, magnifications, photo_windows

BOX_HALF_SIDE = 1.5  # scene units; the objects of this data set fit into it
NEAR, FAR = 2.0, 6.0  # scene units
DEPTH_RANGE = 8.0  # scene units that the 8 bits of a depth image span


def find_depth(image_path: pathlib.Path) -> pathlib.Path | None:
    """The depth image `<name>_depth*.png` that lies beside an image, or None."""
    return min(image_path.parent.glob(f"{image_path.stem}_depth*.png"), default=None)


def decode_depth(values: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Distance [H, W] along the ray, `8 (1 - v / 255)`, 0 where value or opacity, uint8, is 0."""
    depth = DEPTH_RANGE * (1.0 - values.astype(np.float32) / 255.0)
    return np.where((values > 0) & (alpha > 0), depth, np.float32(0.0))


def load_depth(
    image_path: pathlib.Path, image: np.ndarray, size, window: np.ndarray
) -> np.ndarray | None:
    """One view's depth [H, W] at `size` (width, height), or None where it has no file.

    It is that of the part of the image that a window (see `zoom.photo_windows`) shows.
    """
    path = find_depth(image_path)
    if path is None:
        return None
    values = images.read_image(path)[..., 0]
    checks.check_image_size(
        values.shape[::-1], (image.shape[1], image.shape[0]), path, image_path.name
    )
    alpha = image[..., 3] if image.shape[-1] == 4 else np.full_like(values, 255)
    return images.nearest_resize(cut(decode_depth(values, alpha), window), *size)


def load_split(
    root: pathlib.Path,
    split: str,
    *,
    image_size,
    background,
    strict: bool,
    zoom: Zoom | None,
    first: int = 0,
) -> dict:
    """Loads one `transforms_<split>.json`: a dict of lists with one entry per view.

    `first` is the number of the split's first view; for the rest see `load_blender`.
    """
    path = root / f"transforms_{split}.json"
    data = texts.read_json(path)
    frames = checks.check_frames(data, path)
    angle = checks.check_number(data.get("camera_angle_x"), path, "camera_angle_x", positive=True)
    if angle >= math.pi:
        raise SceneError(f"{path}: camera_angle_x: is {angle}: give radians below pi")
    for index, frame in enumerate(frames):
        checks.check_inside(root, frame["file_path"], path, f"frames[{index}].file_path")
    found = [images.find_image(root, frame["file_path"]) for frame in frames]
    kept = checks.keep_existing(frames, found, path, strict=strict)
    files = checks.existing(found)

    fields = ("poses", "intrinsics", "images", "depths", "files", "names", "sizes")
    views: dict[str, list] = {field: [] for field in fields}
    original = None
    for index, ratio in zip(kept, magnifications(zoom, len(kept), first)):
        field = f"frames[{index}].transform_matrix"
        views["poses"].append(checks.check_pose(frames[index].get("transform_matrix"), path, field))
        image = images.read_image(files[index])
        height, width = image.shape[:2]
        original = original or (width, height)
        checks.check_image_size((width, height), original, files[index], "the split's first image")

        new_width = checks.check_target_width(image_size, width, files[index])
        if zoom is not None:
            check_zoom(zoom, new_width / width, width, files[index])
        (window,) = photo_windows([(width, height)], [ratio])
        size = (new_width, max(round(height * new_width / width), 1))
        views["images"].append(images.shrink_over(cut(image, window), *size, background))
        views["depths"].append(load_depth(files[index], image, size, window))
        scale = size / (window[1] - window[0])
        focal = 0.5 * width / math.tan(0.5 * angle)  # pixels are square in the original
        centre = 0.5 * np.array([width, height]) - window[0]
        views["intrinsics"].append([*(focal * scale), *(centre * scale)])
        views["sizes"].append((width, height))
        views["files"].append(files[index])
        views["names"].append(checks.view_name(files[index], root))
    checks.check_places(np.stack(views["poses"]), path)
    return views


@checks.name_refusals
def load_blender(
    root,
    *,
    image_size: int | None = None,
    background=(1.0, 1.0, 1.0),
    strict: bool = False,
    zoom: Zoom | None = None,
) -> Scene:
    """Loads a scene in the layout of NeRF-synthetic, in the file's own coordinates.

    `transforms_train.json` gives the pool, `transforms_test.json` the test views. Where
    `<image>_depth*.png` exists it is read as the true depth.

    Args:
      image_size: wanted width in pixels, at most the original; the height keeps the proportion.
      background: [3] sRGB in [0, 1] to put under transparent pixels.
      strict: an image without a file is an error, not a warning.
      zoom: gives every view, those to test on too, a longer lens by a factor of its own; None
        takes photos whole.

    Raises:
      SceneError: anything in the files that cannot be used.
    """
    root = checks.scene_folder(root)
    options = {"image_size": image_size, "background": background, "strict": strict, "zoom": zoom}
    train = load_split(root, "train", **options)
    num_train = len(train["names"])
    test = load_split(root, "test", first=num_train, **options)
    views = {name: train[name] + test[name] for name in train}
    num_views = len(views["names"])
    for view in sorted(set(train["names"]) & set(test["names"])):
        raise SceneError(
            f"{root / 'transforms_test.json'}: '{view}' is also in transforms_train.json: "
            "list it in one"
        )
    images.look_over(views["files"], root, root)

    colours = [colour for colour, _ in views["images"]]
    pixels, offsets = pixel_table(colours)
    depth = None
    if any(d is not None for d in views["depths"]):
        unknown = (np.zeros(im.shape[:2], np.float32) for im in colours)
        depth, _ = pixel_table([u if d is None else d for d, u in zip(views["depths"], unknown)])
    box = np.array([[-BOX_HALF_SIDE] * 3, [BOX_HALF_SIDE] * 3], np.float32)
    return Scene(
        name=printable(root.resolve().name),
        cameras=checks.build_cameras(
            views["poses"],
            views["intrinsics"],
            [(im.shape[1], im.shape[0]) for im in colours],
            names=views["names"],
            path=root,
        ),
        pixels=pixels,
        offsets=offsets,
        pool=np.arange(num_train, dtype=np.int32),
        test=np.arange(num_train, num_views, dtype=np.int32),
        box=box,
        near=NEAR,
        far=FAR,
        background=np.asarray(background, np.float32),
        names=tuple(views["names"]),
        depth=depth,
        alpha=alpha_table(views["images"]),
        photo_sizes=np.array(views["sizes"], np.int32),
    )
