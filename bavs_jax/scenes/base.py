"""What a scene is: posed images in one flat pixel table, with splits, box and background."""

import dataclasses

import numpy as np

from bavs_jax.cameras import Cameras, rescale

LONGEST_MESSAGE = 1000  # characters; a file may hold a name or a value of any length


def printable(text) -> str:
    """Text that any terminal and any file takes, on one line: what cannot be printed is escaped.

    Names of files, and names in files, may hold line breaks, terminal escapes and surrogates.
    """
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in str(text)
    )


class SceneError(ValueError):
    """Input that cannot be used: one line that names the file, the field and the fix."""

    def __init__(self, message: str):
        text, half = printable(message), LONGEST_MESSAGE // 2
        super().__init__(text if len(text) <= 2 * half else f"{text[:half]} ... {text[-half:]}")


@dataclasses.dataclass(frozen=True)
class Scene:
    """Posed images of one static scene, on the host.

    All pixels lie in one table so that images of mixed sizes, and training sets that grow,
    share one code: view v owns rows `offsets[v]:offsets[v + 1]`, in row order.
    """

    name: str
    cameras: Cameras  # V views
    pixels: np.ndarray  # [N, 3] uint8 sRGB, already over the background where there was alpha
    offsets: np.ndarray  # [V + 1] int64
    pool: np.ndarray  # [P] int32 views that may be trained on or chosen
    test: np.ndarray  # [T] int32 views that are only measured
    box: np.ndarray  # [2, 3] float32 lower and upper corner, scene units
    near: float  # closest distance along a ray, scene units
    far: float  # farthest distance, scene units
    background: np.ndarray  # [3] float32 sRGB in [0, 1]
    names: tuple[str, ...]  # [V] a name for each view: its file, relative to the scene's folder
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)  # unit
    depth: np.ndarray | None = None  # [N] float32 distance along the ray, 0 where unknown or empty
    pixel_mask: np.ndarray | None = None  # [N] bool, False: ignore this pixel
    alpha: np.ndarray | None = None  # [N] uint8 opacity of the photos; None: all opaque
    start: np.ndarray | None = None  # [S] int32 views of the pool that runs begin with; None: any
    unbounded: bool = False  # content reaches beyond the box, as in most real captures
    closed: bool = False  # each ray from a camera ends on a surface within the box, as in a room
    photo_sizes: np.ndarray | None = None  # [V, 2] int32 pixels of the files; None: not reduced
    # [4, 4] float64 similarity from scene coordinates to those of the user's own file.
    user_from_scene: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(4))

    @property
    def num_views(self) -> int:
        return len(self.names)

    @property
    def centre(self) -> np.ndarray:
        """Middle of the scene box [3], scene units."""
        return self.box.mean(axis=0)

    def view_slice(self, view_id: int) -> slice:
        """Rows of the pixel table that belong to a view."""
        return slice(int(self.offsets[view_id]), int(self.offsets[view_id + 1]))

    def image(self, view_id: int) -> np.ndarray:
        """One view as [H, W, 3] uint8."""
        return self._shaped(self.pixels, view_id)

    def depth_image(self, view_id: int) -> np.ndarray | None:
        """One view's true depth as [H, W] float32 with 0 where unknown, or None."""
        return None if self.depth is None else self._shaped(self.depth, view_id)

    def mask_image(self, view_id: int) -> np.ndarray | None:
        """Which pixels of a view count, [H, W] bool, or None where all do."""
        return None if self.pixel_mask is None else self._shaped(self.pixel_mask, view_id)

    def _shaped(self, table: np.ndarray, view_id: int) -> np.ndarray:
        width, height = (int(n) for n in self.cameras.sizes[view_id])
        return table[self.view_slice(view_id)].reshape(height, width, *table.shape[1:])


def photo_cameras(scene: Scene, cameras: Cameras) -> Cameras:
    """Cameras as one would take photos with them: at the sizes of the scene's files.

    The cameras given have the image sizes of some of its views, which may have been reduced.
    """
    if scene.photo_sizes is None:
        return cameras
    by_size = {
        tuple(small): whole
        for small, whole in zip(np.asarray(scene.cameras.sizes).tolist(), scene.photo_sizes)
    }
    return rescale(cameras, [by_size[tuple(size)] for size in np.asarray(cameras.sizes).tolist()])


def alpha_table(views: list[tuple[np.ndarray, np.ndarray | None]]) -> np.ndarray | None:
    """`Scene.alpha` of views (colour [H, W, 3], opacity [H, W] or None); None if all are opaque."""
    if all(alpha is None for _, alpha in views):
        return None
    opaque = (np.full(colour.shape[:2], 255, np.uint8) for colour, _ in views)
    return pixel_table([o if a is None else a for (_, a), o in zip(views, opaque)])[0]


def pixel_table(images: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Stacks images [H_v, W_v, ...] into rows [N, ...] and their offsets [V + 1]."""
    counts = [image.shape[0] * image.shape[1] for image in images]
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    rows = np.concatenate([im.reshape(n, *im.shape[2:]) for im, n in zip(images, counts)])
    return rows, offsets
