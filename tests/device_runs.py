"""A toy job on all devices there are, for `test_devices.py`.

    python -m tests.device_runs OUT [COORDINATOR NUM_PROCESSES PROCESS_ID]

Writes the gradients of one step for each objective and sampler, the curvature, the score of
candidates and the views chosen by it.
"""

import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax

from bavs_jax.cameras import take
from bavs_jax.devices import make_mesh, num_shards, put_on_all
from bavs_jax.fields.deformation import DeformationGrid
from bavs_jax.fields.flow_field import FlowOptions, make_flow_field, mean_field
from bavs_jax.fields.hash_grid import (
    HashGridOptions,
    make_hash_grid_density,
    make_hash_grid_field,
)
from bavs_jax.models.objectives import (
    make_colour_objective,
    make_flow_objective,
    make_variance_objective,
)
from bavs_jax.models.ray_field import RayField, RayTraining
from bavs_jax.pixel_table import make_pixel_table, training_pixels
from bavs_jax.rendering.proposals import make_proposal_sampler
from bavs_jax.rendering.samplers import make_occupancy_sampler
from bavs_jax.rendering.sampling import make_march_options
from bavs_jax.rendering.spacing import box_intervals
from bavs_jax.training.train import init_train_state, make_train_fn
from bavs_jax.uncertainty.channel import make_render_chunk_fn, mean_uncertainty, vertex_variance
from bavs_jax.uncertainty.predictive import make_predictive_fn
from bavs_jax.uncertainty.streaming import make_curvature_fn, table_rays
from tests.toy_scenes import toy_scene

NUM_RAYS, CAPACITY, CHUNK = 64, 4096, 128
HASH = HashGridOptions(num_levels=2, coarsest=4, finest=8, width=8, direction_degree=1)


def gradient(model, mesh, table, mask):
    """Of one step: what plain descent with a rate of 1 takes away; and the start's parameters."""
    optimiser = optax.sgd(1.0)
    train = make_train_fn(model, optimiser, lambda step: 1.0, steps_per_call=1, mesh=mesh)
    state = init_train_state(jax.random.key(0), model, optimiser)
    before = jax.tree.map(np.asarray, state.model.params)
    state, info = train(jax.random.key(1), put_on_all(state, mesh), table, mask)
    after = jax.tree.map(np.asarray, state.model.params)
    gradients = jax.tree.map(np.subtract, before, after)
    flat = np.concatenate([x.ravel() for x in jax.tree.leaves(gradients)])
    return flat, np.array([float(info.loss), float(info.rays), float(info.samples)]), state


def main(out):
    mesh = make_mesh()
    shards = num_shards(mesh)
    scene = toy_scene()
    table = put_on_all(make_pixel_table(scene), mesh)
    mask = jnp.arange(scene.num_views) < 4
    march = make_march_options(
        scene.box, near=scene.near, far=scene.far, num_steps=32, num_slots=24
    )
    sampler = make_occupancy_sampler(scene.box, march, resolution=8)
    capacity = CAPACITY // shards
    field = make_hash_grid_field(scene.box, HASH)
    with_variance = make_hash_grid_field(scene.box, HASH, learned_variance=True)
    flow = make_flow_field(scene.box, HASH, FlowOptions(condition_features=8, num_flows=2))
    proposal = make_hash_grid_density(scene.box, HASH)
    proposals = make_proposal_sampler(
        [proposal],
        partial(box_intervals, box=scene.box, near=scene.near, far=scene.far),
        num_proposals=(8,),
        num_samples=8,
    )
    jobs = {
        "colour": (field, sampler, make_colour_objective(field, mesh=mesh)),
        "proposals": (field, proposals, make_colour_objective(field, mesh=mesh)),
        "variance": (with_variance, sampler, make_variance_objective(with_variance, mesh=mesh)),
        "flow": (
            mean_field(flow),
            sampler,
            make_flow_objective(flow, mesh=mesh, num_draws=2, floor=0.01),
        ),
    }
    found = {}
    models = {
        name: RayField(
            trained,
            its_sampler,
            background=scene.background,
            box=scene.box,
            training=RayTraining(
                objective, num_rays=NUM_RAYS, capacity=capacity, penalty_weight=0.1
            ),
            capacity=capacity,
            mesh=mesh,
        )
        for name, (trained, its_sampler, objective) in jobs.items()
    }
    states = {}
    for name, model in models.items():
        values = gradient(model, mesh, table, mask)
        found[f"{name}_gradient"], found[f"{name}_info"], states[name] = values

    grid = DeformationGrid(jnp.asarray(scene.box), 2)
    model, trained = models["colour"], states["colour"].model
    curvature_fn = make_curvature_fn(model, grid, chunk_samples=256, mesh=mesh)
    pixels = table_rays(table, *training_pixels(table, mask), "gauss_newton")
    curvature = curvature_fn(trained, **pixels)[0]
    found["curvature"] = np.asarray(curvature)
    variance = vertex_variance(
        curvature, num_rays=100, prior_weight=1e-4, weighting="gauss_newton", variant="posterior"
    )
    render_chunk = make_render_chunk_fn(model, grid, variant="posterior", scale="log", mesh=mesh)
    found["scores"] = mean_uncertainty(
        lambda rays: render_chunk(trained, variance, rays),
        take(scene.cameras, np.arange(4, scene.num_views)),
        chunk=CHUNK,
    )
    found["chosen"] = np.argsort(-found["scores"], kind="stable")[:3]
    predictive = make_predictive_fn(model, grid, chunk_samples=256, mesh=mesh)
    found["predictive"] = mean_uncertainty(
        lambda rays: predictive(trained, jnp.full((grid.num_vertices, 3), 1e-4), rays),
        take(scene.cameras, np.arange(4, 6)),
        chunk=CHUNK,
    )
    if jax.process_index() == 0:
        np.savez(out, num_devices=shards, **found)


if __name__ == "__main__":
    # Everything is compiled for one run of it.
    jax.config.update("jax_disable_most_optimizations", True)
    if len(sys.argv) > 2:
        jax.distributed.initialize(sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
    main(sys.argv[1])
