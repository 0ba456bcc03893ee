"""Files of points, meshes and volumes, and the libraries that they need."""

import importlib
import io
from types import ModuleType

import numpy as np

PACKAGES = {"nrrd": "pynrrd", "skimage.measure": "scikit-image", "trimesh": "trimesh"}


class ExportError(ValueError):
    """An export that cannot be made: one line that names what is wrong and the fix."""


def import_extra(name: str) -> ModuleType:
    """One of the modules in `PACKAGES`.

    Raises:
      ExportError: it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ExportError(
            f"{PACKAGES[name]}: is not installed ({error}): pip install 'bavs_jax[export]'"
        ) from error


def ply_bytes(positions, rgb, properties: dict[str, np.ndarray], faces=None) -> bytes:
    """A binary PLY file.

    Args:
      positions: [K, 3]; the file holds float32.
      rgb: [K, 3] in [0, 1].
      properties: by name, [K] numbers at each point, written as float32.
      faces: [F, 3] rows of `positions`, or None for points alone.

    Raises:
      ExportError: trimesh is not installed.
    """
    trimesh = import_extra("trimesh")
    colours = np.rint(255.0 * np.clip(rgb, 0.0, 1.0)).astype(np.uint8)
    attributes = {name: np.asarray(x, np.float32) for name, x in properties.items()}
    if faces is None:
        shape = trimesh.PointCloud(positions, colors=colours)
        # The writer takes these from clouds as from meshes, whose constructor alone has them.
        shape.vertex_attributes = attributes
    else:
        shape = trimesh.Trimesh(
            positions, faces, vertex_colors=colours, vertex_attributes=attributes, process=False
        )
    return shape.export(file_type="ply")


def nrrd_bytes(values, axes, *, user_from_scene, content: str) -> bytes:
    """One quantity on a grid, placed in the user's coordinates, as a compressed file.

    A similarity may turn the grid: NRRD holds a vector per axis in place of a spacing. Point
    `(i, j, k)` lies at `origin + i step_x + j step_y + k step_z`.

    Args:
      values: [X, Y, Z] in the unit that `content` names.
      axes: [X], [Y], [Z] of at least two planes each, scene units.
      user_from_scene: [4, 4] similarity.
      content: what the values are, with their unit.

    Raises:
      ExportError: pynrrd is not installed.
    """
    nrrd = import_extra("nrrd")
    matrix = np.asarray(user_from_scene, np.float64)
    steps = np.array([axis[1] - axis[0] for axis in axes])
    corner = np.array([axis[0] for axis in axes])
    header = {
        "content": content,
        "space dimension": 3,
        "space origin": matrix[:3, :3] @ corner + matrix[:3, 3],
        "space directions": steps[:, None] * matrix[:3, :3].T,
        "kinds": ["domain"] * 3,
        "centerings": ["node"] * 3,
    }
    file = io.BytesIO()
    nrrd.write(file, np.asarray(values, np.float32), header, index_order="F", compression_level=6)
    return file.getvalue()
