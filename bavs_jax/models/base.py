"""The protocol of a radiance model: all that training, curvature, policies and pages ask of one.

A model is a bundle of pure functions. What it has learnt is in a `ModelState`, which is handed in
and out. Fields that are sampled along rays are one kind (`ray_field.py`).
"""

from collections.abc import Mapping
from typing import Any, Protocol

import jax
from flax import struct

from bavs_jax.arrays import Array
from bavs_jax.cameras import Rays
from bavs_jax.fields.base import Params
from bavs_jax.pixel_table import PixelTable
from bavs_jax.rendering.render import Channel, DisplaceFn, Rendering


class ModelState(struct.PyTreeNode):
    """What a model has learnt."""

    params: Params  # trained by gradients
    carried: Any  # a pytree; changed between steps without gradients, as an occupancy grid is


class StepReport(struct.PyTreeNode):
    """What one optimiser step reports, each []."""

    loss: jax.Array  # mean squared colour error
    rays: jax.Array  # rays that fitted the sample buffer
    samples: jax.Array  # samples that were evaluated
    thinned: jax.Array  # share of rays with more occupied steps than slots


class RayTerms(struct.PyTreeNode):
    """The points that move what R rays see, and how far, to first order; P points a ray."""

    positions: jax.Array  # [R, P, 3] scene units
    colour_jacobian: jax.Array  # [R, 3, P, 3] `dC_rc / dx_pd`, 1 / scene unit
    depth_jacobian: jax.Array  # [R, 1, P, 3] `dD_r / dx_pd`
    rgb: jax.Array  # [R, 3] C, sRGB in [0, 1]
    depth: jax.Array  # [R] D, scene units
    opacity: jax.Array  # [R] in [0, 1]
    thinned: jax.Array  # [R] bool


class RadianceModel(Protocol):
    """A radiance model of one scene.

    Attributes:
      background: [3] colour behind everything, or None (see `composite_colour`).
      most_points: P, most points of a ray that can move its colour.
      always_most: whether every ray has that many, so that counting them is of no use.
      reads_views: whether training rays are read with something of their view's own, such as an
        appearance code.
    """

    @property
    def background(self) -> Array | None: ...

    @property
    def most_points(self) -> int: ...

    @property
    def always_most(self) -> bool: ...

    @property
    def reads_views(self) -> bool: ...

    def init(self, key: jax.Array) -> ModelState:
        """A model that has seen nothing."""

    def loss(
        self, key: jax.Array, state: ModelState, table: PixelTable, is_training_view: jax.Array
    ) -> tuple[jax.Array, StepReport]:
        """What a step makes small, [], on a batch that the model draws from the training views.

        Differentiated by `state.params`; pure and jitted by the caller.
        """

    def refresh(self, key: jax.Array, state: ModelState, step: jax.Array) -> ModelState:
        """Changes `carried`, once before each compiled run of steps; `step` [] are done by then."""

    def render(
        self,
        state: ModelState,
        rays: Rays,
        *,
        channels: Mapping[str, Channel] | None = None,
        displace_fn: DisplaceFn | None = None,
    ) -> Rendering:
        """What R rays see (Eqs 2-3), all of it: nothing is left out for want of room.

        Args:
          rays: R rays of any cameras.
          channels: more quantities to composite like colour, by name.
          displace_fn: the deformation `D(x)`.
        """

    def num_points(self, state: ModelState, rays: Rays) -> jax.Array:
        """How many points of each ray can move its colour, [R] int."""

    def ray_terms(
        self, state: ModelState, rays: Rays, *, most_points: int, view_ids: jax.Array | None
    ) -> RayTerms:
        """How colour and depth change as the points that make them move (Eqs 10-13).

        Args:
          rays: R rays.
          most_points: P; all R rays have at most so many by `num_points`.
          view_ids: [R] views trained on that the rays belong to; None for rays of other cameras.
        """

    def density(self, state: ModelState, positions: jax.Array) -> jax.Array:
        """Density at points [K, 3] in scene units, [K] in 1 / scene unit; 0 where no ray looks."""

    def radiance(
        self, state: ModelState, positions: jax.Array, directions: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Density [K] and colour [K, 3] at points looked at along unit vectors [K, 3] (Eq 1)."""
