"""Coverage: from how new a direction does a ray look at what it meets?"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.arrays import Array
from bavs_jax.cameras import num_pixels
from bavs_jax.devices import jit_over_rays
from bavs_jax.rendering.images import render_views
from bavs_jax.rendering.render import Channel, RayRendering, basic_images
from bavs_jax.rendering.sampling import sample_positions
from bavs_jax.uncertainty.images import make_image_fn, render_stack
from bavs_jax.uncertainty.measures import direction_novelty
from bavs_jax.uncertainty.model import ModelFns, SceneSetup, UncertaintyModel
from bavs_jax.uncertainty.surface import (
    SURFACE_WEIGHT,
    Lookers,
    cell_number,
    nearness,
    surface_novelty,
    unknown_share,
)

OPAQUE = 0.5  # opacity of a pixel from which on its depth is that of a surface


class Covered(NamedTuple):
    """Who has seen the scene: V views and C candidates, of which only the marked ones count."""

    lookers: Lookers  # [V + C]
    surface: Surface | None = None  # where the model asks for one


class Surface(NamedTuple):
    """What the views so far say of where the surface is, by the field as it is now."""

    cells: Array  # [cells^3] bool, of training views and picks
    reference: Array  # [] r_ref, the median distance of training views from it, scene units


# "uncertainty" [R] of what rays see, beside `basic_images`.
ImagesFn = Callable[..., dict[str, jax.Array]]


def make_covered_fns(setup: SceneSetup, images_fn: ImagesFn, *, find_surface=False) -> ModelFns:
    """Makes a model by who has seen what: renders of views, picks among them, are what is fitted.

    Args:
      setup: the scene.
      images_fn: from a model's state, what is covered, and rays.
      find_surface: whether `Covered.surface` is needed.
    """
    plain_images = make_image_fn(setup, setup.kind)
    compiled = jit_over_rays(images_fn, setup.mesh, sharded=(False, False, True))

    def look(train, cameras, mask, scale):
        small, *maps = render_stack(
            partial(plain_images, train),
            cameras,
            mask,
            scale=scale,
            chunk=setup.chunk,
            names=("depth", "opacity"),
        )
        return Lookers(small, mask, *maps)

    def fit(key, acquired):
        del key
        cameras = jax.tree.map(
            lambda a, b: jnp.concatenate([a, b]), acquired.table.cameras, acquired.candidates
        )
        unused = np.zeros(len(acquired.candidates), bool)
        mask = np.concatenate([np.asarray(acquired.is_training_view), unused])
        lookers = look(acquired.train, cameras, mask, setup.image_scale)
        surface = surface_of(acquired.train, lookers) if find_surface else None
        return Covered(lookers, surface)

    surface_of = make_surface_fn(setup)

    def condition(covered, train, picked):
        before = covered.lookers
        mask = before.mask.copy()
        mask[-len(picked) :] = picked
        new = mask & ~before.mask
        if not new.any():
            return covered
        more = look(train, before.cameras, new, 1.0)  # already reduced: as they are
        lookers = before._replace(
            mask=mask,
            depth_maps=before.depth_maps + more.depth_maps,
            opacity_maps=before.opacity_maps + more.opacity_maps,
        )
        surface = covered.surface
        if surface is not None:
            seen = surface_of(train, more).cells
            surface = surface._replace(cells=np.asarray(surface.cells) | np.asarray(seen))
        return Covered(lookers, surface)

    def render(covered, train, rays):
        return compiled(train.model, covered, rays)

    return ModelFns(fit, render, condition)


def make_surface_fn(setup: SceneSetup) -> Callable[..., Surface]:
    """Makes what finds the surface: (state of training, views) -> `Surface` of these views."""
    grid = setup.grid

    def surface_cells(state, rays):
        rendering = setup.model.render(state, rays)
        if not isinstance(rendering, RayRendering):
            raise TypeError(f"{setup.kind}: has no samples along its rays, which surfaces are of")
        cells = cell_number(grid, sample_positions(rays, rendering.samples))
        return {"cells": jnp.where(rendering.weights >= SURFACE_WEIGHT, cells, -1)}

    compiled = jit_over_rays(surface_cells, setup.mesh, sharded=(False, True))

    def surface_of(train, lookers):
        is_surface = np.zeros(grid.cells**3 + 1, bool)  # the last one stands for no cell
        views = np.flatnonzero(lookers.mask)
        # As many as fill a call: all samples of all images would be large.
        at_once = max(1, setup.chunk // int(num_pixels(lookers.cameras)[0]))
        for start in range(0, len(views), at_once):
            some = views[start : start + at_once]
            fn = partial(compiled, train.model)
            for image in render_views(fn, lookers.cameras, some, chunk=setup.chunk):
                is_surface[image["cells"]] = True
        depths = lookers.depth_maps[lookers.opacity_maps >= OPAQUE]
        # Where nothing is opaque nothing is far.
        reference = np.median(depths) if len(depths) else np.finfo(np.float32).max
        return Surface(is_surface[:-1], np.asarray(reference, np.float32))

    return surface_of


def make_fns(setup: SceneSetup) -> ModelFns:
    """Depth maps of the training views are fitted, so that a view covers only what it sees."""

    def images(state, covered, rays):
        seen = covered.lookers
        novelty = partial(
            direction_novelty,
            cameras=seen.cameras,
            mask=seen.mask,
            depth_maps=seen.depth_maps,
        )
        channels = {"uncertainty": Channel(novelty)}
        rendering = setup.model.render(state, rays, channels=channels)
        return {**basic_images(rendering), **rendering.channels}

    return make_covered_fns(setup, images)


def make_surface_coverage_fns(setup: SceneSetup) -> ModelFns:
    """See `uncertainty/surface.py`; what a pick meets is surface from then on."""

    def images(state, covered, rays):
        lookers, surface = covered.lookers, covered.surface

        def on_surface(points):
            return surface.cells[cell_number(setup.grid, points)]

        def novelty(points, directions):
            return jnp.where(on_surface(points), surface_novelty(points, directions, lookers), 0.0)

        channels = {
            "novelty": Channel(novelty),
            "surface": Channel(lambda points, _: on_surface(points).astype(jnp.float32)),
        }
        rendering = setup.model.render(state, rays, channels=channels)
        is_free = jnp.clip(1.0 - rendering.channels["surface"], 0.0, 1.0)
        near = nearness(rendering.depth, surface.reference)
        unknown = unknown_share(rays, setup.grid.box, lookers)
        uncertainty = near * rendering.channels["novelty"] + is_free * unknown
        return {**basic_images(rendering), "uncertainty": uncertainty}

    return make_covered_fns(setup, images, find_surface=True)


UNCERTAINTY_MODELS = (
    # CONVERGE.
    UncertaintyModel(
        name="coverage",
        summary="How new the direction is from which each point is looked at.",
        make_fns=make_fns,
    ),
    # SBV, AGILE.
    UncertaintyModel(
        name="surface_coverage",
        summary="How new the direction is from which surface is looked at, and unseen space.",
        make_fns=make_surface_coverage_fns,
    ),
)
