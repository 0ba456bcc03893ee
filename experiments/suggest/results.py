"""From a suggestion to its files: the chosen poses in several formats, numbers and the page."""

from __future__ import annotations

import csv
import io
import math
import pathlib

import numpy as np
from markupsafe import Markup
from scipy.spatial.transform import Rotation

from bavs_jax.cameras import Cameras, num_pixels, reduced_cameras, take
from bavs_jax.placement.collect import Proposals
from bavs_jax.rendering.images import render_views
from bavs_jax.scenes.base import photo_cameras
from bavs_jax.scenes.poses import user_transforms
from bavs_jax.selection.route import route_length, shortest_route
from experiments.build import Problem
from experiments.build_model import RENDER_CHUNK
from experiments.files import write_atomic, write_json
from experiments.reporting.page import write_template
from experiments.reporting.pictures import (
    UNCERTAINTY_MAP,
    colourise,
    png_uri,
    shrink,
    uncertainty_limits,
)
from experiments.runtime import device_name, peak_memory_mb, track
from experiments.suggest import page
from experiments.suggest.choosing import Suggestion, photo_rays
from experiments.suggest.places import Options, Surroundings, photos_in_matter

SECONDS_PER_VIEW = 2.0
FPS = 24
CSV_COLUMNS = (
    *("order", "x", "y", "z", "qx", "qy", "qz", "qw", "look_x", "look_y", "look_z"),
    *("score", "share_of_best", "picked"),
)
# By our lens: nerfstudio's camera_model, and the camera_type of its camera paths.
LENS_NAMES = {
    "pinhole": ("OPENCV", "perspective"),
    "opencv": ("OPENCV", "perspective"),
    "fisheye": ("OPENCV_FISHEYE", "fisheye"),
}
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
MAX_SIDE = 300  # pixels of a preview


# --- chosen poses as files: nerfstudio's transforms and camera path, and CSV ---------------------


def write_transforms(path: pathlib.Path, poses, cameras: Cameras, rows: list[dict]) -> None:
    """A nerfstudio `transforms.json` of views that are yet to be taken.

    Args:
      path: the file.
      poses: [k, 4, 4] in the coordinates to write.
      cameras: [k] their lenses and image sizes.
      rows: [k] what else is known of each: `order`, `picked`, `score`, `share_of_best`.
    """
    frames = []
    for i, row in enumerate(rows):
        fx, fy, cx, cy = (float(x) for x in cameras.intrinsics[i])
        width, height = (int(n) for n in cameras.sizes[i])
        frame = {
            "file_path": f"next/{row['order']:03d}.png",
            "transform_matrix": np.asarray(poses[i], float).tolist(),
            **{"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": width, "h": height},
        }
        distortion = np.asarray(cameras.distortion[i], float)
        frames.append(frame | dict(zip(DISTORTION, distortion.tolist())) | row)
    model = LENS_NAMES[cameras.lens][0]
    write_json(path, {"camera_model": model, "frames": frames})


def write_camera_path(path: pathlib.Path, poses, cameras: Cameras) -> None:
    """A camera path as nerfstudio's viewer saves it: it stands at each pose in turn.

    `fov` is vertical, in degrees; the path renders without lens distortion.
    """
    width, height = (int(n) for n in cameras.sizes[0])
    views = []
    for i, pose in enumerate(poses):
        own_width, own_height = (int(n) for n in cameras.sizes[i])
        fov = 2.0 * math.degrees(math.atan(0.5 * own_height / float(cameras.intrinsics[i, 1])))
        matrix = np.asarray(pose, float).reshape(-1).tolist()
        views.append({"camera_to_world": matrix, "fov": fov, "aspect": own_width / own_height})
    value = {
        "camera_type": LENS_NAMES[cameras.lens][1],
        "render_height": height,
        "render_width": width,
        "fps": FPS,
        "seconds": SECONDS_PER_VIEW * len(views),
        "smoothness_value": 0.0,
        "is_cycle": False,
        "keyframes": [],
        "camera_path": views,
    }
    write_json(path, value)


def write_csv(path: pathlib.Path, poses, rows: list[dict]) -> None:
    """One line per pose: place, quaternion (OpenGL axes), look direction, and what it is worth."""
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(CSV_COLUMNS)
    for pose, row in zip(np.asarray(poses, float), rows):
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()  # x, y, z, w
        numbers = [*pose[:3, 3], *quaternion, *-pose[:3, 2], row["score"], row["share_of_best"]]
        cells = ["" if n is None else f"{n:.9g}" for n in numbers]
        writer.writerow([row["order"], *cells, row["picked"]])
    write_atomic(path, lambda file: file.write(text.getvalue().encode()))


