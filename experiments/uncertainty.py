"""How well uncertainty models tell error: AUSE on test views, and calibrated intervals.

Each model and seed leaves files of numbers, arrays and intervals and is not measured again; the
numbers come last. A calibration can be put around renders of new views.
"""

import itertools
import json
import pathlib
import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from bavs_jax.cameras import image_pixels
from bavs_jax.metrics.ause import ERRORS, Sparsification, mean_sparsification, variant_name
from bavs_jax.rendering.images import render_pixels
from bavs_jax.uncertainty import bands
from bavs_jax.uncertainty.conformal_report import coverage_report, to_json
from bavs_jax.uncertainty.conformal_scale import ViewGroups, split_views
from bavs_jax.uncertainty.model import Acquired
from experiments.build import Problem, stream_key
from experiments.build_model import RENDER_CHUNK
from experiments.evaluate import evenly_spaced, image_arrays, mean_quality, render_with_bar
from experiments.files import (
    read_arrays,
    read_json,
    read_versioned,
    stack_pictures,
    write_arrays,
    write_json,
)
from experiments.reporting.uncertainty import LEVEL, NAME, RESULT_VERSION, save_result, write_page
from experiments.runtime import ConfigError, WorkdirError, code_commit, made_by, track
from experiments.trained import FIRST_ROUND, train_run

ROW_VERSION = 3  # of one model and seed; rows of another version are made anew
CALIBRATION_VERSION = 1
IMAGES = ("rgb", "depth", "opacity", "uncertainty", "depth_uncertainty")
COMMON_MODEL = "entropy"  # fits nothing: what it renders is the run's own field
PIXEL_SEED = 0  # the same pixels of a view for every model and seed


def row_path(folder: pathlib.Path, model: str, seed: int) -> pathlib.Path:
    """Where the numbers of one model and seed are kept as soon as they are known."""
    return folder / "uncertainty" / model / f"seed_{seed}.json"


# --- one seed, and the summary ---


def measure_seed(config, problem: Problem, folder: pathlib.Path, seed: int, command: str) -> None:
    """Measures every model that has no result yet, after a run of the config's first policy."""
    missing = [m for m in config.evaluation.models if not _is_done(row_path(folder, m, seed))]
    if not missing:
        return
    commit = code_commit()  # now: files may be edited while it runs
    scene, options = problem.scene, config.evaluation
    policy = config.policies[0] if config.num_rounds else FIRST_ROUND
    run = train_run(config, problem, folder, policy, seed, command)
    acquired = run.acquired._replace(label=f"seed {seed}")
    view_ids = evenly_spaced(scene.test, options.num_views)
    key = stream_key(seed, "evaluation")

    def fit_and_render(name):
        fitted = fit_model(problem, name, key, acquired)
        return fitted, *render_model(scene, fitted, view_ids, f"{acquired.label}: {name}")

    def errors_of(images):
        return pixel_errors(whole_views(scene, view_ids, images), scale_depth=options.scale_depth)

    common = fit_and_render(COMMON_MODEL)
    common_errors = errors_of(common[1])
    common_psnr = mean_quality(scene, view_ids, common[1])["psnr"]
    for name in missing:
        fitted, images, seconds = common if name == COMMON_MODEL else fit_and_render(name)
        ause, arrays = {"own": {}, "common": {}}, {}
        for field, errors in (("own", errors_of(images)), ("common", common_errors)):
            for variant, one in all_ause(errors, images).items():
                areas = {"ause": one.ause, "unnormalised": one.ause_unnormalised}
                ause[field][variant] = areas
                arrays[f"{field}_{variant}_by_uncertainty"] = one.by_uncertainty
                arrays[f"{field}_{variant}_by_error"] = one.by_error
        calibration, numbers, interval_seconds = measure_intervals(
            config, scene, fitted, acquired, folder, name, seed
        )
        if config.num_pictures:
            shown = evenly_spaced(np.arange(len(view_ids)), config.num_pictures)
            pictures = [images[i] for i in shown]
            halves = [bands.add_bands(calibration, image, LEVEL)["rgb_half"] for image in pictures]
            arrays |= image_arrays(scene, view_ids[shown], pictures)
            arrays["half"] = stack_pictures(halves)
        path = row_path(folder, name, seed)
        write_arrays(path.with_suffix(".npz"), **arrays)
        quality = mean_quality(scene, view_ids, images)
        row = {
            "row_version": ROW_VERSION,
            "model": name,
            "seed": seed,
            "num_views": int(np.sum(acquired.is_training_view)),
            "num_test_views": len(view_ids),
            "psnr": quality["psnr"],
            "ssim": quality["ssim"],
            "psnr_common": common_psnr,
            **ause,
            **numbers,
            "seconds": {"fit": fitted.seconds, "render": seconds, "intervals": interval_seconds},
            "commit": commit,
        }
        write_json(path, row)


