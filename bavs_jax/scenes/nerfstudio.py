"""Scenes in the layout of nerfstudio and instant-ngp: one `transforms.json` with its images."""

import functools
import pathlib

import numpy as np

from bavs_jax.scenes import checks, images, maps, texts
from bavs_jax.scenes.base import Scene, SceneError
from bavs_jax.scenes.capture import Capture, DepthReader, Split, make_scene
from bavs_jax.scenes.folders import check_downscale, scaled_names
from bavs_jax.scenes.transforms import Frame, read_cameras

MILLIMETRE = 1e-3  # nerfstudio's unit of depth, in those of the poses


def find_scaled(
    root: pathlib.Path, name: str, downscale: int | None, *, kind: str = "images"
) -> pathlib.Path | None:
    """A frame's file at a scale, or None."""
    names = scaled_names(name, downscale, kind=kind)
    return next((p for n in names if (p := images.find_image(root, n)) is not None), None)


def find_masks(
    root: pathlib.Path, frames: list[Frame], downscale: int | None
) -> tuple[pathlib.Path, ...]:
    """The mask of each frame; none where no frame names one.

    Raises:
      SceneError: only some frames name a mask.
    """
    named = [frame.own.get("mask_path") for frame in frames]
    if not any(named):
        return ()
    for frame, name in zip(frames, named):
        field = f"frames[{frame.index}].mask_path"
        if not isinstance(name, str) or not name:
            raise SceneError(
                f"{frame.path}: {field}: missing though other frames have one: give every frame "
                "a mask, or none"
            )
        checks.check_inside(root, name, frame.path, field)
    return tuple(
        find_scaled(root, name, downscale, kind="masks")
        or root / scaled_names(name, downscale, kind="masks")[0]
        for name in named
    )


def find_depths(
    root: pathlib.Path, frames: list[Frame], files: list[pathlib.Path], *, downscale, unit: float
) -> tuple[DepthReader | None, ...]:
    """How to read the depth of each frame: a function of the image's size, or None."""
    readers: list[DepthReader | None] = []
    for frame, file in zip(frames, files):
        name = frame.own.get("depth_file_path")
        if name is None:
            readers.append(None)
            continue
        field = f"frames[{frame.index}].depth_file_path"
        if not isinstance(name, str) or not name:
            raise SceneError(f"{frame.path}: {field}: is {name!r}: give the name of a file")
        checks.check_inside(root, name, frame.path, field)
        path = find_scaled(root, name, downscale, kind="depths") or root / name
        readers.append(functools.partial(maps.read_depth, path, image_path=file, unit=unit))
    return tuple(readers)


def read_split(data: dict, path: pathlib.Path, names: list[str]) -> Split | None:
    """(pool, test) view ids from `train_filenames` and `test_filenames`, or `val_filenames`.

    Args:
      data: the file's content.
      names: the `file_path` of each view that is kept.

    Raises:
      SceneError: one list is missing, or names a file that no frame has.
    """
    given = {key: data.get(f"{key}_filenames") for key in ("train", "val", "test")}
    if all(listed is None for listed in given.values()):
        return None
    known = {str(pathlib.PurePosixPath(frame["file_path"])) for frame in data["frames"]}
    ids = {str(pathlib.PurePosixPath(name)): view for view, name in enumerate(names)}
    views = {}
    for key, listed in given.items():
        field = f"{key}_filenames"
        if listed is None:
            continue
        if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
            raise SceneError(f"{path}: {field}: not a list of names: list file_paths")
        listed = [str(pathlib.PurePosixPath(name)) for name in listed]
        for name in listed:
            if name not in known:
                raise SceneError(f"{path}: {field}: '{name}' is no frame's file_path: remove it")
        views[key] = [ids[name] for name in listed if name in ids]
    test = "test" if "test" in views else "val"
    for key in ("train", test):
        if key not in views:
            raise SceneError(f"{path}: {key}_filenames: missing beside the other split: list it")
    return views["train"], views[test]


def applied(data: dict, path: pathlib.Path) -> tuple[np.ndarray, float]:
    """How the file's coordinates came from those of the original reconstruction.

    Returns:
      `(file_from_original [4, 4], applied_scale)`: `X_file = applied_scale (T X_original)`.
    """
    transform = np.eye(4)
    if data.get("applied_transform") is not None:
        transform = checks.check_pose(data["applied_transform"], path, "applied_transform")
    scale = 1.0
    if data.get("applied_scale") is not None:
        scale = checks.check_number(data["applied_scale"], path, "applied_scale", positive=True)
    return np.diag([scale, scale, scale, 1.0]) @ transform, scale


def read_nerfstudio(
    root: pathlib.Path,
    *,
    downscale: int | None = None,
    strict: bool = False,
    depth_unit: float = MILLIMETRE,
    depth_along_ray: bool = False,
    original_coordinates: bool = False,
) -> Capture:
    """Reads `transforms.json`; the arguments are those of `load_nerfstudio`."""
    path = root / "transforms.json"
    data = texts.read_json(path)
    listed = checks.check_frames(data, path)
    check_downscale(root, downscale)
    for index, frame in enumerate(listed):
        checks.check_inside(root, frame["file_path"], path, f"frames[{index}].file_path")
    found = [find_scaled(root, frame["file_path"], downscale) for frame in listed]
    kept = checks.keep_existing(listed, found, path, strict=strict)
    kept = sorted(kept, key=lambda index: listed[index]["file_path"])
    existing = checks.existing(found)
    files = [existing[index] for index in kept]
    frames = [Frame(data, index, path) for index in kept]
    cameras, poses = read_cameras(frames, files)
    file_from_original, scale = applied(data, path)
    # A depth is in the units of the original reconstruction, as in nerfstudio.
    depths = find_depths(root, frames, files, downscale=downscale, unit=depth_unit * scale)
    return Capture(
        root=root,
        source=path,
        files=tuple(files),
        poses=poses,
        cameras=cameras,
        masks=find_masks(root, frames, downscale),
        depths=depths,
        depth_along_ray=depth_along_ray,
        split=read_split(data, path, [listed[index]["file_path"] for index in kept]),
        user_from_file=np.linalg.inv(file_from_original) if original_coordinates else np.eye(4),
    )


@checks.name_refusals
def load_nerfstudio(
    root,
    *,
    downscale: int | None = None,
    strict: bool = False,
    depth_unit: float = MILLIMETRE,
    depth_along_ray: bool = False,
    original_coordinates: bool = False,
    **options,
) -> Scene:
    """Loads a scene in the layout of nerfstudio, in normalised coordinates with +z up.

    `{train,val,test}_filenames` give the split where no option does. A `mask_path` is black where
    pixels are ignored; a `depth_file_path` becomes `Scene.depth`.

    Args:
      root: the folder of `transforms.json`.
      downscale: N takes the copies in `images_N`, `masks_N` and `depths_N`.
      strict: an image without a file is an error, not a warning.
      depth_unit: what a depth value of 1 means, in units of the poses: millimetres of metres.
      depth_along_ray: depths are distances along the rays, not along the optical axis.
      original_coordinates: `user_from_scene` leads back to before the file's `applied_transform`
        and `applied_scale`, rather than to the file's own poses.
      **options: of `make_scene`.

    Raises:
      SceneError: anything in the files that cannot be used.
    """
    capture = read_nerfstudio(
        checks.scene_folder(root),
        downscale=downscale,
        strict=strict,
        depth_unit=depth_unit,
        depth_along_ray=depth_along_ray,
        original_coordinates=original_coordinates,
    )
    return make_scene(capture, **options)
