"""A suggestion as files: the chosen poses in several formats, numbers, and a page with reasons."""

import csv
import io
import math
import pathlib
import time
from functools import partial

import numpy as np
from markupsafe import Markup
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter
from scipy.spatial.transform import Rotation

from bavs_jax.cameras import Cameras, look_at, reduced_cameras, take
from bavs_jax.placement.seen import count_seeing
from bavs_jax.scenes import Scene
from bavs_jax.scenes.poses import scene_points, user_points, user_transforms, user_units
from bavs_jax.selection.route import route_length, shortest_route
from bavs_jax.selection.worth import Worth
from experiments.choices import nerfstudio_frames, write_frames
from experiments.evaluate import render_with_bar
from experiments.files import read_json, write_atomic, write_json
from experiments.reporting import plots
from experiments.reporting.camera_map import SCORE_MAP
from experiments.reporting.pictures import (
    Panel,
    colour_bar,
    panel_table,
    shrink,
    uncertainty_limits,
)
from experiments.reporting.tables import Cell, Section, Table, dash, write_page
from experiments.runtime import made_by, peak_memory_mb, warn
from experiments.suggestion import Options, Suggestion, in_matter
from experiments.trained import TrainedRun

SECONDS_PER_VIEW, FPS = 2.0, 24
CSV_COLUMNS = (
    *("order", "x", "y", "z", "qx", "qy", "qz", "qw", "look_x", "look_y", "look_z"),
    *("score", "share_of_best", "picked"),
)
MAX_SIDE = 300  # pixels of a preview
RARE = 90.0  # percentile of the photos' pixels above which uncertainty counts as high
FOGGY = 0.1  # share of the photos inside of matter from which on the field counts as foggy
NUDGE = np.array([1e-9, 0.0, 0.0])  # scene units; gives a direction where there is none


def write_results(
    folder: pathlib.Path,
    run: TrainedRun,
    jac_sq_sum,
    found: Suggestion,
    options: Options,
    begin: float,
) -> dict[str, pathlib.Path]:
    """Writes poses, numbers and the page; the files by name.

    `jac_sq_sum` [G, 3] is the curvature of the photos, `begin` when the script began, by
    `time.monotonic`.
    """
    scene, moved = run.problem.scene, found.ascent
    worth, first = found.worth, found.worth.best_left[0]
    start = options.start
    if start is None:
        start = user_points(scene, scene.cameras.positions)[-1]
    places = user_points(scene, found.cameras.positions)[found.selected]
    order = shortest_route(start, places) if options.route else np.arange(len(places))
    chosen = found.selected[order]
    cameras = take(found.cameras, chosen)
    rows = [
        {
            "order": place + 1,
            "picked": int(pick) + 1,
            "score": float(found.scores[found.selected[pick]]),
            "share_of_best": float(worth.picked[pick] / first) if first > 0.0 else None,
        }
        for place, pick in enumerate(order)
    ]
    files = write_poses(folder / "next_views", scene, cameras, rows)

    small = reduced_cameras(take(scene.cameras, scene.pool), run.problem.setup.image_scale)
    render = partial(
        render_with_bar,
        run.problem.render(run.state.train, jac_sq_sum, run.num_rays),
        rays_per_pixel=run.problem.config.rays_per_pixel,
    )
    seen = render(small, np.arange(len(small)), f"score the {len(small)} photos")
    images = render(cameras, np.arange(len(rows)), f"render {len(rows)} previews")
    high = np.percentile(np.concatenate([image["uncertainty"].ravel() for image in seen]), RARE)
    density_fn = partial(run.problem.density, run.state.train)
    is_high = [image["uncertainty"] > high for image in images]
    poses = np.asarray(cameras.world_from_cam, np.float64)
    facts = [pose_facts(scene, *pair, density_fn) for pair in zip(poses, is_high)]
    made = made_by()
    versions = made.pop("versions")  # of the page alone
    summary = {
        "scene": scene.name,
        **made,
        "seconds": time.monotonic() - begin,
        "peak_memory_mb": peak_memory_mb(),
        "drawn": found.proposals.num_drawn,
        "kept": len(found.proposals.poses),
        "dropped": found.proposals.dropped,
        "best_gain": float(first),  # nats, as the next two
        "best_left": [None if np.isnan(x) else float(x) for x in worth.best_left],
        "photo_gain": found.photo_gain,
        "refined": moved and {name: getattr(moved, name).tolist() for name in ("before", "after")},
        "worth": worth_words(worth, found.photo_gain),
        "views": [
            row
            | {"share_high": float(high_pixels.mean())}
            | {"why": "; ".join(f"{name} {text}" for name, text in fact.items())}
            for row, fact, high_pixels in zip(rows, facts, is_high)
        ],
    }
    sections = [
        Section(
            "The chosen poses",
            pose_table(user_transforms(scene, poses), rows, facts),
            f"High pixels: more uncertain than {RARE:.0f} % of the photos' pixels.",
            preview_plots(images),
        ),
        Section(
            "The place",
            note=Markup("<br>").join(place_notes(run, found, options, facts)),
            plots=place_plots(scene, found, chosen, start if options.route else None),
        ),
        Section("When to stop", note=summary["worth"], plots=[worth_plot(worth, found.photo_gain)]),
    ]
    if options.route:
        length = route_length(start, places, order)
        print(f"route: {length:.3g} units from ({', '.join(f'{x:.3g}' for x in start)})")
    files["report"] = folder / "report.html"
    title, made = f"Where to stand next: {scene.name}", summary | {"versions": versions}
    write_page(files["report"], title=title, made=made, sections=sections)
    write_json(folder / "suggestion.json", summary)
    return files


