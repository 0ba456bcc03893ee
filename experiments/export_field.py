"""Writes a trained field and its uncertainty into files that other programs read.

    python -m experiments.export_field --workdir=runs/quickstart
    python -m experiments.export_field --config=experiments/configs/quickstart.py --workdir=NEW

The first takes up a run of a folder; the second trains first. Writes into
WORKDIR/<policy>/seed_<n>/export:

    grid.npz                 density and sigma (standard deviation of the offset) on a regular grid
    density.nrrd and others  the same as volumes, in the coordinates of your own files
    slices.png               the grid's middle planes
    points.ply               where training rays end, coloured, with `uncertainty` and `sigma`
    mesh.ply                 the surface at a density, with the same at each vertex
    geometry.json            distance of the mesh from the true surface, where that is known

Needs `pip install 'bavs_jax[export]'`. For density, sigma and colour at points of your own, see
`user_point_fn` in experiments/posthoc/points.py.
"""

from __future__ import annotations

import pathlib
import time
from collections.abc import Callable
from functools import partial

import numpy as np
from absl import flags
from matplotlib.figure import Figure

from bavs_jax.export.field import (
    DISTANCE_SHARE,
    MIN_OPACITY,
    geometry_error,
    grid_axes,
    ray_end_points,
    sample_grid,
    sample_mesh,
)
from bavs_jax.export.formats import import_extra, nrrd_bytes, ply_bytes
from bavs_jax.export.mesh import default_threshold, extract_mesh, without_small_parts
from bavs_jax.fields.deformation import offset_unit
from bavs_jax.pixel_table import training_pixels
from bavs_jax.scenes import Scene
from bavs_jax.scenes.poses import user_points, user_units
from bavs_jax.scenes.sdf_surface import sample_surface
from bavs_jax.uncertainty.channel import finish_uncertainty
from experiments.build import stream_key, true_surface
from experiments.build_model import RENDER_CHUNK
from experiments.files import write_arrays, write_atomic, write_json
from experiments.posthoc import script
from experiments.posthoc.points import scene_point_fn
from experiments.reporting.pictures import colour_bar
from experiments.reporting.plots import save_figure
from experiments.runtime import track
from experiments.trained import TrainedRun, run_curvature, run_variance

# Of the box's longest side: the shell that the true surface is drawn from, and how far from that
# surface a drawn point may be; both far below the mean distance between drawn points.
SHELL_SHARE, SURFACE_TOLERANCE = 5e-3, 5e-5

VOLUMES = {  # name of the file: what it holds, and its unit in the user's coordinates
    "density": "density, 1 / user unit",
    "sigma": "standard deviation of the offset, user units",
    "uncertainty": "log10 of sigma in thirds of the box's mean side, [-3, 6] put on [0, 1]",
}
WHAT = ("grid", "points", "mesh")

FLAGS = flags.FLAGS
flags.adopt_module_key_flags(script)
flags.DEFINE_list("what", list(WHAT), f"What to write, of {','.join(WHAT)}.")
flags.DEFINE_integer("resolution", 128, "Grid points along the longest side of the box.")
flags.DEFINE_float(
    "density_threshold",
    0.0,
    "Density at the mesh's surface, 1 / user unit. 0: a wall of 1 % of the box's longest side "
    "then lets half of the light through.",
)
flags.DEFINE_float("min_part", 0.0, "Leaves out parts below this share of the mesh's area.")
flags.DEFINE_float("min_opacity", MIN_OPACITY, "Of the rays whose ends are points of the cloud.")
flags.DEFINE_integer("max_points", 500_000, "Training rays for the cloud, at random; 0: all.")
flags.DEFINE_bool("beyond_box", False, "Keep points of the cloud that lie outside the scene box.")
flags.DEFINE_integer("num_samples", 200_000, "Points on each surface, for the geometry error.")


