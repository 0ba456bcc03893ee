"""Writes a trained field and its uncertainty into files that other programs read.

    python -m experiments.export_field --workdir=runs/quickstart
    python -m experiments.export_field --config=experiments/configs/quickstart.py --workdir=NEW

The first takes up a run of a folder; the second trains first. Writes into
WORKDIR/<policy>/seed_<n>/export:

    grid.npz                 density and sigma (standard deviation of the offset) on a regular grid
    density.nrrd and others  the same as volumes, in the coordinates of your own files
    points.ply               where training rays end, coloured, with `uncertainty` and `sigma`
    mesh.ply                 the surface at a density, with the same at each vertex
    geometry.json            distance of the mesh from the true surface, where that is known

Needs `pip install 'bavs_jax[export]'`. For density, sigma and colour at points of your own, see
`TrainedRun.point_fn` in experiments/trained.py.
"""

import pathlib
from collections.abc import Callable
from functools import partial

import numpy as np
from absl import flags

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
from experiments import posthoc, runtime
from experiments.build import stream_key, true_surface
from experiments.build_model import RENDER_CHUNK
from experiments.files import write_arrays, write_atomic
from experiments.reporting.result_tables import geometry_table
from experiments.reporting.tables import markdown
from experiments.runtime import ConfigError, track
from experiments.trained import TrainedRun

# Of the box's longest side: the shell that the true surface is drawn from, and how far from that
# surface a drawn point may be; both far below the mean distance between drawn points.
SHELL_SHARE, SURFACE_TOLERANCE = 5e-3, 5e-5

VOLUMES = {  # name of the file: what it holds, and its unit in the user's coordinates
    "density": "density, 1 / user unit",
    "sigma": "standard deviation of the offset, user units",
    "uncertainty": "log10 of sigma in thirds of the box's mean side, [-3, 6] put on [0, 1]",
}
NEEDED = {"grid": ["nrrd"], "points": ["trimesh"], "mesh": ["trimesh", "skimage.measure"]}

FLAGS = flags.FLAGS
posthoc.define_flags()
flags.DEFINE_list("what", list(NEEDED), f"What to write, of {','.join(NEEDED)}.")
flags.DEFINE_integer("resolution", 128, "Grid points along the longest side of the box.", 2, 1024)
THRESHOLD = (
    "Density at the mesh's surface, 1 / user unit. 0: a wall of 1 % of the box's longest side then "
    "lets half of the light through."
)
flags.DEFINE_float("density_threshold", 0.0, THRESHOLD, 0.0, 1e9)
flags.DEFINE_float("min_part", 0.0, "Least share of the mesh's area of a part.", 0.0, 0.999)
flags.DEFINE_float("min_opacity", MIN_OPACITY, "Of rays that end in the cloud.", 1e-6, 1.0)
flags.DEFINE_integer("max_points", 500_000, "Rays for the cloud, at random; 0: all.", 0, 10**9)
flags.DEFINE_bool("beyond_box", False, "Keep points of the cloud that lie outside the scene box.")
flags.DEFINE_integer("num_samples", 200_000, "Points for the geometry error.", 1, 10**7)


def export_run(run: TrainedRun) -> None:
    """All files of one run."""
    scene, folder = run.problem.scene, run.folder / "export"
    point_fn, axes, grid = run.point_fn(), grid_axes(scene.box, FLAGS.resolution), {}
    if {"grid", "mesh"} & set(FLAGS.what):
        with track(int(np.prod([*map(len, axes)])), "read the grid", "points") as bar:
            grid = sample_grid(partial(point_fn, progress_fn=bar.advance), axes)
    if "grid" in FLAGS.what:
        write_grid(folder, scene, axes, grid)
    if "points" in FLAGS.what:
        write_points(folder, run, point_fn)
    if "mesh" in FLAGS.what:
        write_mesh(folder, run, axes, grid["density"], point_fn)


def in_user_units(scene: Scene, values: dict) -> dict:
    """What `VOLUMES` names, from densities and standard deviations in scene units."""
    unit = user_units(scene)
    log_sigma = np.log10(values["sigma"] / offset_unit(scene.box))
    return {
        "density": values["density"] / unit,
        "sigma": values["sigma"] * unit,
        "uncertainty": np.asarray(finish_uncertainty(log_sigma, scale="log")),
    }


