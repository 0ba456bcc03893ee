"""The shortest way through chosen places: an open tour from where the camera is now."""

import numpy as np

EXACT_PLACES = 12  # up to here by dynamic programming: 2^12 * 12^2 steps


def shortest_route(start, places, *, exact_places: int = EXACT_PLACES) -> np.ndarray:
    """In which order [N] to visit places, beginning at `start` and ending anywhere.

    Up to `exact_places` places the order is the best there is (Held and Karp 1962); beyond, it is
    the nearest-neighbour order improved by 2-opt and moves of short runs, which no single such
    move makes shorter.

    Args:
      start: [3] where the route begins.
      places: [N, 3] in the same unit.
      exact_places: up to how many places the exact way is taken.
    """
    points = np.concatenate([np.asarray(start, float)[None], np.asarray(places, float)])
    cost = np.linalg.norm(points[:, None] - points[None], axis=-1)
    num = len(points) - 1
    if num < 2:
        return np.arange(num)
    return held_karp(cost) if num <= exact_places else improve(cost, nearest_neighbour(cost))


def route_length(start, places, order) -> float:
    """Length of the way from `start` through `places` [N, 3] in the given order."""
    points = np.concatenate([np.asarray(start, float)[None], np.asarray(places, float)[order]])
    return float(np.linalg.norm(np.diff(points, axis=0), axis=-1).sum())


def held_karp(cost: np.ndarray) -> np.ndarray:
    """The best open tour [N] by dynamic programming over sets of visited places.

    `best[S, j] = min_{i in S} best[S - j, i] + cost[i, j]`, in O(2^N N^2) time. Row and column 0 of
    `cost` [N + 1, N + 1] >= 0 belong to the start.
    """
    num = len(cost) - 1
    between, from_start = cost[1:, 1:], cost[0, 1:]
    best = np.full((1 << num, num), np.inf)
    before = np.zeros((1 << num, num), np.int32)
    best[1 << np.arange(num), np.arange(num)] = from_start
    for visited in range(1, 1 << num):
        # Sets are numbered so that every subset comes before what contains it.
        for place in range(num):
            rest = visited & ~(1 << place)
            if rest == visited or rest == 0:
                continue
            ways = best[rest] + between[:, place]
            before[visited, place] = np.argmin(ways)
            best[visited, place] = ways[before[visited, place]]
    visited = (1 << num) - 1
    order = [int(np.argmin(best[visited]))]
    while len(order) < num:
        last = order[-1]
        order.append(int(before[visited, last]))
        visited &= ~(1 << last)
    return np.array(order[::-1])


def nearest_neighbour(cost: np.ndarray) -> np.ndarray:
    """Always on to the nearest place not yet visited; arguments as in `held_karp`."""
    left = np.ones(len(cost), bool)
    left[0], here, order = False, 0, []
    while left.any():
        here = int(np.argmin(np.where(left, cost[here], np.inf)))
        left[here] = False
        order.append(here - 1)
    return np.array(order)


def improve(cost: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Reverses parts of the way (2-opt) and moves runs of up to 3 places while that shortens it.

    Begins with the order [N]; `cost` is as in `held_karp`, and symmetric.
    """
    path = [0, *(np.asarray(order) + 1).tolist()]

    def length(way):
        return cost[way[:-1], way[1:]].sum()

    best = length(path)
    tolerance = 1e-12 * (1.0 + best)  # rounding must not count as progress, or this never ends
    while True:
        for way in _neighbours(path):
            shorter = length(way)
            if shorter < best - tolerance:
                path, best = way, shorter
                break
        else:
            return np.array(path[1:]) - 1


def _neighbours(path: list[int]):
    """All ways that one reversal or one moved run leads to; the start stays first."""
    size = len(path)
    for i in range(1, size - 1):
        for j in range(i + 1, size):
            yield path[:i] + path[i : j + 1][::-1] + path[j + 1 :]
    for run in (1, 2, 3):
        for i in range(1, size - run + 1):
            moved, rest = path[i : i + run], path[:i] + path[i + run :]
            for j in range(1, len(rest) + 1):
                if j != i:
                    yield rest[:j] + moved + rest[j:]