def export() -> None:
    """Takes up the runs, computes their uncertainty and writes what was asked for."""
    start = time.monotonic()
    script.check_flags(
        ("what", FLAGS.what and set(FLAGS.what) <= set(WHAT), f"give some of {','.join(WHAT)}"),
        ("resolution", 2 <= FLAGS.resolution <= 1024, "give a number from 2 to 1024"),
        (
            "density_threshold",
            0.0 <= FLAGS.density_threshold <= 1e9,
            "give a number above 0, or 0 for the default",
        ),
        ("min_part", 0.0 <= FLAGS.min_part < 1.0, "give a share from 0 up to below 1"),
        ("min_opacity", 0.0 < FLAGS.min_opacity <= 1.0, "give a share above 0 and up to 1"),
        ("max_points", 0 <= FLAGS.max_points <= 10**9, "give a number above 0, or 0 for all"),
        ("num_samples", 1 <= FLAGS.num_samples <= 10**7, "give a number from 1 to 10 million"),
    )
    needed = {"grid": ["nrrd"], "points": ["trimesh"], "mesh": ["trimesh", "skimage.measure"]}
    for module in [module for name in FLAGS.what for module in needed[name]]:
        import_extra(module)  # one that is missing ends here, before anything is computed
    for run in script.trained_runs():
        for name, path in export_run(run).items():
            print(f"{name + ':':20}{path}")
    print(f"({time.monotonic() - start:.0f} s in all)")


def export_run(run: TrainedRun) -> dict[str, pathlib.Path]:
    """All files of one run, by what they are."""
    scene, folder = run.problem.scene, run.folder / "export"
    point_fn = scene_point_fn(run, run_variance(run, run_curvature(run)))
    files, axes = {}, grid_axes(scene.box, FLAGS.resolution)
    if {"grid", "mesh"} & set(FLAGS.what):
        num = int(np.prod([len(axis) for axis in axes]))
        with track(num, "read the grid", "points") as bar:
            grid = sample_grid(partial(point_fn, progress_fn=bar.advance), axes)
    if "grid" in FLAGS.what:
        files |= write_grid(folder, scene, axes, grid)
    if "points" in FLAGS.what:
        files |= write_points(folder, run, point_fn)
    if "mesh" in FLAGS.what:
        files |= write_mesh(folder, run, axes, grid["density"], point_fn)
    return files


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


