"""Exports a trained field and its uncertainty as a grid, a point cloud and a mesh.

    python -m experiments.export_field --workdir=runs/quickstart

takes up a run of `experiments.active_selection`, finished or not, and writes into
`<workdir>/<policy>/seed_<n>/export/`:

    grid.npz                 density and sigma (standard deviation of the offset) on a regular grid
    density.nrrd and others  the same as volumes, in the coordinates of your own files
    points.ply               where training rays end, coloured, with `uncertainty` and `sigma`
    mesh.ply                 the surface at a density, with the same at each vertex
    geometry.json            distance of the mesh from the true surface, where that is known

Needs `pip install 'bavs_jax[export]'`. For density, sigma and colour at points of your own, see
`load_trained` and `user_point_fn` in experiments/trained.py.
"""

from __future__ import annotations

import math
import pathlib
import sys
import time

import numpy as np
from absl import flags

from bavs_jax.export.cloud import MIN_OPACITY
from bavs_jax.export.extras import ExportError
from bavs_jax.export.grid import grid_axes
from bavs_jax.export.mesh import default_threshold
from bavs_jax.scenes.poses import user_units
from experiments import field_files, runtime
from experiments.build_scene import true_surface
from experiments.errors import USER_ERRORS
from experiments.files import write_json
from experiments.progress import track
from experiments.trained import Trained, bind_point_fn, fit_variance, load_trained

SCHEMA_VERSION = 1
WHAT = ("grid", "points", "mesh")

FLAGS = flags.FLAGS
flags.DEFINE_string("workdir", None, "Folder of a run of experiments.active_selection.")
flags.DEFINE_string("policy", "", "Whose run; initial: round 0. Empty: the config's first policy.")
flags.DEFINE_integer("seed", None, "Which run of it; by default the config's first seed.")
flags.DEFINE_string("data_dir", "", "Folder of scenes, if it has moved since the run.")
flags.DEFINE_list("what", list(WHAT), f"What to write, of {','.join(WHAT)}.")
flags.DEFINE_integer("resolution", 128, "Grid points along the longest side of the scene box.")
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
flags.DEFINE_bool("compilation_cache", True, "Keep compiled programs for the next start.")


def check_flags() -> None:
    """Raises ExportError for a flag that cannot be used."""
    unknown = sorted(set(FLAGS.what) - set(WHAT))
    for name, good, fix in (
        ("what", FLAGS.what and not unknown, f"give some of {','.join(WHAT)}"),
        ("resolution", FLAGS.resolution >= 2, "give 2 or more"),
        (
            "density_threshold",
            FLAGS.density_threshold >= 0.0 and math.isfinite(FLAGS.density_threshold),
            "give a number above 0, or 0 for the default",
        ),
        ("min_part", 0.0 <= FLAGS.min_part < 1.0, "give a share from 0 up to below 1"),
        ("min_opacity", 0.0 < FLAGS.min_opacity <= 1.0, "give a share above 0 and up to 1"),
        ("max_points", FLAGS.max_points >= 0, "give a number above 0, or 0 for all"),
        ("num_samples", FLAGS.num_samples >= 1, "give 1 or more"),
    ):
        if not good:
            raise ExportError(f"--{name}: {FLAGS[name].value!r} cannot be used: {fix}")


def export_mesh(trained: Trained, folder: pathlib.Path, axes, density, point_fn, about) -> dict:
    """The mesh, and its distance from the true surface where that is known."""
    scene = trained.problem.scene
    threshold = FLAGS.density_threshold * user_units(scene) or default_threshold(scene.box)
    mesh = field_files.make_mesh(scene, axes, density, threshold=threshold, min_part=FLAGS.min_part)
    files = field_files.write_mesh(folder, scene, mesh, point_fn)
    signed_distance = true_surface(trained.config)
    if signed_distance is None:
        return files
    errors = field_files.measure_geometry(trained, mesh, signed_distance, num=FLAGS.num_samples)
    files["geometry"] = folder / "geometry.json"
    write_json(files["geometry"], about | {"density_threshold": threshold} | errors)
    part, shown = ("what views see", errors["seen"]) if errors["seen"] else ("all", errors["whole"])
    print(
        f"geometry: Chamfer {shown['chamfer']:.4f}, F-score {shown['f_score']:.3f} at "
        f"{shown['distance']:.3g} scene units (of {part})"
    )
    return files


def export(workdir: pathlib.Path) -> None:
    """Loads the run, computes its uncertainty and writes what was asked for."""
    start = time.monotonic()
    field_files.check_libraries(FLAGS.what)
    trained = load_trained(
        workdir,
        policy=FLAGS.policy,
        seed=FLAGS.seed,
        data_dir=FLAGS.data_dir,
        cache=str(runtime.cache_folder() / "scenes"),
    )
    scene, folder = trained.problem.scene, trained.folder / "export"
    num_views = int(np.sum(trained.situation.is_training_view))
    state = "the end of" if trained.completed else "the last checkpoint of"
    print(
        f"{scene.name}: {state} {trained.policy} seed {trained.seed}, "
        f"round {trained.round}, {num_views} training views"
    )
    about = {
        "schema_version": SCHEMA_VERSION,
        "command": runtime.command_line(),
        "scene": scene.name,
        "policy": trained.policy,
        "seed": trained.seed,
        "round": trained.round,
        "completed": trained.completed,
        "num_views": num_views,
        "resolution": FLAGS.resolution,
    }
    point_fn = bind_point_fn(trained, fit_variance(trained, track))
    files, axes, grid = {}, grid_axes(scene.box, FLAGS.resolution), None
    if {"grid", "mesh"} & set(FLAGS.what):
        grid = field_files.read_grid(point_fn, axes)
    if "grid" in FLAGS.what:
        files |= field_files.write_grid(folder, scene, axes, grid)
    if "points" in FLAGS.what:
        files |= field_files.write_points(
            folder,
            trained,
            point_fn,
            min_opacity=FLAGS.min_opacity,
            max_points=FLAGS.max_points,
            beyond_box=FLAGS.beyond_box,
        )
    if "mesh" in FLAGS.what:
        files |= export_mesh(trained, folder, axes, grid["density"], point_fn, about)
    for name, path in files.items():
        print(f"{name + ':':20}{path}")
    print(f"({time.monotonic() - start:.0f} s in all)")


def main() -> None:
    if not FLAGS.workdir:
        sys.exit("error: --workdir: is missing; name the folder of a run")
    if FLAGS.compilation_cache:
        runtime.use_compilation_cache(runtime.cache_folder() / "compiled")
    try:
        check_flags()
        export(pathlib.Path(FLAGS.workdir))
    except USER_ERRORS as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    runtime.run_script(main)