# --- chosen poses as files: nerfstudio's transforms and camera paths, and CSV ---


def write_poses(
    folder: pathlib.Path, scene: Scene, cameras: Cameras, rows: list[dict]
) -> dict[str, pathlib.Path]:
    """Writes the chosen poses, cameras [k], in every format; the files by name.

    Of each pose its row knows `order`, `picked`, `score` and `share_of_best`.
    """
    frames = [
        {"file_path": f"next/{row['order']:03d}.png", **frame, **row}
        for row, frame in zip(rows, nerfstudio_frames(scene, cameras))
    ]
    files = {
        "poses": folder / "transforms.json",
        "camera path": folder / "camera_path.json",
        "table": folder / "next_views.csv",
    }
    write_frames(files["poses"], scene, frames)
    lens = scene.cameras.lens
    write_camera_path(files["camera path"], frames, lens)
    # nerfstudio renders a camera path in the coordinates of its own normalisation, which are the
    # scene's: levelled, centred and scaled as by its defaults.
    poses = np.asarray(cameras.world_from_cam, float).tolist()
    bottom = [0.0, 0.0, 0.0, 1.0]
    pairs = zip(frames, poses)
    normalised = [frame | {"transform_matrix": [*pose, bottom]} for frame, pose in pairs]
    write_camera_path(folder / "camera_path_normalised.json", normalised, lens)
    write_csv(files["table"], frames)
    return files


def write_camera_path(path: pathlib.Path, frames: list[dict], lens: str) -> None:
    """A camera path as nerfstudio's viewer saves it: it stands at each pose in turn.

    `fov` is vertical, in degrees; the path renders without lens distortion.
    """
    views = [
        {
            "camera_to_world": np.reshape(frame["transform_matrix"], -1).tolist(),
            "fov": 2.0 * math.degrees(math.atan(0.5 * frame["h"] / frame["fl_y"])),
            "aspect": frame["w"] / frame["h"],
        }
        for frame in frames
    ]
    value = {
        "camera_type": "fisheye" if lens == "fisheye" else "perspective",
        "render_height": frames[0]["h"],
        "render_width": frames[0]["w"],
        "fps": FPS,
        "seconds": SECONDS_PER_VIEW * len(views),
        "smoothness_value": 0.0,
        "is_cycle": False,
        "keyframes": [],
        "camera_path": views,
    }
    write_json(path, value)


def write_csv(path: pathlib.Path, frames: list[dict]) -> None:
    """One line per pose: place, quaternion (OpenGL axes), look direction, and what it is worth."""
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(CSV_COLUMNS)
    for frame in frames:
        pose = np.array(frame["transform_matrix"])
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()  # x, y, z, w
        numbers = [*pose[:3, 3], *quaternion, *-pose[:3, 2], frame["score"], frame["share_of_best"]]
        cells = ["" if n is None else f"{n:.9g}" for n in numbers]
        writer.writerow([frame["order"], *cells, frame["picked"]])
    write_atomic(path, lambda file: file.write(text.getvalue().encode()))


# --- what is said of them ---