def write_grid(folder: pathlib.Path, scene: Scene, axes, grid: dict) -> dict[str, pathlib.Path]:
    """`grid.npz` in scene units, whose axes the grid follows, volumes in the user's, and slices."""
    files = {"grid": folder / "grid.npz"}
    write_arrays(
        files["grid"],
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
    for name, values in in_user_units(scene, grid).items():
        about = {"user_from_scene": scene.user_from_scene, "content": VOLUMES[name]}
        files[f"{name} volume"] = folder / f"{name}.nrrd"
        _write(files[f"{name} volume"], nrrd_bytes(values, axes, **about))
    files["slices"] = folder / "slices.png"
    save_figure(slices_figure(axes, grid, scene.box), files["slices"])
    return files


def slices_figure(axes, grid: dict, box) -> Figure:
    """Opacity of the voxels and uncertainty on the three planes through the middle of the box.

    Args:
      axes: [X], [Y], [Z] scene units.
      grid: "density" and "sigma" [X, Y, Z], scene units.
      box: [2, 3] of the scene.
    """
    spacing = float(np.mean([axis[1] - axis[0] for axis in axes]))
    opacity = -np.expm1(-grid["density"] * spacing)
    shown = (
        ("light that a voxel stops", "Greys", opacity),
        ("uncertainty, log10 sigma on [0, 1]", "cividis", on_unit_scale(grid["sigma"], box)),
    )
    figure = Figure(figsize=(7.6, 5.2))
    for row, (title, colours, values) in zip(figure.subplots(2, 3), shown):
        for fixed, place in enumerate(row):
            across, up = (i for i in range(3) if i != fixed)
            middle = len(axes[fixed]) // 2
            extent = [axes[across][0], axes[across][-1], axes[up][0], axes[up][-1]]
            plane = np.take(values, middle, axis=fixed).T
            place.imshow(plane, origin="lower", extent=extent, cmap=colours, vmin=0.0, vmax=1.0)
            name = f"{'xyz'[fixed]} = {axes[fixed][middle]:.2f}"
            place.set_title(name, fontsize=8.5, loc="center")
            place.set_xlabel(f"{'xyz'[across]} (scene units)", fontsize=8)
            place.set_ylabel("xyz"[up], fontsize=8)
            place.tick_params(labelsize=7)
            place.spines[:].set_visible(False)
        colour_bar(figure, row, colours, (0.0, 1.0), title)
    return figure


def write_points(folder: pathlib.Path, run: TrainedRun, point_fn: Callable) -> dict:
    """`points.ply`: where training rays end, with rendered colour and uncertainty there."""
    scene, acquired = run.problem.scene, run.acquired
    view_ids, pixel_ids = training_pixels(acquired.table, acquired.is_training_view)
    if FLAGS.max_points and len(view_ids) > FLAGS.max_points:
        rows = np.random.default_rng(run.seed).permutation(len(view_ids))[: FLAGS.max_points]
        view_ids, pixel_ids = (x[np.sort(rows)] for x in (view_ids, pixel_ids))
    with track(len(view_ids), "follow training rays", "rays") as bar:
        positions, rgb = ray_end_points(
            run.problem.render(acquired.train),
            acquired.table,
            view_ids,
            pixel_ids,
            chunk=RENDER_CHUNK,
            min_opacity=FLAGS.min_opacity,
            progress_fn=bar.advance,
        )
    if not FLAGS.beyond_box:
        lower, upper = np.asarray(scene.box)
        inside = ((positions >= lower) & (positions <= upper)).all(-1)
        positions, rgb = positions[inside], rgb[inside]
    _write_vertices(folder / "points.ply", scene, positions, rgb, point_fn(positions))
    print(f"point cloud: {len(positions)} points of {len(view_ids)} training rays")
    return {"points": folder / "points.ply"}


def write_mesh(folder: pathlib.Path, run: TrainedRun, axes, density, point_fn: Callable) -> dict:
    """`mesh.ply`, and its distance from the true surface where that is known.

    Content beyond an unbounded scene's box is cut, not closed. Each vertex has the colour that it
    has when looked at straight on.
    """
    scene = run.problem.scene
    threshold = FLAGS.density_threshold * user_units(scene) or default_threshold(scene.box)
    mesh = extract_mesh(density, axes, threshold=threshold, closed=not scene.unbounded)
    mesh = without_small_parts(mesh, min_share=FLAGS.min_part)
    print(
        f"mesh: {len(mesh.vertices)} vertices, {len(mesh.faces)} faces where density is "
        f"{threshold / user_units(scene):.4g} per user unit"
    )
    directions = -np.asarray(mesh.vertex_normals)
    with track(len(mesh.vertices), "colour the mesh", "vertices") as bar:
        values = point_fn(mesh.vertices, directions=directions, progress_fn=bar.advance)
    files = {"mesh": folder / "mesh.ply"}
    _write_vertices(files["mesh"], scene, mesh.vertices, values["rgb"], values, mesh.faces)
    signed_distance = true_surface(run.config)
    if signed_distance is None:
        return files
    errors = measure_geometry(run, mesh, signed_distance)
    options = {"resolution": FLAGS.resolution, "density_threshold": threshold}
    row = {**script.about_run(run), **options, "min_part": FLAGS.min_part, **errors}
    files["geometry"] = folder / "geometry.json"
    write_json(files["geometry"], script.result_file(run, [row]))
    part, shown = ("what views see", errors["seen"]) if errors["seen"] else ("all", errors["whole"])
    print(
        f"geometry: Chamfer {shown['chamfer']:.4f}, F-score {shown['f_score']:.3f} at "
        f"{shown['distance']:.3g} scene units (of {part})"
    )
    return files


def measure_geometry(run: TrainedRun, mesh, signed_distance: Callable) -> dict:
    """Chamfer distances of the mesh from the scene's true surface, scene units."""
    scene, num = run.problem.scene, FLAGS.num_samples
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
    drawn = sample_mesh(mesh, num, seed=run.seed)
    distance = DISTANCE_SHARE * side
    errors = geometry_error(scene, drawn, true[:num], true[num:], distance=distance)
    return {"unit": "scene units", "num_points": num, **errors}


def _write_vertices(path: pathlib.Path, scene: Scene, positions, rgb, values: dict, *faces) -> None:
    """A `.ply` of points with colour and uncertainty, and of faces between them if there are any.

    Args:
      path: where to.
      scene: the scene.
      positions: [N, 3] scene units.
      rgb: [N, 3].
      values: from `point_fn` at the positions.
      faces: [F, 3], of a mesh.
    """
    numbers = in_user_units(scene, values)
    numbers = {name: numbers[name] for name in ("uncertainty", "sigma")}
    _write(path, ply_bytes(user_points(scene, positions), rgb, numbers, *faces))


def _write(path: pathlib.Path, data: bytes) -> None:
    write_atomic(path, lambda file: file.write(data))


if __name__ == "__main__":
    script.run_on_trained(export)
