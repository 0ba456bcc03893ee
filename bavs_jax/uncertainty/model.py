"""The protocol of an uncertainty model: what a field does not know, as one more rendered image."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import jax
from jax.sharding import Mesh

from bavs_jax.arrays import Array
from bavs_jax.cameras import Cameras, Rays
from bavs_jax.fields.deformation import DeformationGrid
from bavs_jax.fields.flow_field import FlowField
from bavs_jax.models.base import RadianceModel
from bavs_jax.pixel_table import PixelTable
from bavs_jax.training.train import TrainState
from bavs_jax.uncertainty.channel import RenderChunkFn
from bavs_jax.uncertainty.streaming import CurvatureOfRays

Fitted = Any  # a pytree, each model's own

# Kinds of fields.
RECONSTRUCTION = "reconstruction"
VARIANCE = "variance"  # with a learned variance of each point's colour
FLOW = "flow"  # the mean of a distribution over fields


class MakeFns(Protocol):
    """Makes a model for one scene; called once for each, it compiles what it needs."""

    def __call__(self, setup: SceneSetup, /) -> ModelFns: ...


class UncertaintyModel(NamedTuple):
    """One way to say how uncertain each pixel is.

    A ray that meets nothing has an uncertainty of 0 in every model: the background of a scene whose
    background is known must not decide.
    """

    name: str  # by which a config names it
    summary: str  # one sentence
    make_fns: MakeFns
    trains: tuple[str, ...] = ()  # kinds of fields that it trains beside the reconstruction


class Fit(Protocol):
    """All that must be computed before the first pixel, from what is known."""

    def __call__(self, key: jax.Array, acquired: Acquired, /) -> Fitted: ...


class RenderFitted(Protocol):
    """Images of R rays, [R, ...] each: "rgb", "depth", "opacity", "thinned" and "uncertainty" >= 0;
    and by the names that policies ask for, further measures that are made on the way."""

    def __call__(self, fitted: Fitted, train: TrainState, rays: Rays, /) -> Mapping[str, Array]: ...


class Condition(Protocol):
    """What is still unknown once the candidates marked in `picked` [C] are photographed."""

    def __call__(self, fitted: Fitted, train: TrainState, picked: Array, /) -> Fitted: ...


class ModelFns(NamedTuple):
    """A model for one scene."""

    fit: Fit
    render: RenderFitted
    condition: Condition | None = None  # None where a model needs the photo for that


class LaplaceOptions(NamedTuple):
    """The options of the posterior (see `posterior.py` and `channel.py`)."""

    prior_weight: float  # lambda, 1 / scene unit^2
    weighting: str = "gauss_newton"
    variant: str = "posterior"
    scale: str = "log"
    extent: str = "box"
    max_rays: int | None = None  # in the curvature; a uniform subset stands for more
    offset_cells: float = 0.3  # offsets a priori, standard deviation in cells (`offset_variance`)


class SceneSetup(NamedTuple):
    """What an uncertainty model may use for one scene."""

    models: dict[str, RadianceModel]  # by kind
    flow: FlowField  # the distribution whose mean is the field of kind FLOW
    kind: str  # of the field that is trained and measured in this run
    grid: DeformationGrid
    laplace: LaplaceOptions
    curvature: CurvatureOfRays  # of the model of this kind
    render_chunk: RenderChunkFn  # of the model of this kind, with its uncertainty
    # Trains a field of any kind, from a start of its own, on the views of a acquired.
    train: Callable[[str, jax.Array, Acquired], TrainState]
    image_scale: float = 0.25  # of width and height, for renders of whole views
    chunk: int = 4096  # rays of one compiled call
    ensemble_size: int = 3  # fields, the run's own among them
    num_draws: int = 32  # of the distribution over fields
    mesh: Mesh | None = None  # devices that share the rays (see `devices.py`)

    @property
    def model(self) -> RadianceModel:
        """The model that is trained and measured in this run."""
        return self.models[self.kind]


class Acquired(NamedTuple):
    """What is known when views are to be chosen."""

    train: TrainState
    table: PixelTable
    is_training_view: Array  # [V] bool
    num_rays: int  # R of Eq 13: the training rays of round 0, fixed for the run
    candidates: Cameras | None = None  # [C]
    label: str = ""  # for progress