def pose_facts(scene: Scene, pose, is_high, density_fn) -> dict[str, str]:
    """What speaks for a pose [3, 4], and what to mind, by name; lengths in the user's units.

    `is_high` [H, W] marks pixels of its render that are more uncertain than nearly all of the
    photos'; `density_fn` as in `propose`.
    """
    cameras = take(scene.cameras, scene.pool)
    photos = np.asarray(cameras.world_from_cam, np.float64)
    distances = np.linalg.norm(photos[:, :, 3] - pose[:, 3], axis=-1)
    nearest = int(np.argmin(distances))
    cosine = np.clip(photos[nearest, :, 2] @ pose[:, 2], -1.0, 1.0)
    return {
        "high pixels": f"{is_high.mean():.0%}",
        "nearest photo": scene.names[scene.pool[nearest]],
        "its distance": f"{user_units(scene) * distances[nearest]:.3g} units",
        "turned from it": f"{np.degrees(np.arccos(cosine)):.0f}°",
        "photos that see the place": str(count_seeing(cameras, pose[:, 3], density_fn)),
    }


def pose_table(poses, rows: list[dict], facts: list[dict[str, str]]) -> Table:
    """All poses [k, 4, 4], user units, with the numbers that speak for them."""
    lines = []
    for pose, row, fact in zip(poses, rows, facts):
        share = row["share_of_best"]
        texts = [str(row["order"]), str(row["picked"]), *(f"{x:.3f}" for x in pose[:3, 3])]
        texts += [", ".join(f"{x:.2f}" for x in -pose[:3, 2]), f"{row['score']:.3f}"]
        none = dash("no candidate would tell anything")
        told = none if share is None else Cell(f"{share:.0%}")
        lines.append((*map(Cell, texts), told, *map(Cell, fact.values())))
    head = ("no.", "picked", "x", "y", "z", "looks along", "score", "information, of the best")
    return Table((*head, *facts[0]), tuple(lines))


def worth_words(worth: Worth, photo_gain: float) -> str:
    """How much is left to gain, so that the user can judge when to stop; gains in nats."""
    left = "none" if np.isnan(worth.best_left[-1]) else f"{worth.best_left[-1]:.3g} nats"
    return (
        f"Information of the best candidate: {worth.best_left[0]:.3g} nats at first, after "
        f"{len(worth.picked)} picks {left}; of a photo from where there is one: {photo_gain:.3g}. "
        "Stop when the last two are about the same."
    )


def place_notes(
    run: TrainedRun, found: Suggestion, options: Options, facts: list[dict[str, str]]
) -> list[str]:
    """Warnings, which are printed too, and numbers of the place; lengths in the user's units."""
    scene, around, unit = run.problem.scene, found.around, user_units(run.problem.scene)
    density_fn = partial(run.problem.density, run.state.train)
    inside, _ = in_matter(scene.cameras.positions, density_fn, around)
    unseen = [i for i, fact in enumerate(facts, 1) if fact["photos that see the place"] == "0"]
    lines = []
    if inside.mean() > FOGGY:
        lines.append("many photos stand in what the field takes for matter: raise --train_steps")
    if unseen:
        lines.append(
            f"no photo looks at the places of poses {unseen}: make sure that they are free"
        )
    if not around.faces_focus:
        lines.append("the photos look outwards: shell poses look as the photos near them do")
    for words in lines:
        warn(words)
    focus = ", ".join(f"{x:.3f}" for x in user_points(scene, around.focus))
    lines.append(
        f"{len(scene.pool)} photos to train on, {unit * around.distance:.3g} units in the median "
        f"from what they look at, ({focus}); {inside.sum()} of all are inside of matter"
    )
    clearance = f"clearance {unit * around.clearance:.3g} units"
    lines.append(f"candidates ({options.candidates}): {found.proposals.in_words()}; {clearance}")
    if found.ascent is not None:
        lines.append(f"moving the poses raised their scores {found.ascent.in_words()}")
    quality = read_json(run.folder / "round_0.json")
    if quality and quality["num_test_views"]:
        number = quality["num_test_views"]
        lines.append(f"PSNR {quality['psnr']:.2f} dB on {number} photos left out")
    return lines


# --- what is drawn of them ---


