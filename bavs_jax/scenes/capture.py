"""From posed photographs, in whatever layout, to a scene: the part that all real captures share."""

import dataclasses
import pathlib
from collections.abc import Callable, Sequence

import numpy as np

from bavs_jax.cameras import Cameras, rescale
from bavs_jax.scenes import checks, folds, images, maps
from bavs_jax.scenes.base import Scene, SceneError, alpha_table, pixel_table, printable
from bavs_jax.scenes.extent import scene_extent
from bavs_jax.scenes.poses import level_and_scale, transform_poses
from bavs_jax.scenes.splits import choose_split
from bavs_jax.scenes.zoom import Zoom, check_zoom, cut, cut_cameras, magnifications, photo_windows

Split = tuple[Sequence[int], Sequence[int]]  # views of the pool, and views to test on
# Depth [H, W] of an image of a given (width, height), in the unit of the files.
DepthReader = Callable[[tuple[int, int]], np.ndarray]


@dataclasses.dataclass(frozen=True)
class Capture:
    """Photographs with their poses, in the coordinates of the user's own files.

    Views are sorted by the name of their file.
    """

    root: pathlib.Path  # the scene's folder
    source: pathlib.Path  # the file or folder that gives the poses, for messages
    files: tuple[pathlib.Path, ...]  # [V] images
    poses: np.ndarray  # [V, 4, 4] float64 camera-to-world, OpenGL axes
    cameras: Cameras  # [V] at the sizes of the image files
    masks: tuple[pathlib.Path, ...] = ()  # [V] or none at all
    # [V] or none at all: of depth along the optical axis; None for a view without.
    depths: tuple[DepthReader | None, ...] = ()
    depth_along_ray: bool = False  # the depths are distances along the rays instead
    bounds: np.ndarray | None = None  # [V, 2] depths along the axis between which content lies
    split: Split | None = None  # what comes with the files
    user_from_file: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(4))


def make_scene(
    capture: Capture,
    *,
    image_size: int | None = None,
    pool_size: int | float | None = None,
    test_every: int | None = None,
    seed: int = 0,
    scale: float | None = None,
    box_half_side: float | None = None,
    near: float | None = None,
    far: float | None = None,
    unbounded: bool = True,
    background=(1.0, 1.0, 1.0),
    zoom: Zoom | None = None,
) -> Scene:
    """Levels, centres and scales a capture's cameras, reads its images and splits its views.

    Coordinates follow nerfstudio's defaults (`level_and_scale`); +z is up, and
    `Scene.user_from_scene` leads back.

    Args:
      image_size: wanted width in pixels, at most the original; of the widest image where sizes
        differ. All images are scaled by one factor.
      pool_size: views in the pool: an int for a count, a float for a share, drawn by the seed.
      test_every: instead of pool_size, every so many-th view is a test view, from the first on.
        Without either the files' own split counts, or else three quarters are the pool.
      seed: draws the split.
      scale: scene units per unit of the files; None scales the cameras' largest coordinate to 1.
      box_half_side: half a side of the scene box around the cameras' mean, scene units; None
        for 1.5, or for the box that the cameras see between their bounds where these are known.
      near: closest distance along a ray, scene units; None for 0.9 of the least bound, or 0.05.
      far: farthest distance, scene units; None for the largest bound, or the farthest corner of
        the box.
      unbounded: whether content reaches beyond the box.
      background: [3] sRGB in [0, 1] to put under transparent pixels.
      zoom: gives every view, those to test on too, a longer lens by a factor of its own; None
        takes photos whole.

    Raises:
      SceneError: anything in the files that cannot be used.
    """
    source, num_views = capture.source, len(capture.files)
    pool, test = choose_split(
        num_views, capture.split, pool_size=pool_size, test_every=test_every, seed=seed, path=source
    )
    checks.check_places(capture.poses, source)
    if scale is not None:
        scale = checks.check_number(scale, source, "scale", positive=True)
    scene_from_file = level_and_scale(capture.poses, scale=scale)
    unit = float(np.cbrt(np.linalg.det(scene_from_file[:3, :3])))

    widest = int(capture.cameras.sizes[:, 0].max())
    factor = checks.check_target_width(image_size, widest, source) / widest
    if zoom is not None:
        check_zoom(zoom, factor, widest, source)
    sizes = np.maximum(np.rint(capture.cameras.sizes * factor), 1)
    windows = photo_windows(capture.cameras.sizes, magnifications(zoom, num_views))
    poses = transform_poses(scene_from_file, capture.poses).astype(np.float32)
    cameras = rescale(cut_cameras(capture.cameras, windows), sizes).replace(world_from_cam=poses)

    near, far, box = scene_extent(
        rescale(capture.cameras, sizes).replace(world_from_cam=poses),
        None if capture.bounds is None else unit * capture.bounds,
        box_half_side=box_half_side,
        near=near,
        far=far,
        unbounded=unbounded,
        path=source,
    )
    shrunk = [
        images.shrink_over(
            cut(images.read_image(file), window), int(width), int(height), background
        )
        for file, window, (width, height) in zip(capture.files, windows, cameras.sizes)
    ]
    pixels, offsets = pixel_table([colour for colour, _ in shrunk])
    names = tuple(checks.view_name(file, capture.root) for file in capture.files)
    depth = depth_table(capture, cameras, unit, windows)
    pixel_mask = mask_table(capture, cameras, names, windows)
    images.look_over(capture.files, capture.root, source)
    return Scene(
        name=printable(capture.root.resolve().name),
        cameras=cameras,
        pixels=pixels,
        offsets=offsets,
        pool=pool,
        test=test,
        box=box,
        near=near,
        far=far,
        background=np.asarray(background, np.float32),
        names=names,
        depth=depth,
        pixel_mask=pixel_mask,
        alpha=alpha_table(shrunk),
        unbounded=unbounded,
        photo_sizes=np.asarray(capture.cameras.sizes, np.int32),
        user_from_scene=capture.user_from_file @ np.linalg.inv(scene_from_file),
    )


