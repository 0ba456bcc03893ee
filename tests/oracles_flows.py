"""Slow float64 references of flows and kernel densities: loops over components and draws."""

from __future__ import annotations

import numpy as np


def invert_flow(r1, r2, b, image, *, reverse: bool):
    """The point [D] that one flow carries to `image` [D], by bisection, last component first.

    Given the components after it, each is carried by `y + r1_ii tanh(r2_ii y + c) + e`, which
    increases in y and lies within |r1_ii| of y + e.
    """
    r1, r2, b = (np.asarray(x, np.float64) for x in (r1, r2, b))
    image = np.asarray(image, np.float64)[:: -1 if reverse else 1]
    y, hidden = np.zeros(len(image)), np.zeros(len(image))
    for i in reversed(range(len(image))):
        inner = b[i] + r2[i, i + 1 :] @ y[i + 1 :]
        rest = image[i] - r1[i, i + 1 :] @ hidden[i + 1 :]
        low, high = rest - abs(r1[i, i]), rest + abs(r1[i, i])
        for _ in range(80):
            middle = 0.5 * (low + high)
            too_high = middle + r1[i, i] * np.tanh(r2[i, i] * middle + inner) > rest
            low, high = (low, middle) if too_high else (middle, high)
        y[i] = 0.5 * (low + high)
        hidden[i] = np.tanh(r2[i, i] * y[i] + inner)
    return y[:: -1 if reverse else 1]


def invert_flows(r1, r2, b, image):
    """The point [D] that all flows in turn carry to `image` [D]; parameters are [F, D, ...]."""
    for number in reversed(range(len(b))):
        image = invert_flow(r1[number], r2[number], b[number], image, reverse=number % 2 == 1)
    return image


def kernel_log_density_loop(draws, target, bandwidth) -> float:
    """Log of the mean of K products of three Gaussians, for one ray: [K, 3], [3], [3]."""
    terms = [
        -0.5 * ((colour[c] - target[c]) / bandwidth[c]) ** 2
        - np.log(bandwidth[c])
        - 0.5 * np.log(2 * np.pi)
        for colour in np.asarray(draws, np.float64)
        for c in range(3)
    ]
    exponents = np.reshape(terms, (-1, 3)).sum(-1)
    largest = exponents.max()
    return float(largest + np.log(np.mean(np.exp(exponents - largest))))
