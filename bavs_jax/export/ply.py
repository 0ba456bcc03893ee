"""Coloured points and meshes, with numbers of one's own at each point, as PLY files."""

from __future__ import annotations

import numpy as np

from bavs_jax.export.extras import import_extra


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
            positions,
            faces,
            vertex_colors=colours,
            vertex_attributes=attributes,
            process=False,
        )
    return shape.export(file_type="ply")