def write_grid(folder: pathlib.Path, scene: Scene, axes, grid: dict) -> None:
    """`grid.npz` in scene units, whose axes the grid follows, and volumes in the user's."""
    write_arrays(
        folder / "grid.npz",
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
    print(f"grid: {folder / 'grid.npz'}")
    for name, values in in_user_units(scene, grid).items():
        about = {"user_from_scene": scene.user_from_scene, "content": VOLUMES[name]}
        _write(folder / f"{name}.nrrd", nrrd_bytes(values, axes, **about))


def write_points(folder: pathlib.Path, run: TrainedRun, point_fn: Callable) -> None:
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


def write_mesh(folder: pathlib.Path, run: TrainedRun, axes, density, point_fn: Callable) -> None:
    """`mesh.ply`, and its distance from the true surface where that is known.

    Content beyond an unbounded scene's box is cut, not closed. Each vertex has the colour that it
    has when looked at straight on.
    """
    scene = run.problem.scene
    threshold = FLAGS.density_threshold * user_units(scene) or default_threshold(scene.box)
    mesh = extract_mesh(density, axes, threshold=threshold, closed=not scene.unbounded)
    mesh = without_small_parts(mesh, min_share=FLAGS.min_part)
    directions = -np.asarray(mesh.vertex_normals)
    with track(len(mesh.vertices), "colour the mesh", "vertices") as bar:
        values = point_fn(mesh.vertices, directions=directions, progress_fn=bar.advance)
    path = folder / "mesh.ply"
    _write_vertices(path, scene, mesh.vertices, values["rgb"], values, mesh.faces)
    signed_distance = true_surface(run.problem.config)
    if signed_distance is not None:
        options = {"density_threshold": threshold, "min_part": FLAGS.min_part}
        errors = measure_geometry(run, mesh, signed_distance)
        rows = [{"resolution": FLAGS.resolution, **options, **errors}]
        posthoc.write_rows(folder / "geometry.json", run, rows)
        print(f"geometry: {folder / 'geometry.json'}\n{markdown(geometry_table(rows))}")


def measure_geometry(run: TrainedRun, mesh, signed_distance: Callable) -> dict:
    """Chamfer distances of the mesh from the scene's true surface, scene units."""
    scene, num = run.problem.scene, FLAGS.num_samples
    side = float(np.max(scene.box[1] - scene.box[0]))
    key, about = stream_key(run.seed, "surface"), (signed_distance, scene.box, 2 * num)
    accuracy = {"band": SHELL_SHARE * side, "tolerance": SURFACE_TOLERANCE * side}
    print(f"geometry: draws {num} points on each surface")
    true, drawn = sample_surface(key, *about, **accuracy), sample_mesh(mesh, num, seed=run.seed)
    distance = DISTANCE_SHARE * side
    errors = geometry_error(scene, drawn, true[:num], true[num:], distance=distance)
    return {"unit": "scene units", "num_points": num, **errors}


def _write_vertices(path: pathlib.Path, scene: Scene, positions, rgb, values: dict, *faces) -> None:
    """A `.ply` of points [N, 3], scene units, with colours [N, 3], uncertainty and any faces."""
    numbers = in_user_units(scene, values)
    del numbers["density"]
    _write(path, ply_bytes(user_points(scene, positions), rgb, numbers, *faces))


def _write(path: pathlib.Path, data: bytes) -> None:
    write_atomic(path, lambda file: file.write(data))
    print(f"{path.stem}: {path}")


def main() -> None:
    what = FLAGS.what
    if not what or not {*what} <= {*NEEDED}:
        raise ConfigError(f"--what: {what} cannot be used: give some of {','.join(NEEDED)}")
    for module in [module for name in what for module in NEEDED[name]]:
        import_extra(module)  # one that is missing ends here, before anything is computed
    for run in posthoc.trained_runs():
        export_run(run)


if __name__ == "__main__":
    runtime.run_script(main)