# --- what is shown of them -------------------------------------------------------------------


def preview_cards(images: list[dict], rows: list[dict], poses, facts) -> tuple[list, dict]:
    """One card per pose with its render and uncertainty, and the scale of the latter."""
    limits = uncertainty_limits([{"uncertainty": image["uncertainty"][None]} for image in images])
    cards = []
    for image, row, pose, fact in zip(images, rows, poses, facts):
        rgb = np.round(255.0 * np.clip(image["rgb"], 0.0, 1.0)).astype(np.uint8)
        uncertainty = colourise(shrink(image["uncertainty"], MAX_SIDE), *limits, UNCERTAINTY_MAP)
        cards.append(
            {
                "row": row,
                "place": pose[:3, 3],
                "look": -pose[:3, 2],
                "sentence": fact.sentence(),
                "render": png_uri(shrink(rgb, MAX_SIDE)),
                "uncertainty": png_uri(uncertainty),
                "mean": f"{image['uncertainty'].mean():.3f}",
            }
        )
    ramp = colourise(np.linspace(*limits, 256)[None], *limits, UNCERTAINTY_MAP)
    bar = {"uri": png_uri(ramp), "low": f"≤ {limits[0]:.2f}", "high": f"≥ {limits[1]:.2f}"}
    return cards, bar


def visiting_order(places, options: Options, last_photo) -> tuple[np.ndarray, str]:
    """The order of the files, as indices of the picks, and the route in words.

    Args:
      places: [k, 3] chosen places in the user's coordinates.
      options: whether a route is wanted, and from where.
      last_photo: [3] where it begins if `options.start` is None.
    """
    if not options.route:
        return np.arange(len(places)), ""
    start = last_photo if options.start is None else options.start
    order = shortest_route(start, places)
    found = route_length(start, places, order)
    before = route_length(start, places, np.arange(len(places)))
    origin = "the last photo" if options.start is None else "the given start"
    route = (
        f"The poses are numbered along a route of {page.length(found)} from {origin} "
        f"({', '.join(f'{x:.3g}' for x in start)}); in the order of picking it would be "
        f"{page.length(before)}."
    )
    return order, route


def make_rows(suggestion: Suggestion, order) -> list[dict]:
    """What the files say of each pose, in their order."""
    picked, first = suggestion.worth.picked, suggestion.worth.best_left[0]
    return [
        {
            "order": place + 1,
            "picked": int(pick) + 1,
            "score": float(suggestion.scores[suggestion.selected[pick]]),
            "share_of_best": float(picked[pick] / first) if first > 0.0 else None,
        }
        for place, pick in enumerate(order)
    ]


def render_uncertain(problem: Problem, train, jac_sq_sum, cameras: Cameras, label: str) -> list:
    """Colour, opacity and uncertainty of every camera."""
    render = problem.render(train, jac_sq_sum, photo_rays(problem))
    rays_per_pixel = problem.config.rays_per_pixel
    with track(rays_per_pixel * int(num_pixels(cameras).sum()), label, "rays") as bar:
        return render_views(
            render,
            cameras,
            np.arange(len(cameras)),
            chunk=RENDER_CHUNK,
            rays_per_pixel=rays_per_pixel,
            progress_fn=bar.advance,
        )


