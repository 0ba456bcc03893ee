"""How much arithmetic and memory traffic each stage takes.

Counted is what the compiled code does, on pieces of it without loops:

- training: one optimiser step of its real shapes, empty places of the sample buffer included, and
  the update of what the sampler carries, once for each compiled call;
- rendering and scoring: one chunk of rays with a buffer that its samples just fill, times chunks;
- curvature: one chunk of rays as wide as the mean ray that meets something, divided by its slots,
  times the samples of all rays; and finding out how many samples each ray has;
- selection: distances of all candidates to all training views, once for the filter and twice for
  the report, and two rows of distances between candidates for each one that the filter kept at
  last: it is kept, and ranked. Attempts before are left out.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.cameras import Rays
from bavs_jax.rendering.pixels import basic_images
from bavs_jax.rendering.render import render_rays
from bavs_jax.rendering.sampling import first_slots
from bavs_jax.selection.batch import SelectionInfo
from bavs_jax.selection.context import Context
from bavs_jax.selection.distances import nearest_distances, pairwise_distances
from bavs_jax.training.train import TrainState
from bavs_jax.uncertainty.channel import make_uncertainty_channel
from bavs_jax.uncertainty.curvature import add_jac_sq_sum
from bavs_jax.uncertainty.model import RECONSTRUCTION
from experiments.bench.subject import SEED, Subject, changed
from experiments.bench.timing import Work, compiled_work
from experiments.build_trainer import build_trainer
from experiments.keys import run_key

CHUNK_SAMPLES = 8192  # slots of the piece of curvature
MIN_WIDTH = 8


def training_work(subject: Subject, state: TrainState) -> Work:
    """Of one compiled training call."""
    config, problem = subject.config, subject.problem
    short = changed(config, train__steps_per_call=1)
    trainer = build_trainer(short, subject.scene, len(problem.table.cameras), RECONSTRUCTION)
    key = run_key(SEED)
    call = compiled_work(trainer.call, key, state, problem.table, subject.is_training_view)

    def update(key, state):
        density_fn = partial(trainer.field.density, state.params["field"])
        return trainer.sampler.update(key, state.sampler_state, density_fn, state.step)

    update_work = compiled_work(update, key, state)
    return (call - update_work) * config.train.steps_per_call + update_work


def rendering_work(
    subject: Subject, state: TrainState, rays: Rays, num_samples: int, variance=None
) -> Work:
    """Of one chunk of rays with so many samples in all; with a variance, of its uncertainty too."""
    toolbox = subject.toolbox
    field, sampler = toolbox.fields[toolbox.kind]
    options = toolbox.laplace

    def piece(state, variance, rays):
        channels = {}
        if variance is not None:
            channels["uncertainty"] = make_uncertainty_channel(
                toolbox.grid,
                variance,
                variant=options.variant,
                scale=options.scale,
                extent=options.extent,
            )
        samples, _ = sampler.sample(None, state.params["sampler"], state.sampler_state, rays)
        rendering = render_rays(
            rays,
            samples,
            partial(field.apply, state.params["field"]),
            background=toolbox.background,
            capacity=num_samples,
            exact=False,
            inputs=field.inputs(rays, samples),
            channels=channels,
        )
        return basic_images(rendering, samples), rendering.channels

    return compiled_work(piece, state, variance, rays)


def curvature_work(subject: Subject, state: TrainState, rays: Rays, counts: np.ndarray) -> Work:
    """Of all rays [R], whose numbers of samples are `counts` [R]."""
    toolbox = subject.toolbox
    field, sampler = toolbox.fields[toolbox.kind]
    grid, weighting = toolbox.grid, toolbox.laplace.weighting
    finding = compiled_work(subject.count_samples, state, rays)
    if not counts.any():
        return finding
    width = slot_width(float(counts[counts > 0].mean()), sampler.num_slots)
    num = max(CHUNK_SAMPLES // width, 1)

    def piece(total, state, rays, target):
        samples, _ = sampler.sample(None, state.params["sampler"], state.sampler_state, rays)
        samples = first_slots(samples, width)
        return add_jac_sq_sum(
            total,
            partial(field.apply, state.params["field"]),
            grid,
            rays,
            samples,
            background=toolbox.background,
            target=None if weighting == "eq13" else target,
            weighting=weighting,
            inputs=field.inputs(rays, samples),
        )

    some = jax.tree.map(lambda x: jnp.resize(x, (num, 3)), rays)
    total = jax.ShapeDtypeStruct((grid.num_vertices, 3), jnp.float32)
    chunk = compiled_work(piece, total, state, some, some.origins)
    return chunk * (float(counts.sum()) / (num * width)) + finding


def slot_width(mean_samples: float, num_slots: int) -> int:
    """The smallest power of two that holds the mean ray, at most the slots that there are."""
    power = 2 ** int(np.ceil(np.log2(max(mean_samples, 1.0))))
    return min(max(power, MIN_WIDTH), num_slots)


def selection_work(ctx: Context, info: SelectionInfo) -> Work:
    """Of one batch; nearly all of it is distances."""
    to_training = compiled_work(
        nearest_distances, ctx.positions, ctx.training_positions, ctx.is_training_view
    )
    row = compiled_work(pairwise_distances, ctx.positions, ctx.positions[:1])
    return to_training * 3 + row * (2 * int(info.survivors.sum()))