def mask_table(
    capture: Capture, cameras: Cameras, names: tuple[str, ...], windows: np.ndarray
) -> np.ndarray | None:
    """`Scene.pixel_mask` at the sizes of `cameras`, or None where every pixel counts.

    What a mask leaves out does not count, nor what lies beyond the range of the lens.

    Args:
      capture: names the mask of each view.
      cameras: [V] at the sizes of the table.
      names: [V] of the views, for messages.
      windows: [V, 2, 2] the part of each photo that the cameras see, pixels of the files.
    """
    shown = folds.shown_masks(cameras, names, capture.source)
    if not capture.masks:
        return None if shown is None else pixel_table(shown)[0]
    table = []
    for view, path in enumerate(capture.masks):
        width, height = (int(n) for n in capture.cameras.sizes[view])
        mask = maps.read_mask(path, (width, height), capture.files[view])
        mask = maps.shrink_mask(cut(mask, windows[view]), *(int(n) for n in cameras.sizes[view]))
        if shown is not None:
            mask &= shown[view]
        if not mask.any():
            width, height = cameras.sizes[view]
            raise SceneError(
                f"{path}: mask leaves no pixel at {width} x {height}: "
                "use a larger image_size or remove the frame"
            )
        table.append(mask)
    return pixel_table(table)[0]


def depth_table(
    capture: Capture, cameras: Cameras, unit: float, windows: np.ndarray
) -> np.ndarray | None:
    """`Scene.depth` at the sizes of `cameras`, or None where no view has depth.

    Args:
      capture: names the depth of each view.
      cameras: [V] in scene coordinates, at the sizes of the table.
      unit: scene units per unit of the capture.
      windows: see `mask_table`.
    """
    if not any(capture.depths):
        return None
    table = []
    for view, read_fn in enumerate(capture.depths):
        width, height = (int(n) for n in cameras.sizes[view])
        if read_fn is None:
            table.append(np.zeros((height, width), np.float32))
            continue
        full_width, full_height = (int(n) for n in capture.cameras.sizes[view])
        depth = read_fn((full_width, full_height))
        part = windows[view] / (full_width, full_height)  # a map may be smaller than the photo
        depth = images.nearest_resize(unit * depth, width, height, part=part).astype(np.float32)
        table.append(depth if capture.depth_along_ray else maps.along_rays(depth, cameras, view))
    return pixel_table(table)[0]