def write_results(
    folder: pathlib.Path,
    *,
    problem: Problem,
    train,
    jac_sq_sum,
    around: Surroundings,
    proposals: Proposals,
    cameras: Cameras,
    suggestion: Suggestion,
    options: Options,
    quality: dict | None,
    command: str,
    seconds_fn,
) -> dict[str, pathlib.Path]:
    """Writes poses, numbers and the page.

    Args:
      folder: the working folder.
      problem, train, jac_sq_sum: the field and the curvature of the photos.
      around, proposals, cameras: where candidates came from, and the C of them.
      suggestion: the choice among them.
      options: what the user asked for.
      quality: measures on photos that were left out, or None.
      command: how the script was called.
      seconds_fn: () -> seconds since the script began.

    Returns:
      The files by name.
    """
    scene = problem.scene
    photos = np.asarray(scene.cameras.world_from_cam, np.float64)

    def density_fn(positions):
        return problem.density(train, positions)

    user_poses = user_transforms(scene, cameras.world_from_cam)
    last_photo = around.to_user(photos[-1, :, 3])
    places = user_poses[suggestion.selected][:, :3, 3]
    order, route_words = visiting_order(places, options, last_photo)
    rows = make_rows(suggestion, order)
    chosen = suggestion.selected[order]
    picked_cameras, poses = take(cameras, chosen), user_poses[chosen]
    files = {
        "poses": folder / "next_views" / "transforms.json",
        "camera path": folder / "next_views" / "camera_path.json",
        "table": folder / "next_views" / "next_views.csv",
        "report": folder / "report.html",
    }
    as_photos = photo_cameras(scene, picked_cameras)
    write_transforms(files["poses"], poses, as_photos, rows)
    write_camera_path(files["camera path"], poses, as_photos)
    # nerfstudio renders a camera path in the coordinates of its own normalisation, which are the
    # scene's: levelled, centred and scaled as by its defaults.
    normalised = files["camera path"].with_name("camera_path_normalised.json")
    scene_poses = np.tile(np.eye(4), (len(chosen), 1, 1))
    scene_poses[:, :3] = picked_cameras.world_from_cam
    write_camera_path(normalised, scene_poses, as_photos)
    write_csv(files["table"], poses, rows)

    small = reduced_cameras(take(scene.cameras, scene.pool), options.score_scale)
    label = f"score the {len(small)} photos"
    seen = render_uncertain(problem, train, jac_sq_sum, small, label)
    label = f"render {len(chosen)} previews"
    images = render_uncertain(problem, train, jac_sq_sum, picked_cameras, label)
    facts = page.pose_facts(
        scene,
        around,
        picked_cameras,
        images,
        photo_uncertainty=np.concatenate([image["uncertainty"].ravel() for image in seen]),
        density_fn=density_fn,
    )
    worth_words = page.worth_sentence(suggestion.worth, suggestion.photo_gain)
    cards, bar = preview_cards(images, rows, poses, facts)
    start = last_photo if options.start is None else options.start
    place = page.place_plot(
        axes=page.levelled_axes(scene.up, photos[:, :, 3], around.focus),
        unit=around.unit,
        focus=around.focus,
        photos=photos,
        candidates=np.asarray(cameras.world_from_cam, np.float64),
        scores=suggestion.scores,
        selected=chosen,
        route_start=around.to_scene(start) if options.route else None,
    )
    width, height = (int(n) for n in picked_cameras.sizes[0])
    info = suggestion.info
    write_template(
        files["report"],
        pathlib.Path(__file__).parent,
        scene=scene,
        options=options,
        around=around,
        proposals=proposals,
        length=page.length,
        portrait=height > width,
        worth=worth_words,
        num_foggy=photos_in_matter(scene, density_fn, around),
        num_unseen=sum(fact.num_seeing == 0 for fact in facts),
        num_left=int(info.survivors.sum()),
        min_distance=float(info.filter.radii.min_train_distance) if info.filter else None,
        half_length=np.log(2.0) / around.solid_density,
        focus=around.to_user(around.focus),
        photo_size=np.asarray(scene.cameras.sizes).max(axis=0),
        route=route_words,
        cards=cards,
        bar=bar,
        place=Markup(place),
        worth_curve=Markup(page.worth_plot(suggestion.worth, suggestion.photo_gain)),
        numbers=page.numbers(rows, poses, facts),
        command=command,
        quality=quality,
        seconds=seconds_fn(),
    )
    worth = suggestion.worth
    summary = {
        "scene": scene.name,
        "command": command,
        "device": device_name(),
        "seconds": seconds_fn(),
        "peak_memory_mb": peak_memory_mb(),
        "drawn": proposals.num_drawn,
        "kept": len(proposals.poses),
        "dropped": proposals.dropped,
        "best_gain": float(worth.best_left[0]),  # nats, as the next two
        "best_left": [None if np.isnan(x) else float(x) for x in worth.best_left],
        "photo_gain": suggestion.photo_gain,
        "worth": worth_words,
        "views": [
            row | {"share_high": fact.share_high, "why": fact.sentence()}
            for row, fact in zip(rows, facts)
        ],
    }
    write_json(folder / "suggestion.json", summary)
    return files
