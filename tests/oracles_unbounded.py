"""Slow references for contraction, histograms and cones: loops and draws in float64."""

import numpy as np


def contract_loop(points):
    """Mip-NeRF 360, Eq 10 in the maximum norm, point by point."""
    rows = []
    for point in np.asarray(points, np.float64):
        norm = np.abs(point).max()
        rows.append(point if norm <= 1 else (2.0 - 1.0 / norm) * point / norm)
    return np.array(rows)


def inverse_cdf_loop(edges, weights, places):
    """Walks along one histogram until a share `place` of its weight has been passed."""
    share = np.asarray(weights, np.float64) / np.sum(weights, dtype=np.float64)
    found = []
    for place in places:
        passed = 0.0
        for i, part in enumerate(share):
            if part > 0 and place <= passed + part:
                found.append(edges[i] + (place - passed) / part * (edges[i + 1] - edges[i]))
                break
            passed += part
        else:
            found.append(edges[-1])
    return np.array(found)


def interlevel_loop(proposal_edges, proposal_weights, edges, weights):
    """Mip-NeRF 360, Eqs 12 and 13 for one ray, as a mean over its samples."""
    total = 0.0
    for i, weight in enumerate(weights):
        bound = 0.0
        for j, proposed in enumerate(proposal_weights):
            if proposal_edges[j] < edges[i + 1] and proposal_edges[j + 1] > edges[i]:
                bound += proposed
        if weight > 0:
            total += max(0.0, weight - bound) ** 2 / weight
    return total / len(weights)


def distortion_loop(edges, weights):
    """Mip-NeRF 360, Eq 15 for one ray."""
    total = 0.0
    for i, a in enumerate(weights):
        for j, b in enumerate(weights):
            middle_i = 0.5 * (edges[i] + edges[i + 1])
            middle_j = 0.5 * (edges[j] + edges[j + 1])
            total += a * b * abs(middle_i - middle_j)
        total += a * a * (edges[i + 1] - edges[i]) / 3.0
    return total


def frustum_draws(rng, t_start, t_end, radius, num):
    """Points drawn evenly from a piece of a cone about the z axis with its tip at 0, [num, 3]."""
    # The cross section grows as t^2.
    t = np.cbrt(rng.uniform(t_start**3, t_end**3, num))
    angle = rng.uniform(0, 2 * np.pi, num)
    r = radius * t * np.sqrt(rng.uniform(0, 1, num))
    return np.stack([r * np.cos(angle), r * np.sin(angle), t], axis=-1)