def preview_plots(images: list[dict]) -> list[Markup]:
    """What the field expects at each pose, and how uncertain it is there; in two columns."""
    limits = uncertainty_limits([{"uncertainty": image["uncertainty"][None]} for image in images])
    rows = []
    for number, image in enumerate(images, start=1):
        rgb = shrink(np.uint8(np.round(255.0 * image["rgb"].clip(0.0, 1.0))), MAX_SIDE) / 255.0
        title = f"uncertainty, mean {image['uncertainty'].mean():.3f}"
        uncertainty = Panel(title, shrink(image["uncertainty"], MAX_SIDE), limits=limits)
        rows.append((str(number), [Panel("render", rgb), uncertainty]))
    half = -(-len(rows) // 2)
    return [
        plots.to_svg(
            panel_table(part, scale_label="uncertainty"),
            salt=f"previews-{part[0][0]}",
            label="Renders and uncertainty of the chosen poses",
        )
        for part in (rows[:half], rows[half:])
        if part
    ]


def place_plots(scene: Scene, found: Suggestion, chosen, start) -> list[Markup]:
    """Photos, candidates and chosen poses from above and from behind the photos.

    `chosen` [k] are candidates in the order of the files; a route through them from `start` [3],
    user units, is drawn if that is not None.
    """
    focus, unit, up = found.around.focus, user_units(scene), np.array(scene.up, np.float64)
    photos = np.asarray(scene.cameras.world_from_cam, np.float64)
    candidates = np.asarray(found.cameras.world_from_cam, np.float64)
    back = photos[:, :, 3].mean(axis=0) - focus + NUDGE
    right = look_at(back, np.zeros(3), up)[:, 0]
    norm = Normalize(*np.percentile(found.scores, [1.0, 99.0]))
    drawn = []
    for salt, title, upwards, axis in (
        ("above", "From above", "away from the photos", np.cross(up, right)),
        ("behind", "From behind the photos", "up", up),
    ):
        rows = np.stack([right, axis])

        def flat(points, rows=rows):
            return unit * rows @ (points - focus).T

        figure = Figure(figsize=(5.6, 5.4))
        panel = figure.add_subplot()
        look = {"c": found.scores, "cmap": SCORE_MAP, "norm": norm, "s": 15, "alpha": 0.75, "lw": 0}
        panel.scatter(*flat(candidates[:, :, 3]), label="candidate", **look)
        places, gazes = flat(photos[:, :, 3]), -rows @ photos[:, :, 2].T
        look = {"marker": "^", "s": 22, "color": plots.GREY, "lw": 0, "zorder": 3}
        panel.scatter(*places, label="photo, and where it looks", **look)
        look = {"headwidth": 0, "headlength": 0, "headaxislength": 0, "scale": 26, "width": 0.003}
        panel.quiver(*places, *gazes, color=plots.GREY, alpha=0.35, **look)
        panel.scatter(0.0, 0.0, marker="+", s=90, color=plots.BLACK, label="what photos look at")
        places, gazes = flat(candidates[chosen, :, 3]), -rows @ candidates[chosen, :, 2].T
        look = {"color": plots.VERMILION, "scale": 17, "width": 0.006, "zorder": 5}
        panel.quiver(*places, *gazes, **look)
        look = {"c": "white", "edgecolors": plots.VERMILION, "linewidths": 1.6, "zorder": 6}
        panel.scatter(*places, s=150, label="chosen pose", **look)
        for number, place in enumerate(places.T, start=1):
            look = {"color": plots.VERMILION, "fontsize": 8, "fontweight": "bold", "ha": "center"}
            panel.text(*place, str(number), va="center_baseline", zorder=7, **look)
        if start is not None:
            stops = np.column_stack([flat(scene_points(scene, start)), places])
            panel.plot(*stops, color=plots.VERMILION, linewidth=1.0, zorder=4, label="route")
            panel.scatter(*stops[:, :1], marker="s", s=40, color=plots.BLACK, zorder=5)
        panel.set(title=title, xlabel="to the right (user units)", ylabel=upwards)
        panel.set_aspect("equal", adjustable="datalim")
        colour_bar(figure, [panel], SCORE_MAP, (norm.vmin, norm.vmax), "score: mean uncertainty")
        figure.legend(loc="outside lower left", ncols=3)
        label = f"Photos, candidates and chosen poses: {title}"
        drawn.append(plots.to_svg(figure, salt=salt, label=label))
    return drawn


def worth_plot(worth: Worth, photo_gain: float) -> Markup:
    """What each pick and the best candidate left tell, as shares of the best one's at first."""
    first, picks = float(worth.best_left[0]), np.arange(len(worth.best_left))
    figure = Figure(figsize=(6.4, 3.7))
    axes = figure.add_subplot()
    label = "best candidate left after that many picks"
    axes.plot(picks, worth.best_left / first, "o-", color=plots.BLUE, label=label)
    label = "each pick, after those before"
    axes.plot(picks[1:], worth.picked / first, "s-", color=plots.VERMILION, label=label)
    label = "another photo from where there is one"
    axes.axhline(photo_gain / first, color=plots.GREY, linestyle="--", label=label)
    axes.set_xlabel("picks")
    axes.set_title("Information, as a share of the best candidate's at first")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_ylim(0.0, None)
    axes.legend(loc="lower left")
    return plots.to_svg(figure, salt="worth", label="Worth of the best candidate left")