def _is_done(path: pathlib.Path) -> bool:
    """Whether a row is there with its arrays, made by this version."""
    row = read_json(path)
    is_current = row is not None and row.get("row_version") == ROW_VERSION
    return is_current and read_arrays(path.with_suffix(".npz")) is not None


def write_summary(config, scene, folder: pathlib.Path, command: str) -> tuple:
    """Collects the rows of all models and seeds into a result file and a page; their paths."""
    models, seeds = config.evaluation.models, config.seeds
    paths = [row_path(folder, model, seed) for model in models for seed in seeds]
    rows = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
    num = config.evaluation.num_interval_pixels
    pixels = f"{num} pixels of each view, drawn uniformly without replacement" if num else "all"
    rule = (
        f"{pixels}; of these the ones with a known truth whose ray meets something (opacity of at "
        "least 1/255) and whose uncertainty is finite"
    )
    result = {
        "schema_version": RESULT_VERSION,
        "scene": scene.name,
        "kind": config.loader,
        "image_size": np.asarray(scene.cameras.sizes).max(axis=0).tolist(),
        "seeds": list(seeds),
        "config": config.to_dict(),
        **made_by(),
        "command": command,
        "pixel_rule": rule,
        # The same for all models of a seed.
        "interval_views": {str(row["seed"]): row.pop("interval_views") for row in rows},
        "rows": rows,
    }
    save_result(folder, result)
    arrays = {
        model: [dict(np.load(row_path(folder, model, s).with_suffix(".npz"))) for s in seeds]
        for model in models
    }
    page = folder / "uncertainty.html"
    write_page(page, result, arrays=arrays, variant=config.evaluation.variant)
    return folder / NAME, page


# --- a model on whole views ---


class FittedModel(NamedTuple):
    """A model that is ready to render."""

    render: Callable  # rays [chunk] -> images, those of `IMAGES` that the model has
    seconds: float  # that it took to fit
    rays_per_pixel: int = 1  # see `render_views`


def fit_model(problem: Problem, name: str, key, acquired: Acquired) -> FittedModel:
    """Fits a model to the training views of a acquired."""
    fns = problem.model_fns(name)
    start = time.perf_counter()
    fitted = jax.block_until_ready(fns.fit(key, acquired))
    seconds = time.perf_counter() - start

    def render(rays):
        rendered = fns.render(fitted, acquired.train, rays)
        return {k: rendered[k] for k in IMAGES if k in rendered}

    return FittedModel(render, seconds, problem.config.rays_per_pixel)


def render_model(scene, fitted: FittedModel, view_ids, label: str) -> tuple[list[dict], float]:
    """Renders whole views with a fitted model: the images of each, and the seconds it took."""
    start = time.perf_counter()
    label, rays_per_pixel = f"{label} on {len(view_ids)} views", fitted.rays_per_pixel
    images = render_with_bar(
        fitted.render, scene.cameras, view_ids, label, rays_per_pixel=rays_per_pixel
    )
    return images, time.perf_counter() - start


class ViewSample(NamedTuple):
    """Some pixels of a view: what a model renders there, and what is true."""

    image: dict[str, np.ndarray]  # [N, ...] as `band_errors` takes it
    truth: dict[str, np.ndarray]  # "colour" [N, 3] in 0 .. 1; "depth" [N], 0 where unknown
    known: np.ndarray  # [N] bool, whether the pixel counts


def view_sample(scene, view: int, image: dict, pixels=slice(None)) -> ViewSample:
    """The pixels of a view that were rendered, with their truth."""
    rows = np.arange(scene.offsets[view], scene.offsets[view + 1])[pixels]
    depth = np.zeros(len(rows)) if scene.depth is None else scene.depth[rows]
    known = np.ones(len(rows), bool) if scene.pixel_mask is None else scene.pixel_mask[rows]
    return ViewSample(image, {"colour": scene.pixels[rows] / 255.0, "depth": depth}, known)


