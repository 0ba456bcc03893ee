"""Distances between surfaces, and points drawn from the surface of a signed distance field."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.metrics.chamfer import nearest_distances, surface_error
from bavs_jax.placement.clearance import fibonacci_directions
from bavs_jax.scenes.sdf_surface import project_to_surface, sample_surface

KEY = jax.random.key(3)
BOX = np.array([[-1.0] * 3, [1.0] * 3])


def plane(height):
    """A lattice of points at one height."""
    x, y = np.meshgrid(np.linspace(0, 1, 20), np.linspace(0, 1, 20))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=-1)


@pytest.mark.parametrize("r, big", [(0.5, 0.8), (1.0, 1.1)])
def test_two_spheres_are_apart_by_the_difference_of_their_radii(r, big):
    directions = fibonacci_directions(500)
    got = surface_error(r * directions, big * directions, distance=0.2)
    # Points of the same directions: the nearest one is the one further out.
    np.testing.assert_allclose(got[:3], big - r, rtol=1e-6)
    assert got.f_score == (1.0 if big - r <= 0.2 else 0.0)


@pytest.mark.parametrize("shift", [0.0, 0.03, 0.125, 0.5])
def test_shifted_planes(shift):
    got = surface_error(plane(0.0), plane(shift), distance=0.125)
    np.testing.assert_allclose([got.accuracy, got.completeness, got.chamfer], shift, atol=1e-12)
    assert got.precision == got.recall == got.f_score == float(shift <= 0.125)


def test_half_of_a_surface_is_accurate_but_not_complete():
    whole = plane(0.0)
    got = surface_error(whole[whole[:, 0] < 0.5], whole, distance=1e-6)
    assert got.accuracy == 0.0 and got.precision == 1.0 and got.recall == 0.5
    np.testing.assert_allclose(got.f_score, 2 * 0.5 / 1.5)
    # Ten columns at 1 .. 10 steps from the nearest kept one, and ten at 0.
    np.testing.assert_allclose(got.completeness, np.arange(1, 11).mean() / 19 / 2, rtol=1e-12)


def test_chamfer_against_brute_force():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(30, 3)), rng.normal(size=(40, 3))
    apart = np.linalg.norm(a[:, None] - b, axis=-1)
    got = surface_error(a, b, distance=0.7)
    np.testing.assert_allclose(got.accuracy, apart.min(1).mean(), rtol=1e-12)
    np.testing.assert_allclose(got.completeness, apart.min(0).mean(), rtol=1e-12)
    np.testing.assert_allclose(got.precision, (apart.min(1) <= 0.7).mean(), rtol=1e-12)
    np.testing.assert_allclose(nearest_distances(b, a), apart.min(0), rtol=1e-12)
    back = surface_error(b, a, distance=0.7)
    assert (back.accuracy, back.recall) == (got.completeness, got.precision)


@pytest.mark.parametrize("bad", [np.zeros((0, 3)), np.zeros((4, 2)), np.zeros(3)])
def test_no_points_or_a_wrong_shape_is_an_error(bad):
    with pytest.raises(ValueError, match="predicted: has the shape"):
        surface_error(bad, plane(0.0), distance=0.1)
    with pytest.raises(ValueError, match="true: has the shape"):
        surface_error(plane(0.0), bad, distance=0.1)


def ball(points):
    return jnp.linalg.norm(points, axis=-1) - 0.6


def slab(points):
    """A box of half sides 0.5, 0.5, 0.25."""
    away = jnp.abs(points) - jnp.array([0.5, 0.5, 0.25])
    return jnp.linalg.norm(jnp.maximum(away, 0.0), axis=-1) + jnp.minimum(away.max(-1), 0.0)


def draw(signed_distance, num, **options):
    options = {"band": 0.01, "tolerance": 1e-4, "cells": 32, "chunk": 1 << 13} | options
    return sample_surface(KEY, signed_distance, BOX, num, **options)


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_points_of_a_sphere_are_on_it_and_uniform(scale):
    """Also where the function is only a bound on the distance."""
    points = draw(lambda p: scale * ball(p), 4000)
    assert points.shape == (4000, 3)
    # The tolerance is in the function's own unit.
    np.testing.assert_allclose(np.linalg.norm(points, axis=-1), 0.6, atol=1e-4 / scale + 1e-6)
    # By Archimedes each coordinate is uniform on [-r, r]: mean 0, variance r^2 / 3. Four standard
    # errors, sd / sqrt(N); of the variance sd(x^2) / sqrt(N) with sd(x^2) = r^2 sqrt(4 / 45).
    np.testing.assert_allclose(points.mean(0), 0.0, atol=4 * 0.6 / np.sqrt(3 * 4000))
    error = 4 * 0.36 * np.sqrt(4 / 45 / 4000)
    np.testing.assert_allclose((points**2).mean(0), 0.12, atol=error)


def test_faces_of_a_box_get_points_by_their_area():
    points = draw(slab, 4000)
    on_top = np.abs(np.abs(points[:, 2]) - 0.25) < 1e-4
    # Two of 1 x 1 against four of 1 x 0.5; four standard errors, and the edges' share band / side.
    np.testing.assert_allclose(on_top.mean(), 0.5, atol=4 * 0.5 / np.sqrt(4000) + 0.02)


def test_newton_steps_follow_the_gradient_to_the_surface():
    points = jnp.asarray(0.65 * fibonacci_directions(50), jnp.float32)
    moved, first = project_to_surface(ball, points, step=1e-3)
    np.testing.assert_allclose(jnp.linalg.norm(moved, axis=-1), 0.6, atol=1e-6)
    # Differences over 1e-3 are off by about 1e-3 / radius: of the direction of the way of 0.05,
    # and of the gradient's length.
    np.testing.assert_allclose(moved, 0.6 * fibonacci_directions(50), atol=2e-4)
    np.testing.assert_allclose(first, 0.05, rtol=5e-3)


def test_no_surface_is_an_error():
    with pytest.raises(ValueError, match="has no surface in the box"):
        draw(lambda p: ball(p) + 9.0, 10)
    with pytest.raises(ValueError, match="of 10 points arrived"):
        draw(ball, 10, tolerance=-1.0)
