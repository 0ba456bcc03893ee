"""Slow float64 references for the measures of single rays: literal loops over their formulas."""

from __future__ import annotations

import numpy as np


def entropy(weights) -> float:
    """`-sum_i what_i log what_i` of one ray's weights [S]."""
    total = sum(float(w) for w in weights)
    return -sum(w / total * np.log(w / total) for w in map(float, weights) if w > 0.0)


def variance_reduction(weights, beta) -> float:
    """ActiveNeRF's `sum beta - sum 1 / (1 / beta + w^2 / U)` of one ray."""
    weights, beta = np.asarray(weights, np.float64), np.asarray(beta, np.float64)
    variance = sum(w * w * b for w, b in zip(weights, beta))
    return sum(b - 1.0 / (1.0 / b + w * w / variance) for w, b in zip(weights, beta))


def pinhole_pixel(pose, intrinsics, point):
    """Pixel (x, y) of a point by similar triangles, or None behind the camera."""
    right, up, ahead = np.asarray(pose, np.float64)[:, :3].T @ (
        np.asarray(point, np.float64) - np.asarray(pose, np.float64)[:, 3]
    )
    ahead = -ahead
    fx, fy, cx, cy = (float(v) for v in intrinsics)
    return None if ahead <= 0.0 else (cx + fx * right / ahead, cy - fy * up / ahead)


def sees(pose, intrinsics, size, point, depth_map=None, tolerance=0.05):
    """Pixel at which a camera sees a point, or None: outside, behind, or hidden."""
    pixel = pinhole_pixel(pose, intrinsics, point)
    if pixel is None or not (0.0 <= pixel[0] <= size[0] and 0.0 <= pixel[1] <= size[1]):
        return None
    if depth_map is not None:
        surface = nearest(depth_map, pixel)
        distance = np.linalg.norm(np.asarray(point, np.float64) - pose[:, 3])
        if surface != 0.0 and surface < (1.0 - tolerance) * distance:
            return None
    return pixel


def nearest(image, pixel):
    """Value of the pixel that holds the point (x, y)."""
    height, width = image.shape[:2]
    return image[min(int(pixel[1]), height - 1), min(int(pixel[0]), width - 1)]


def bilinear(image, pixel):
    """Blend of the four pixels around (x, y), those beyond the edge taken from the edge."""
    height, width = image.shape[:2]
    x, y = pixel[0] - 0.5, pixel[1] - 0.5
    left, top = int(np.floor(x)), int(np.floor(y))
    value = 0.0
    for row, column in ((top, left), (top, left + 1), (top + 1, left), (top + 1, left + 1)):
        weight = (1.0 - abs(x - column)) * (1.0 - abs(y - row))
        clipped = image[min(max(row, 0), height - 1), min(max(column, 0), width - 1)]
        value = value + weight * np.asarray(clipped, np.float64)
    return value


def novelty(point, direction, poses, intrinsics, sizes, mask, depth_maps=None) -> float:
    """`1 - (1 + max_c d_c . d) / 2` over the cameras that see the point; 1 without any."""
    cosines = []
    for v in np.flatnonzero(mask):
        depth_map = None if depth_maps is None else depth_maps[v]
        if sees(poses[v], intrinsics[v], sizes[v], point, depth_map) is not None:
            towards = np.asarray(point, np.float64) - poses[v][:, 3]
            cosines.append(towards @ direction / np.linalg.norm(towards))
    return 1.0 - (1.0 + max(cosines)) / 2.0 if cosines else 1.0


def warp(point, rgb, poses, intrinsics, sizes, images, depth_maps, mask, *, quantity, combine):
    """Disagreement of one opaque surface point with the views that see it; 1 without any."""
    found = []
    for v in np.flatnonzero(mask):
        pixel = sees(poses[v], intrinsics[v], sizes[v], point, depth_maps[v])
        if pixel is None:
            continue
        if quantity == "colour":
            found.append(np.abs(bilinear(images[v], pixel) - rgb).mean())
        else:
            distance = np.linalg.norm(point - poses[v][:, 3])
            found.append(min(abs(nearest(depth_maps[v], pixel) - distance) / distance, 1.0))
    if not found:
        return 1.0
    return min(found) if combine == "min" else float(np.mean(found))
