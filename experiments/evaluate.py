"""How good a field is on test views, and how good pictures without any field would be."""

import jax
import numpy as np
from PIL import Image

from bavs_jax.cameras import num_pixels
from bavs_jax.metrics.image import depth_mae, match_exposure, measure_images, psnr, quantise_uint8
from bavs_jax.rendering.images import render_views
from experiments.build_model import RENDER_CHUNK
from experiments.files import stack_pictures
from experiments.runtime import track


def evenly_spaced(view_ids, num: int) -> np.ndarray:
    """`num` of the views, evenly spaced in their order; all of them if `num` is 0."""
    view_ids = np.asarray(view_ids)
    if num == 0 or num >= len(view_ids):
        return view_ids
    return view_ids[np.arange(num) * len(view_ids) // num]


# --- without a field -------------------------------------------------------------------------


def image_psnr(image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float:
    """PSNR of 8-bit images [H, W, 3] in dB, over the pixels of a mask [H, W] where there is one.

    Equal images count as one level off in all (48 dB), so that means stay finite.
    """
    squared = np.square(image.astype(np.float64) - truth).mean(-1)
    error = squared.mean() if mask is None else squared[mask].mean()
    return float(10.0 * np.log10(255.0**2 / max(error, 1.0)))


def measure_baselines(scene, training_views, test_views) -> dict[str, float]:
    """Mean PSNR in dB over test views of the two pictures that anyone would guess.

    They are the mean colour of all training pixels (`mean_colour_psnr`) and the training view whose
    camera is closest, stretched to the test view's size (`nearest_image_psnr`).
    """
    training_views = np.asarray(training_views)
    rows = []
    for view in training_views:
        kept = slice(None) if scene.pixel_mask is None else scene.pixel_mask[scene.view_slice(view)]
        rows.append(scene.pixels[scene.view_slice(view)][kept])
    mean_colour = np.round(np.concatenate(rows).mean(axis=0, dtype=np.float64))
    positions = np.asarray(scene.cameras.positions)
    by_mean, by_nearest = [], []
    for view in test_views:
        truth, mask = scene.image(view), scene.mask_image(view)
        distance = np.linalg.norm(positions[training_views] - positions[view], axis=-1)
        nearest = scene.image(training_views[distance.argmin()])
        if nearest.shape != truth.shape:
            size = (truth.shape[1], truth.shape[0])
            nearest = np.asarray(Image.fromarray(nearest).resize(size, Image.Resampling.BILINEAR))
        by_mean.append(image_psnr(np.broadcast_to(mean_colour, truth.shape), truth, mask))
        by_nearest.append(image_psnr(nearest, truth, mask))
    means = {"mean_colour_psnr": np.mean(by_mean), "nearest_image_psnr": np.mean(by_nearest)}
    return {name: float(value) for name, value in means.items()}


# --- of a field ------------------------------------------------------------------------------


def evaluate_views(
    render_fn,
    scene,
    view_ids,
    *,
    rays_per_pixel: int = 1,
    lpips_fn=None,
    exposure: bool = False,
    progress_fn=None,
) -> dict:
    """Mean image measures over views [n] by the 8-bit protocol, and the mean depth error.

    Args:
      render_fn: `Rays` [chunk] -> dict with "rgb", "depth", "opacity" and "thinned".
      rays_per_pixel: see `render_views`; as many as the field was trained with.
      lpips_fn: see `measure_images`.
      exposure: whether to measure `psnr_exposure`, too.

    Returns:
      dict of `psnr` (dB), `ssim`, `lpips`, `depth_mae` (scene units), `num_test_views`, `thinned`
      (share of rays sampled more coarsely than asked for) and `psnr_exposure` (dB, after
      `match_exposure`); null where not measured, as all but the number are of no views.
    """

    if not len(view_ids):
        return {**mean_quality(scene, [], []), "thinned": None, "num_test_views": 0}

    def measured_part(rays):
        rendering = render_fn(rays)
        return {name: rendering[name] for name in ("rgb", "depth", "opacity", "thinned")}

    images = render_views(
        measured_part,
        scene.cameras,
        view_ids,
        chunk=RENDER_CHUNK,
        rays_per_pixel=rays_per_pixel,
        progress_fn=progress_fn,
    )
    means = mean_quality(scene, view_ids, images, lpips_fn=lpips_fn, exposure=exposure)
    thinned = float(np.mean([image["thinned"].mean() for image in images]))
    return {**means, "thinned": thinned, "num_test_views": len(images)}


def render_with_bar(
    render_fn, cameras, view_ids, label: str, *, rays_per_pixel: int = 1
) -> list[dict[str, np.ndarray]]:
    """`render_views` with progress under a label."""
    num_rays = rays_per_pixel * int(num_pixels(cameras)[view_ids].sum())
    with track(num_rays, label, "rays") as bar:
        return render_views(
            render_fn,
            cameras,
            view_ids,
            chunk=RENDER_CHUNK,
            rays_per_pixel=rays_per_pixel,
            progress_fn=bar.advance,
        )


def measure_test_views(problem, train, num: int, label: str) -> dict:
    """`evaluate_views` of a trained field on `num` test views (0: all), with progress."""
    scene, rays_per_pixel = problem.scene, problem.config.rays_per_pixel
    view_ids = evenly_spaced(scene.test, num)
    num_rays = rays_per_pixel * int(num_pixels(scene.cameras)[view_ids].sum())
    with track(num_rays, f"{label}: {len(view_ids)} test views", "rays") as bar:
        return evaluate_views(
            problem.render(train),
            scene,
            view_ids,
            rays_per_pixel=rays_per_pixel,
            lpips_fn=problem.lpips_fn,
            exposure=problem.model.reads_views,
            progress_fn=bar.advance,
        )


def mean_quality(
    scene, view_ids, images: list[dict], *, lpips_fn=None, exposure: bool = False
) -> dict:
    """Means over views of what `evaluate_views` measures, of images that are rendered already.

    A view without known depth has no depth error, one without valid pixels no measure at all.
    """
    rows = [_measure(scene, v, image, lpips_fn, exposure) for v, image in zip(view_ids, images)]
    means = {}
    for name in ("psnr", "ssim", "lpips", "depth_mae", "psnr_exposure"):
        known = [row[name] for row in rows if row.get(name) is not None]
        means[name] = float(np.mean(known)) if known else None
    return means


_measure_images = jax.jit(measure_images, static_argnames="lpips_fn")


def _measure(scene, view_id: int, image: dict, lpips_fn, exposure: bool) -> dict[str, float]:
    mask = scene.mask_image(view_id)
    if mask is not None and not mask.any():
        return {}
    truth = scene.image(view_id).astype(np.float32) / 255.0
    row = _measure_images(image["rgb"], truth, mask=mask, lpips_fn=lpips_fn)
    if exposure:
        matched = match_exposure(np.asarray(image["rgb"]), truth, mask)
        row["psnr_exposure"] = psnr(quantise_uint8(matched), truth, mask)
    true_depth = scene.depth_image(view_id)
    if true_depth is not None and mask is not None:
        true_depth = np.where(mask, true_depth, 0.0)
    if true_depth is not None and (true_depth > 0).any():
        row["depth_mae"] = depth_mae(image["depth"], true_depth)
    return {k: float(v) for k, v in row.items() if v is not None}


def picture_arrays(render_fn, scene, view_ids, *, rays_per_pixel: int = 1) -> dict[str, np.ndarray]:
    """Renders some views for the report; see `image_arrays`."""
    images = render_views(
        render_fn, scene.cameras, view_ids, chunk=RENDER_CHUNK, rays_per_pixel=rays_per_pixel
    )
    return image_arrays(scene, view_ids, images)


def image_arrays(scene, view_ids, images: list[dict]) -> dict[str, np.ndarray]:
    """Truth, render, error, uncertainty and depth of rendered views, for the report.

    Views may differ in size: see `stack_pictures`, and `sizes` [n, 2] (width, height).
    """
    truth = stack_pictures([scene.image(v) for v in view_ids])
    rgb = stack_pictures([np.clip(image["rgb"], 0.0, 1.0) for image in images])
    return {
        "view_ids": np.asarray(view_ids),
        "names": np.array([scene.names[v] for v in view_ids]),
        "sizes": np.asarray(scene.cameras.sizes)[view_ids],
        "truth": truth,
        "rgb": np.round(255.0 * rgb).astype(np.uint8),
        "error": np.abs(rgb - truth / 255.0).mean(-1).astype(np.float32),
        "uncertainty": stack_pictures([image["uncertainty"] for image in images]),
        "depth": stack_pictures([image["depth"] for image in images]),
    }