def whole_views(scene, view_ids, images: list[dict]) -> list[ViewSample]:
    """All pixels of rendered views, given as images [H, W, ...]."""
    flat = [{k: x.reshape(-1, *x.shape[2:]) for k, x in image.items()} for image in images]
    return [view_sample(scene, view, image) for view, image in zip(view_ids, flat)]


def pixel_errors(views: list[ViewSample], *, scale_depth: bool) -> dict[str, list]:
    """Of each view (absolute errors [N], whether a pixel counts [N]), of "colour" and "depth".

    Colour errors are means over the channels; depth errors are shares of the largest true depth,
    if `scale_depth` after `depth_factor`. There is no "depth" if no view has a true one.
    """
    colour = [
        (np.abs(np.clip(view.image["rgb"], 0.0, 1.0) - view.truth["colour"]).mean(-1), view.known)
        for view in views
    ]
    factor = depth_factor(views) if scale_depth else 1.0
    depth = [
        bands.render_errors("depth", v.image, v.truth["depth"], v.known, depth_factor=factor)
        for v in views
    ]
    largest = max(np.max(view.truth["depth"], where=view.known, initial=0.0) for view in views)
    if largest == 0.0:
        return {"colour": colour}
    return {"colour": colour, "depth": [(errors / largest, known) for errors, known in depth]}


def depth_factor(views: list[ViewSample]) -> float:
    """Least-squares factor from rendered to true depth; 1 where no depth is known."""
    known = [view.known & (view.truth["depth"] > 0.0) for view in views]
    true = np.concatenate([view.truth["depth"][k] for view, k in zip(views, known)])
    rendered = np.concatenate([view.image["depth"][k] for view, k in zip(views, known)])
    square = rendered.astype(np.float64) @ rendered
    return float(rendered.astype(np.float64) @ true / square) if square else 1.0


def all_ause(errors: dict[str, list], images: list[dict]) -> dict[str, Sparsification]:
    """Every variant of AUSE of one model, by its name.

    The errors, from `pixel_errors`, may be those of another field than the model's own.
    """
    found = {}
    for (of, parts), error, pooled in itertools.product(errors.items(), ERRORS, (False, True)):
        pairs = [
            (values[known], bands.uncertainty_of(of, image).ravel()[known])
            for (values, known), image in zip(parts, images)
            if known.any()
        ]
        name = variant_name(of=of, error=error, pooled=pooled)
        found[name] = mean_sparsification(pairs, error=error, pooled=pooled)
    return found


# --- intervals: of which views and pixels, and how well they hold ---


def measure_intervals(
    config, scene, fitted: FittedModel, acquired: Acquired, folder, model: str, seed: int
) -> tuple[bands.RenderCalibration, dict, float]:
    """Calibrates intervals, writes their file and measures them; and the seconds of rendering."""
    options, start = config.evaluation, time.perf_counter()
    groups = interval_groups(scene, acquired.is_training_view, options.num_interval_views, seed)
    num, label = options.num_interval_pixels, f"{acquired.label}: {model}"
    samples = sample_views(scene, fitted, np.concatenate(groups), num, label)
    seconds = time.perf_counter() - start
    calibration, numbers = calibrate_samples(
        groups, samples, scale=options.interval_scale, scale_depth=options.scale_depth
    )
    views = {part: group.tolist() for part, group in groups._asdict().items()}
    names = {part: [scene.names[view] for view in group] for part, group in views.items()}
    about = {"scene": scene.name, "model": model, "seed": seed, "views": names}
    values = {"schema_version": CALIBRATION_VERSION, **about, "pixels_per_view": num}
    values["calibration"] = bands.calibration_to_json(calibration)
    write_json(row_path(folder, model, seed).with_name(f"seed_{seed}_calibration.json"), values)
    return calibration, {"intervals": numbers, "interval_views": views}, seconds


