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

from absl import flags

from bavs_jax.export.field import MIN_OPACITY, grid_axes
from bavs_jax.export.mesh import default_threshold
from bavs_jax.scenes.poses import user_units
from experiments.build_scene import true_surface
from experiments.files import write_json
from experiments.posthoc import field_files, script
from experiments.posthoc.points import scene_point_fn, slices_figure
from experiments.report.panels import save_figure
from experiments.trained import TrainedRun, run_curvature, run_variance

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
    field_files.check_libraries(FLAGS.what)
    for run in script.trained_runs():
        for name, path in export_run(run).items():
            print(f"{name + ':':20}{path}")
    print(f"({time.monotonic() - start:.0f} s in all)")


def export_run(run: TrainedRun) -> dict[str, pathlib.Path]:
    """All files of one run, by what they are."""
    scene, folder = run.problem.scene, run.folder / "export"
    point_fn = scene_point_fn(run, run_variance(run, run_curvature(run)))
    files, axes, grid = {}, grid_axes(scene.box, FLAGS.resolution), None
    if {"grid", "mesh"} & set(FLAGS.what):
        grid = field_files.read_grid(point_fn, axes)
    if "grid" in FLAGS.what:
        files |= field_files.write_grid(folder, scene, axes, grid)
        files["slices"] = folder / "slices.png"
        save_figure(slices_figure(axes, grid, scene.box), files["slices"])
    if "points" in FLAGS.what:
        files |= field_files.write_points(
            folder,
            run,
            point_fn,
            min_opacity=FLAGS.min_opacity,
            max_points=FLAGS.max_points,
            beyond_box=FLAGS.beyond_box,
        )
    if "mesh" in FLAGS.what:
        files |= export_mesh(run, folder, axes, grid["density"], point_fn)
    return files


def export_mesh(run: TrainedRun, folder: pathlib.Path, axes, density, point_fn) -> dict:
    """The mesh, and its distance from the true surface where that is known."""
    scene = run.problem.scene
    threshold = FLAGS.density_threshold * user_units(scene) or default_threshold(scene.box)
    mesh = field_files.make_mesh(scene, axes, density, threshold=threshold, min_part=FLAGS.min_part)
    files = field_files.write_mesh(folder, scene, mesh, point_fn)
    signed_distance = true_surface(run.config)
    if signed_distance is None:
        return files
    errors = field_files.measure_geometry(run, mesh, signed_distance, num=FLAGS.num_samples)
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


if __name__ == "__main__":
    script.run_on_trained(export)
