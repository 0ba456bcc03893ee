"""The files of an exported field: grid, volumes, point cloud, mesh and geometry error."""

from __future__ import annotations

import pathlib
from collections.abc import Callable
from functools import partial

import numpy as np

from bavs_jax.export.field import (
    DISTANCE_SHARE,
    geometry_error,
    ray_end_points,
    sample_grid,
    sample_mesh,
)
from bavs_jax.export.formats import import_extra, nrrd_bytes, ply_bytes
from bavs_jax.export.mesh import extract_mesh, without_small_parts
from bavs_jax.fields.deformation import offset_unit
from bavs_jax.pixel_table import training_pixels
from bavs_jax.scenes import Scene
from bavs_jax.scenes.poses import user_points, user_units
from bavs_jax.scenes.sdf_surface import sample_surface
from bavs_jax.uncertainty.channel import finish_uncertainty
from experiments.build import RENDER_CHUNK
from experiments.files import write_arrays, write_atomic
from experiments.keys import stream_key
from experiments.progress import track
from experiments.trained import TrainedRun

# Of the box's longest side: the shell that the true surface is drawn from, and how far from that
# surface a drawn point may be; both far below the mean distance between drawn points.
SHELL_SHARE, SURFACE_TOLERANCE = 5e-3, 5e-5

VOLUMES = {  # name of the file: what it holds, and its unit in the user's coordinates
    "density": "density, 1 / user unit",
    "sigma": "standard deviation of the offset, user units",
    "uncertainty": "log10 of sigma in thirds of the box's mean side, [-3, 6] put on [0, 1]",
}


def on_unit_scale(sigma, box) -> np.ndarray:
    """Standard deviations in scene units as renderings show them: their log on [0, 1]."""
    return np.asarray(finish_uncertainty(np.log10(sigma / offset_unit(box)), scale="log"))


def in_user_units(scene: Scene, values: dict) -> dict:
    """What `VOLUMES` names, from densities and standard deviations in scene units."""
    unit = user_units(scene)
    return {
        "density": values["density"] / unit,
        "sigma": values["sigma"] * unit,
        "uncertainty": on_unit_scale(values["sigma"], scene.box),
    }


def read_grid(point_fn: Callable, axes) -> dict[str, np.ndarray]:
    """Density and sigma at all points of a grid, in scene units, with progress."""
    num = int(np.prod([len(axis) for axis in axes]))
    with track(num, "read the grid", "points") as bar:
        return sample_grid(partial(point_fn, progress_fn=bar.advance), axes)


def write_grid(folder: pathlib.Path, scene: Scene, axes, grid: dict) -> dict[str, pathlib.Path]:
    """`grid.npz` in scene units, whose axes the grid follows, and volumes in the user's."""
    path = folder / "grid.npz"
    write_arrays(
        path,
        **grid,
        box=np.asarray(scene.box),
        **dict(zip("xyz", axes)),
        axes=np.array(["x", "y", "z"]),
        names=np.array(["density", "sigma"]),
        units=np.array(["1 / scene unit", "scene units"]),
        length_unit=np.array("scene units"),
        user_from_scene=np.asarray(scene.user_from_scene, np.float64),
        user_units_per_scene_unit=np.array(user_units(scene)),
    )
    files = {"grid": path}
    for name, values in in_user_units(scene, grid).items():
        data = nrrd_bytes(
            values, axes, user_from_scene=scene.user_from_scene, content=VOLUMES[name]
        )
        files[f"{name} volume"] = folder / f"{name}.nrrd"
        write_atomic(files[f"{name} volume"], partial(_write, data))
    return files


