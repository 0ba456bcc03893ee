"""The protocol of an uncertainty model: what a field does not know, as one more rendered image."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jax.sharding import Mesh

from bavs_jax.cameras import Cameras
from bavs_jax.fields.base import Field
from bavs_jax.fields.deformation import DeformationGrid
from bavs_jax.fields.flow_field import FlowField
from bavs_jax.rendering.samplers import Sampler
from bavs_jax.training.batches import PixelTable
from bavs_jax.training.train import TrainState

# Kinds of fields.
RECONSTRUCTION = "reconstruction"
VARIANCE = "variance"  # with a learned variance of each point's colour
FLOW = "flow"  # the mean of a distribution over fields


class UncertaintyModel(NamedTuple):
    """One way to say how uncertain each pixel is.

    `make_fns(toolbox) -> ModelFns` is called once for each scene and compiles what it needs. A
    ray that meets nothing has an uncertainty of 0 in every model: the background of a scene whose
    background is known must not decide.
    """

    name: str  # by which a config names it
    summary: str  # one sentence
    make_fns: Callable[[Toolbox], ModelFns]
    trains: tuple[str, ...] = ()  # kinds of fields that it trains beside the reconstruction


class ModelFns(NamedTuple):
    """A model for one scene.

    `fit(key, situation) -> fitted`: all that must be computed before the first pixel; a pytree.
    `render(fitted, train_state, rays [R]) -> images`: a dict of [R, ...] with "rgb", "depth",
      "opacity", "thinned" and "uncertainty" >= 0; and by the names that policies ask for, further
      measures that are made on the way.
    `condition(fitted, train_state, picked [C]) -> fitted`: what is still unknown once the
      candidates that are marked are photographed too; None where a model needs the photo for that.
    """

    fit: Callable[..., Any]
    render: Callable[..., dict[str, jax.Array]]
    condition: Callable[..., Any] | None = None


class LaplaceOptions(NamedTuple):
    """The options of the posterior (see `posterior.py` and `channel.py`)."""

    prior_weight: float  # lambda, 1 / scene unit^2
    weighting: str = "eq13"
    variant: str = "posterior"
    scale: str = "log"
    extent: str = "box"
    max_rays: int | None = None  # in the curvature; a uniform subset stands for more
    offset_cells: float = 0.3  # offsets a priori, standard deviation in cells (`offset_variance`)


class Toolbox(NamedTuple):
    """What a model may use for one scene.

    `curvature(train_state, rays [N], label, *, weighting, targets=None, view_ids=None,
      ray_weight=None, group_ids=None) -> [G, 3]`, the `jac_sq_sum` (see `make_curvature_fn`); with
      `group_ids` [N] that of each of `group_size` groups of rays, [group_size, G, 3]. Shows
      progress where `label` is not None.
    `train(kind, key, situation) -> TrainState` trains a field of any kind, from a start of its own,
      on the views of the situation.
    """

    fields: dict[str, tuple[Field, Sampler]]  # by kind
    flow: FlowField  # the distribution whose mean is the field of kind FLOW
    kind: str  # of the field that is trained and measured in this run
    background: Any  # [3], or None (see `composite_colour`)
    capacity: int  # places of each device's buffer in which samples are evaluated when rendering
    grid: DeformationGrid
    laplace: LaplaceOptions
    group_size: int  # views whose curvatures are made at once, each a dense [G, 3]
    curvature: Callable
    train: Callable
    image_scale: float = 0.25  # of width and height, for renders of whole views
    chunk: int = 4096  # rays of one compiled call
    ensemble_size: int = 3  # fields, the run's own among them
    num_draws: int = 32  # of the distribution over fields
    mesh: Mesh | None = None  # devices that share the rays (see `devices.py`)


class Situation(NamedTuple):
    """What is known when views are to be chosen."""

    train: TrainState
    table: PixelTable
    is_training_view: Any  # [V] bool
    num_rays: int  # R of Eq 13: the training rays of round 0, fixed for the run
    candidates: Cameras | None = None  # [C]
    label: str = ""  # for progress
