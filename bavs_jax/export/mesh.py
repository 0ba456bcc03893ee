"""The surface of a density by marching cubes."""

import numpy as np

from bavs_jax.export.formats import ExportError, import_extra
from bavs_jax.placement.clearance import matter_density

WALL_SHARE = 0.01  # of the longest side of the box


def default_threshold(box) -> float:
    """Density from which on there is matter, 1 / scene unit.

    The rule: a wall as thick as 1 % of the longest side of a box [2, 3] lets half of the light
    through, `exp(-threshold thickness) = 1 / 2`. It does not depend on the resolution of a grid.
    """
    lower, upper = np.asarray(box, np.float64)
    return matter_density(WALL_SHARE * float((upper - lower).max()))


def extract_mesh(density, axes, *, threshold: float, closed: bool):
    """The surface on which a density has a given value.

    Cubes are marched over `1 - 2^(-density / threshold)`, which is 1/2 on that same surface: the
    density itself rises by orders of magnitude from one grid point to the next, and linear
    interpolation would put every vertex on the outermost point.

    Args:
      density: [X, Y, Z] 1 / scene unit.
      axes: [X], [Y], [Z] evenly spaced, scene units.
      threshold: the value, 1 / scene unit, above 0.
      closed: whether what reaches the border of the grid ends there with a face, or is open.

    Returns:
      a `trimesh.Trimesh` in scene units, wound so that normals point to the lower density.

    Raises:
      ExportError: a threshold that is nowhere reached or everywhere exceeded, or a missing library.
    """
    measure, trimesh = import_extra("skimage.measure"), import_extra("trimesh")
    if not threshold > 0.0:
        raise ExportError(f"density threshold: is {threshold:.4g}: give a number above 0")
    density = np.asarray(density, np.float32)
    solid = 1.0 - np.exp2(-density / threshold)
    corner = np.array([axis[0] for axis in axes])
    steps = np.array([axis[1] - axis[0] for axis in axes])
    if closed:
        solid, corner = np.pad(solid, 1), corner - steps
    if not solid.min() < 0.5 < solid.max():
        raise ExportError(
            f"density threshold: {threshold:.4g} is not within the field's densities, "
            f"{density.min():.4g} to {density.max():.4g} per scene unit: give another one"
        )
    vertices, faces, _, _ = measure.marching_cubes(
        solid,
        0.5,
        spacing=tuple(steps),
        gradient_direction="ascent",  # scikit-image's name for faces that look outwards
        allow_degenerate=False,
    )
    lower, upper = corner + closed * steps, [axis[-1] for axis in axes]
    # A face that closes the grid belongs on its border, not between it and the padding.
    vertices = np.clip(vertices + corner, lower, upper)
    return trimesh.Trimesh(vertices, faces, process=False)


def without_small_parts(mesh, *, min_share: float):
    """A `trimesh.Trimesh` without connected parts that have less than a share of its whole area."""
    trimesh = import_extra("trimesh")
    if min_share <= 0.0:
        return mesh
    part = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
    areas = np.bincount(part, weights=mesh.area_faces)
    kept = mesh.copy()
    kept.update_faces((areas >= min_share * areas.sum())[part])
    kept.remove_unreferenced_vertices()
    return kept