def write_points(
    folder: pathlib.Path,
    run: TrainedRun,
    point_fn: Callable,
    *,
    min_opacity: float,
    max_points: int,
    beyond_box: bool,
) -> dict[str, pathlib.Path]:
    """`points.ply`: where training rays end, with rendered colour and uncertainty there."""
    scene, situation = run.problem.scene, run.situation
    view_ids, pixel_ids = training_pixels(situation.table, situation.is_training_view)
    if max_points and len(view_ids) > max_points:
        rows = np.random.default_rng(run.seed).permutation(len(view_ids))[:max_points]
        view_ids, pixel_ids = (x[np.sort(rows)] for x in (view_ids, pixel_ids))
    with track(len(view_ids), "follow training rays", "rays") as bar:
        positions, rgb = ray_end_points(
            run.problem.render(situation.train),
            situation.table,
            view_ids,
            pixel_ids,
            chunk=RENDER_CHUNK,
            min_opacity=min_opacity,
            progress_fn=bar.advance,
        )
    if not beyond_box:
        lower, upper = np.asarray(scene.box)
        inside = ((positions >= lower) & (positions <= upper)).all(-1)
        positions, rgb = positions[inside], rgb[inside]
    data = ply_bytes(
        user_points(scene, positions), rgb, _vertex_numbers(scene, point_fn, positions)
    )
    write_atomic(folder / "points.ply", partial(_write, data))
    print(f"point cloud: {len(positions)} points of {len(view_ids)} training rays")
    return {"points": folder / "points.ply"}


def make_mesh(scene: Scene, axes, density, *, threshold: float, min_part: float):
    """The mesh in scene units; content beyond an unbounded scene's box is cut, not closed."""
    mesh = extract_mesh(density, axes, threshold=threshold, closed=not scene.unbounded)
    mesh = without_small_parts(mesh, min_share=min_part)
    print(
        f"mesh: {len(mesh.vertices)} vertices, {len(mesh.faces)} faces where density is "
        f"{threshold / user_units(scene):.4g} per user unit"
    )
    return mesh


def write_mesh(
    folder: pathlib.Path, scene: Scene, mesh, point_fn: Callable
) -> dict[str, pathlib.Path]:
    """`mesh.ply`: each vertex in the colour that it has when looked at straight on."""
    directions = -np.asarray(mesh.vertex_normals)
    with track(len(mesh.vertices), "colour the mesh", "vertices") as bar:
        values = point_fn(mesh.vertices, directions=directions, progress_fn=bar.advance)
    numbers = in_user_units(scene, values)
    data = ply_bytes(
        user_points(scene, mesh.vertices),
        values["rgb"],
        {name: numbers[name] for name in ("uncertainty", "sigma")},
        mesh.faces,
    )
    write_atomic(folder / "mesh.ply", partial(_write, data))
    return {"mesh": folder / "mesh.ply"}


def measure_geometry(run: TrainedRun, mesh, signed_distance: Callable, *, num: int) -> dict:
    """Chamfer distances of the mesh from the scene's true surface, scene units."""
    scene = run.problem.scene
    side = float(np.max(scene.box[1] - scene.box[0]))
    print(f"geometry: draws {num} points on each surface")
    true = sample_surface(
        stream_key(run.seed, "surface"),
        signed_distance,
        scene.box,
        2 * num,
        band=SHELL_SHARE * side,
        tolerance=SURFACE_TOLERANCE * side,
    )
    errors = geometry_error(
        scene,
        sample_mesh(mesh, num, seed=run.seed),
        true[:num],
        true[num:],
        distance=DISTANCE_SHARE * side,
    )
    return {"unit": "scene units", "num_points": num, **errors}


def check_libraries(what) -> None:
    """Raises ExportError for a library that is missing, before anything is computed."""
    needed = {"grid": ["nrrd"], "points": ["trimesh"], "mesh": ["trimesh", "skimage.measure"]}
    for name in what:
        for module in needed[name]:
            import_extra(module)


def _vertex_numbers(scene: Scene, point_fn: Callable, positions) -> dict[str, np.ndarray]:
    numbers = in_user_units(scene, point_fn(positions))
    return {name: numbers[name] for name in ("uncertainty", "sigma")}


def _write(data: bytes, file) -> None:
    file.write(data)