def interval_groups(scene, is_training_view, num: int, seed: int) -> ViewGroups:
    """Views to fit the scale, to calibrate and to test, none trained on, drawn at random.

    These are `num` of the test views, evenly spaced, then unused ones of the pool; 0: all.

    Raises:
      ConfigError: too few views were not trained on.
    """
    test, pool = evenly_spaced(scene.test, num), np.asarray(scene.pool)
    unused = pool[~np.asarray(is_training_view)[pool]]
    if num:
        missing = num - len(test)
        unused = evenly_spaced(unused, missing) if missing else unused[:0]
    try:
        return split_views(np.concatenate([test, unused]), seed=seed)
    except ValueError as error:
        raise ConfigError(f"config.evaluation.num_interval_views: {error}") from None


def sample_views(
    scene, fitted: FittedModel, view_ids, num: int, label: str
) -> dict[int, ViewSample]:
    """Renders at most `num` pixels of each view, drawn uniformly without replacement; 0: all."""
    places, pixels = [], []
    for view in view_ids:
        every = image_pixels(*map(int, scene.cameras.sizes[view]))
        drawn = np.arange(len(every))
        if 0 < num < len(every):
            rng = np.random.default_rng((PIXEL_SEED, int(view)))
            drawn = np.sort(rng.choice(len(every), num, replace=False))
        places.append(drawn)
        pixels.append(every[drawn])
    sizes = [len(drawn) for drawn in places]
    num_rays = fitted.rays_per_pixel * sum(sizes)
    with track(num_rays, f"{label}: pixels of {len(sizes)} views", "rays") as bar:
        images = render_pixels(
            fitted.render,
            scene.cameras,
            np.repeat(np.asarray(view_ids, np.int32), sizes),
            np.concatenate(pixels),
            chunk=RENDER_CHUNK,
            rays_per_pixel=fitted.rays_per_pixel,
            progress_fn=bar.advance,
        )
    parts = {name: np.split(x, np.cumsum(sizes)[:-1]) for name, x in images.items()}
    return {
        int(view): view_sample(scene, view, {name: part[i] for name, part in parts.items()}, drawn)
        for i, (view, drawn) in enumerate(zip(view_ids, places))
    }


def calibrate_samples(
    groups: ViewGroups, samples: dict[int, ViewSample], *, scale: str, scale_depth: bool
) -> tuple[bands.RenderCalibration, dict]:
    """Learns intervals on two groups of views, as `fit_scale` does, and measures them on the third.

    If `scale_depth`, rendered depth is multiplied by the `depth_factor` of the fit views.

    Returns:
      the intervals, and by "colour" and "depth", where it is known, the numbers of
      `coverage_report`, with `share_with_band` of the test pixels whose truth is known, and
      `error_without_band`, the mean error of the others, null of none.
    """
    fit, calibrating, test = ([samples[int(view)] for view in views] for views in groups)
    factor = depth_factor(fit) if scale_depth else 1.0

    def errors_of(quantity, views, fn=bands.band_errors):
        found = [
            fn(quantity, view.image, view.truth[quantity], view.known, depth_factor=factor)
            for view in views
        ]
        return [errors for errors in found if errors is not None]

    calibration = bands.calibrate_renders(
        *({q: errors_of(q, views) for q in bands.QUANTITIES} for views in (fit, calibrating)),
        scale=scale,
        depth_factor=factor,
    )
    numbers = {}
    for quantity in bands.QUANTITIES:
        calibrated, banded = getattr(calibration, quantity), errors_of(quantity, test)
        if calibrated is None or not banded:
            continue
        errors, known = map(np.concatenate, zip(*errors_of(quantity, test, bands.render_errors)))
        has = np.concatenate([bands.has_band(quantity, view.image) for view in test])
        without = errors[known & ~has]
        numbers[quantity] = to_json(coverage_report(calibrated, banded)) | {
            "share_with_band": float(has[known].mean()),
            "error_without_band": float(without.mean()) if len(without) else None,
        }
    return calibration, numbers


def load_calibration(path: pathlib.Path) -> bands.RenderCalibration:
    """Intervals of a file `seed_<n>_calibration.json`; `bands.add_bands` puts them around renders.

    Raises:
      WorkdirError: the file is missing or broken, or of another version.
    """
    ways = {"absent": "run experiments.evaluate_uncertainty", "fix": "make it anew"}
    values = read_versioned(path, CALIBRATION_VERSION, error=WorkdirError, **ways)
    try:
        return bands.calibration_from_json(values.get("calibration") or {})
    except ValueError as error:
        raise WorkdirError(f"{path}: {error}") from None
