"""Coverage of surface against loops in float64, in closed form, and the gate on analytic fields."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.cameras import Rays, look_at, make_cameras
from bavs_jax.fields.base import Field
from bavs_jax.fields.deformation import DeformationGrid, vertex_positions
from bavs_jax.selection.batch import acquire
from bavs_jax.selection.context import make_context
from bavs_jax.selection.distances import far_from_chosen
from bavs_jax.selection.policies import POLICIES
from bavs_jax.uncertainty.model import RECONSTRUCTION
from bavs_jax.uncertainty.models.coverage import (
    Covered,
    make_surface_coverage_fns,
    make_surface_fn,
)
from bavs_jax.uncertainty.surface import (
    Lookers,
    cell_number,
    nearness,
    surface_novelty,
    transmittance_to,
    unknown_share,
)
from experiments.build import Problem
from tests.toy_fields import NOTHING_LEARNT, even_sampler
from tests.toy_rounds import silent
from tests.toy_runs import toy_config
from tests.toy_scenes import toy_scene

SIZE, FOCAL = 16, 20.0
BOX = np.array([[-1.0] * 3, [1.0] * 3], np.float32)


def lookers_at(places, depth=0.0, opacity=0.0, mask=None):
    """Cameras that look at the origin through images of one depth and opacity each."""
    num = len(places)
    cameras = make_cameras(
        np.stack([look_at(p, [0.0, 0.0, 0.0]) for p in places]),
        np.tile([FOCAL, FOCAL, SIZE / 2, SIZE / 2], (num, 1)),
        np.tile([SIZE, SIZE], (num, 1)),
    )
    ones = np.ones((num, SIZE, SIZE), np.float32)
    maps = [ones * np.reshape(np.float32(x), (-1, 1, 1)) for x in (depth, opacity)]
    return Lookers(cameras, np.ones(num, bool) if mask is None else mask, *maps)


def random_world(seed, num_points, num_views=5):
    """Points, directions and views with random renders, one of which does not count."""
    rng = np.random.default_rng(seed)
    lookers = lookers_at(3.0 * rng.normal(size=(num_views, 3)), mask=np.arange(num_views) != 2)
    shape = lookers.depth_maps.shape
    depth = rng.uniform(1.0, 8.0, shape) * (rng.uniform(size=shape) < 0.7)
    lookers = lookers._replace(
        depth_maps=depth.astype(np.float32),
        opacity_maps=rng.uniform(size=shape).astype(np.float32),
    )
    points = rng.uniform(-1.5, 1.5, (num_points, 3)).astype(np.float32)
    directions = rng.normal(size=(num_points, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return points, directions.astype(np.float32), lookers


def slow_transmittance(lookers, view, point):
    """Pixel, depth and opacity of one point in one view, from the words."""
    pose = np.asarray(lookers.cameras.world_from_cam[view], np.float64)
    right, up, back = (np.asarray(point, np.float64) - pose[:, 3]) @ pose[:, :3]
    if back >= 0.0:
        return 0.0
    x, y = SIZE / 2 - FOCAL * right / back, SIZE / 2 + FOCAL * up / back
    if not (0.0 <= x <= SIZE and 0.0 <= y <= SIZE):
        return 0.0
    row, column = min(int(y), SIZE - 1), min(int(x), SIZE - 1)
    surface = float(lookers.depth_maps[view][row, column])
    distance = np.linalg.norm(point - pose[:, 3])
    is_hidden = surface != 0.0 and surface < 0.95 * distance
    return 1.0 - float(lookers.opacity_maps[view][row, column]) if is_hidden else 1.0


@pytest.mark.parametrize("kappa", [0.0, 4.0, 30.0])
def test_novelty_equals_loops_over_points_and_views(kappa):
    points, directions, lookers = random_world(0, 60)
    expected, seen = [], 0
    for point, direction in zip(points, directions.astype(np.float64)):
        most = 0.0
        for view in np.flatnonzero(lookers.mask):
            place = np.asarray(lookers.cameras.positions[view], np.float64)
            towards = (point - place) / np.linalg.norm(point - place)
            light = slow_transmittance(lookers, view, point)
            most = max(most, light * np.exp(kappa * (towards @ direction - 1.0)))
            seen += light > 0.0
        expected.append(1.0 - most)
    assert seen > 60, "points must be in the images"
    got = surface_novelty(points, directions, lookers, kappa=kappa)
    np.testing.assert_allclose(got, expected, atol=1e-5)  # float32 of numbers up to 1


@pytest.mark.parametrize("num", [1, 7, 130])
def test_jitted_equals_eager(num):
    points, directions, lookers = random_world(1, num)
    rays = Rays(points - 3.0 * directions, directions)
    with jax.disable_jit():
        eager = surface_novelty(points, directions, lookers), unknown_share(rays, BOX, lookers)
    np.testing.assert_allclose(
        jax.jit(surface_novelty)(points, directions, lookers), eager[0], atol=1e-5
    )
    # A step that is on the edge of an image may fall to either side.
    jitted = np.asarray(jax.jit(unknown_share)(rays, BOX, lookers))
    assert (np.abs(jitted - eager[1]) < 1e-5).mean() > 0.95


def test_one_point_and_one_look_in_closed_form():
    """A look from +x: known by the angle to it, and as far as light comes through."""
    origin = np.zeros((4, 3), np.float32)
    angles = np.radians([0.0, 34.0, 90.0, 180.0])
    directions = -np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], -1).astype(np.float32)
    known = np.exp(4.0 * (np.cos(angles) - 1.0))
    place = [[3.0, 0.0, 0.0]]
    for depth, opacity, light in (
        (0.0, 0.0, 1.0),  # nothing in the way
        (3.0, 1.0, 1.0),  # the point is the surface
        (1.0, 1.0, 0.0),  # behind a wall
        (1.0, 0.25, 0.75),  # behind thin fog
    ):
        got = surface_novelty(origin, directions, lookers_at(place, depth, opacity))
        np.testing.assert_allclose(got, 1.0 - light * known, atol=1e-6)
    nobody = surface_novelty(origin, directions, lookers_at(place, mask=np.zeros(1, bool)))
    np.testing.assert_array_equal(nobody, 1.0)
    aside = surface_novelty(origin + 50.0, directions, lookers_at(place))
    np.testing.assert_array_equal(aside, 1.0)


def test_light_behind_a_render_is_in_0_to_1_whatever_rounding_made_of_its_opacity():
    lookers = lookers_at([[3.0, 0.0, 0.0]], 1.0, 1.0 + 1e-6)
    camera = jax.tree.map(lambda x: x[0], lookers.cameras)
    light = transmittance_to(
        camera, np.zeros((1, 3), np.float32), lookers.depth_maps[0], lookers.opacity_maps[0]
    )
    assert light[0] == 0.0


def test_unknown_share_in_closed_form():
    origins = np.float32([[-5.0, 0.0, 0.0], [-5.0] * 3, [-5.0, 3.0, 0.0], [0.0, 0.0, 0.0]])
    directions = np.float32([[1.0, 0.0, 0.0], [1.0 / np.sqrt(3.0)] * 3, [1.0, 0, 0], [1.0, 0, 0]])
    rays = Rays(origins, directions)
    nobody = lookers_at([[9.0, 0.0, 0.0]], mask=np.zeros(1, bool))
    # Through the middle, along the diagonal, past the box, from its middle.
    share = np.array([1.0 / np.sqrt(3.0), 1.0, 0.0, 0.5 / np.sqrt(3.0)])
    np.testing.assert_allclose(unknown_share(rays, BOX, nobody), share, atol=1e-5)
    all_seen = unknown_share(rays, BOX, lookers_at([[9.0, 0.0, 0.0]]))
    np.testing.assert_allclose(all_seen, 0.0, atol=1e-6)
    # A wall at x = 0 lets 0.4 of the light through: half of the way is behind it.
    fog = unknown_share(rays, BOX, lookers_at([[9.0, 0.0, 0.0]], 9.0, 0.6))[0]
    tolerated = 0.05 * 9.0  # counts as seen behind the wall
    np.testing.assert_allclose(fog, 0.6 * share[0] * (1.0 - tolerated) / 2.0, rtol=0.1)


def test_what_is_far_counts_by_the_square_of_its_distance():
    np.testing.assert_allclose(nearness(np.float32([0.0, 1.0, 2.0, 6.0]), 2.0), [1, 1, 1, 1 / 9])
    never = np.finfo(np.float32).max  # where no training view met a surface
    np.testing.assert_array_equal(nearness(np.float32([0.0, 7.0]), never), 1.0)
    np.testing.assert_array_equal(nearness(np.float32([0.0, 7.0]), 0.0), [1.0, 0.0])


@pytest.mark.parametrize("contracted", [False, True])
def test_cells_are_between_their_vertices(contracted):
    grid = DeformationGrid(jnp.asarray(BOX), 2, contracted=contracted)
    corners = np.asarray(vertex_positions(grid), np.float64).reshape(5, 5, 5, 3)
    middles = (corners[:-1, :-1, :-1] + corners[1:, 1:, 1:]) / 2.0
    if contracted:  # the outer cells are without end
        middles, want = middles[1:3, 1:3, 1:3], np.arange(64).reshape(4, 4, 4)[1:3, 1:3, 1:3]
    else:
        want = np.arange(64).reshape(4, 4, 4)
    got = cell_number(grid, jnp.asarray(middles, jnp.float32))
    np.testing.assert_array_equal(got, want)
    outside = cell_number(grid, jnp.float32([[-99.0] * 3, [99.0] * 3]))
    np.testing.assert_array_equal(outside, [0, 63])


# --- the gate ---


# Looks at the ball from +x and, where it counts, from -x; its surface is 2.3 away.
BALL_LOOKERS = lookers_at([[3.0, 0.0, 0.0], [-3.0, 0.0, 0.0]], 2.3, 1.0, np.array([True, False]))


def ball_setup(density):
    """A setup whose field is a ball of radius 0.7, and a state of training of it."""
    problem = Problem(toy_config(uncertainty__log2_cells=4), toy_scene(), track=silent)

    def ball(params, positions, directions):
        del params, directions
        inside = (positions**2).sum(-1) < 0.7**2
        return jnp.where(inside, density, 0.0), jnp.ones_like(positions)

    field = Field(lambda key: {}, ball, lambda params, x: ball(params, x, x)[0])
    model = dataclasses.replace(
        problem.setup.models[RECONSTRUCTION],
        field=field,
        sampler=even_sampler(near=1.0, far=6.0, num=100),
    )
    setup = problem.setup._replace(models={RECONSTRUCTION: model})
    return setup, dataclasses.replace(problem.trainer.init(jax.random.key(0)), model=NOTHING_LEARNT)


def surface_of_ball(density):
    """Centres of the cells that count as surface where the ball is seen from +x alone."""
    setup, train = ball_setup(density)
    surface = make_surface_fn(setup)(train, BALL_LOOKERS)
    cells = np.stack(np.unravel_index(np.flatnonzero(surface.cells), (16, 16, 16)), -1)
    assert surface.cells.shape == (16**3,)
    return -1.0 + (cells + 0.5) / 8.0, surface.reference


def test_surface_is_where_a_training_view_meets_matter():
    centres, reference = surface_of_ball(density=60.0)
    assert len(centres) > 20
    radius = np.linalg.norm(centres, axis=-1)
    # Half a cell's diagonal, and three steps of 0.05 in which the light goes out.
    assert (np.abs(radius - 0.7) < 0.11 + 0.15).all()
    assert (centres[:, 0] > 0.0).all(), "the other side is only seen by a view that does not count"
    np.testing.assert_allclose(reference, np.median([2.3, 2.3, 0.0]))


def test_fog_has_no_surface():
    centres, _ = surface_of_ball(density=1.0)
    assert len(centres) == 0


def test_what_a_ray_is_worth():
    """Through the middle of the ball, from +x, from -x, and from +x twice as far away."""
    setup, train = ball_setup(density=60.0)
    surface = make_surface_fn(setup)(train, BALL_LOOKERS)._replace(reference=np.float32(2.3))
    fns = make_surface_coverage_fns(setup)
    rays = Rays(
        np.float32([[3.0, 0.0, 0.0], [-3.0, 0.0, 0.0], [5.3, 0.0, 0.0], [5.3, 0.9, 0.9]]),
        np.float32([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]),
    )
    way = 1.0 / np.sqrt(3.0)  # through the middle of the box, of its diagonal

    def worth(mask):
        covered = Covered(BALL_LOOKERS._replace(mask=np.array(mask)), surface)
        return np.asarray(fns.render(covered, train, rays)["uncertainty"])

    # Nobody looks: surface is new, and counts by distance; the rest of the box is unknown.
    np.testing.assert_allclose(worth([False, False]), [1.0, way, 0.25, way], atol=0.03)
    seen = worth([True, False])
    np.testing.assert_allclose(seen[[0, 2]], 0.0, atol=0.03)  # known from there
    # Surface of no training view is none; what is behind 2.3 / 0.95 from +x is unknown.
    np.testing.assert_allclose(seen[1], way * (1.0 + 3.0 - 2.3 / 0.95) / 2.0, atol=0.03)
    both = BALL_LOOKERS._replace(mask=np.array([True, True]))
    surface = make_surface_fn(setup)(train, both)
    assert (worth([True, True])[:3] < 0.03).all()


# --- who is far enough ---


def test_far_enough_equals_loops():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        nearest, mask = rng.exponential(size=12), rng.uniform(size=12) < 0.7
        mask[0] = True
        for wanted in (1, 3, int(mask.sum())):
            tau = max(d for d, m in zip(nearest, mask) if m)
            while sum(m and d >= tau for d, m in zip(nearest, mask)) < wanted:
                tau *= 0.95
            want = [m and d >= tau for d, m in zip(nearest, mask)]
            np.testing.assert_array_equal(far_from_chosen(nearest, mask, wanted), want)


@pytest.mark.parametrize("nearest", [np.zeros(4), np.full(4, np.inf), np.array([1.0, 0, 0, 0])])
def test_far_enough_at_its_limits(nearest):
    """All equally near, none chosen yet, and more wanted than any tau leaves."""
    mask = np.array([True, True, True, False])
    np.testing.assert_array_equal(far_from_chosen(nearest, mask, 3), mask)
    np.testing.assert_array_equal(far_from_chosen(nearest, mask, 9), mask)
    assert not far_from_chosen(nearest, np.zeros(4, bool), 1).any()


def test_only_what_is_far_is_looked_at_and_the_best_of_it_is_picked():
    line = np.stack([np.arange(1.0, 9.0), np.zeros(8), np.zeros(8)], -1)
    asked = []

    def mean_uncertainty(indices, picked):
        asked.append((indices.tolist(), np.flatnonzero(picked).tolist()))
        return 1.0 / (1.0 + np.asarray(indices, np.float32))  # the nearest is worth most

    ctx = make_context(
        line,
        training_positions=np.zeros((1, 3)),
        is_training_view=[True],
        centre=np.zeros(3),
        mean_uncertainty_fn=mean_uncertainty,
    )
    selected, info = acquire(POLICIES["surface_coverage"], jax.random.key(0), ctx, 2)
    # Gaps 1 .. 8: of 8, two remain at tau = 8 * 0.95^3 = 6.86. Then of 7, gaps 1 2 3 3 2 1 1.
    assert asked == [([6, 7], []), ([2, 3], [6])]
    np.testing.assert_allclose(info.scores, [-1.0] * 6 + [1 / 7, 1 / 8])
    assert selected.tolist() == [6, 2]
