"""From a suggestion to its files: order, rows, exports and the page."""

from __future__ import annotations

import pathlib

import numpy as np

from bavs_jax.cameras import Cameras, num_pixels, reduced_cameras, take
from bavs_jax.placement.collect import Proposals
from bavs_jax.rendering.images import render_views
from bavs_jax.scenes.base import photo_cameras
from bavs_jax.scenes.poses import user_transforms
from bavs_jax.selection.route import route_length, shortest_route
from experiments.build import RENDER_CHUNK, Problem
from experiments.files import write_json
from experiments.machine import device_name, peak_memory_mb
from experiments.progress import track
from experiments.suggest import exports, page, plots, words
from experiments.suggest.choosing import Suggestion, photo_rays
from experiments.suggest.facts import length, pose_facts
from experiments.suggest.places import Surroundings, photos_in_matter
from experiments.suggest.settings import Options


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
        f"The poses are numbered along a route of {length(found)} from {origin} "
        f"({', '.join(f'{x:.3g}' for x in start)}); in the order of picking it would be "
        f"{length(before)}."
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


def render_previews(problem: Problem, train, jac_sq_sum, cameras: Cameras) -> list[dict]:
    """Colour, opacity and uncertainty of the chosen poses."""
    render = problem.render(train, jac_sq_sum, photo_rays(problem))
    num_rays = int(num_pixels(cameras).sum())
    with track(num_rays, f"render {len(cameras)} previews", "rays") as bar:
        return render_views(
            render, cameras, np.arange(len(cameras)), chunk=RENDER_CHUNK, progress_fn=bar.advance
        )


def photo_uncertainty(problem: Problem, train, jac_sq_sum, scale: float) -> np.ndarray:
    """Uncertainty of all pixels of the photos at the reduced size."""
    small = reduced_cameras(take(problem.scene.cameras, problem.scene.pool), scale)
    render = problem.render(train, jac_sq_sum, photo_rays(problem))
    num_rays = int(num_pixels(small).sum())
    with track(num_rays, f"score the {len(small)} photos", "rays") as bar:
        images = render_views(
            lambda rays: {"uncertainty": render(rays)["uncertainty"]},
            small,
            np.arange(len(small)),
            chunk=RENDER_CHUNK,
            progress_fn=bar.advance,
        )
    return np.concatenate([image["uncertainty"].ravel() for image in images])


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

    def density_fn(positions):
        return problem.density(train, positions)

    user_poses = user_transforms(scene, cameras.world_from_cam)
    photo_places = around.to_user(np.asarray(scene.cameras.positions))
    places = user_poses[suggestion.selected][:, :3, 3]
    order, route_words = visiting_order(places, options, photo_places[-1])
    rows = make_rows(suggestion, order)
    chosen = suggestion.selected[order]
    picked_cameras, poses = take(cameras, chosen), user_poses[chosen]
    as_photos = photo_cameras(scene, picked_cameras)

    files = {
        "poses": folder / "next_views" / "transforms.json",
        "camera path": folder / "next_views" / "camera_path.json",
        "table": folder / "next_views" / "next_views.csv",
        "report": folder / "report.html",
    }
    exports.write_transforms(files["poses"], poses, as_photos, rows)
    exports.write_camera_path(files["camera path"], poses, as_photos)
    # nerfstudio renders a camera path in the coordinates of its own normalisation, which are the
    # scene's: levelled, centred and scaled as by its defaults.
    normalised = files["camera path"].with_name("camera_path_normalised.json")
    scene_poses = np.tile(np.eye(4), (len(chosen), 1, 1))
    scene_poses[:, :3] = picked_cameras.world_from_cam
    exports.write_camera_path(normalised, scene_poses, as_photos)
    exports.write_csv(files["table"], poses, rows)

    pixels = photo_uncertainty(problem, train, jac_sq_sum, options.score_scale)
    images = render_previews(problem, train, jac_sq_sum, picked_cameras)
    facts = pose_facts(
        scene,
        around,
        picked_cameras,
        images,
        photo_uncertainty=pixels,
        density_fn=density_fn,
    )
    worth_words = words.worth_sentence(suggestion.worth, suggestion.photo_gain)
    foggy = photos_in_matter(scene, density_fn, around)

    cards_rows = [row | {"place": words.place_words(pose)} for row, pose in zip(rows, poses)]
    cards, bar = page.preview_cards(images, cards_rows, [f.sentence() for f in facts])
    start = options.start if options.start is not None else photo_places[-1]
    width, height = (int(n) for n in picked_cameras.sizes[0])
    portrait = height > width
    page.write_page(
        files["report"],
        title=scene.name,
        headline=words.headline(scene, suggestion, proposals),
        worth=worth_words,
        warnings=words.warnings(scene, around, facts, foggy),
        route=route_words,
        cards=cards,
        bar=bar,
        card_columns="1fr 1fr 1.6fr" if portrait else "1fr 1fr",
        words_place="" if portrait else "grid-column: 1 / -1;",
        place=plots.place_plot(
            axes=plots.levelled_axes(scene.up, np.asarray(scene.cameras.positions), around.focus),
            unit=around.unit,
            focus=around.focus,
            photos=np.asarray(scene.cameras.world_from_cam, np.float64),
            candidates=np.asarray(cameras.world_from_cam, np.float64),
            scores=suggestion.scores,
            selected=chosen,
            order=options.route,
            start=around.to_scene(start) if options.route else None,
        ),
        candidates=words.candidate_words(options, proposals, suggestion, around),
        worth_curve=plots.worth_plot(suggestion.worth, suggestion.photo_gain),
        numbers=words.numbers(rows, poses, facts),
        command=command,
        details=words.details(problem, options, around, quality, foggy, seconds_fn()),
    )
    made = {
        "scene": scene.name,
        "command": command,
        "device": device_name(),
        "seconds": seconds_fn(),
        "peak_memory_mb": peak_memory_mb(),
    }
    _write_summary(
        folder / "suggestion.json", suggestion, proposals, rows, facts, worth_words, made
    )
    return files


def _write_summary(
    path, suggestion: Suggestion, proposals, rows, facts, worth_words, made: dict
) -> None:
    worth, first = suggestion.worth, suggestion.worth.best_left[0]
    left = [None if np.isnan(x) else float(x) for x in worth.best_left]
    value = made | {
        "drawn": proposals.num_drawn,
        "kept": len(proposals.poses),
        "dropped": proposals.dropped,
        "best_gain": float(first),  # nats, as the next two
        "best_left": left,
        "photo_gain": suggestion.photo_gain,
        "worth": worth_words,
        "views": [
            row | {"share_high": fact.share_high, "why": fact.sentence()}
            for row, fact in zip(rows, facts)
        ],
    }
    write_json(path, value)
