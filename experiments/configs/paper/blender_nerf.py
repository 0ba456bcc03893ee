"""A NeRF-synthetic scene with the paper's own network at its full size (Eqs 1-5); for a GPU."""

from experiments.configs import blender


def get_config():
    config = blender.get_config()
    config.image_size = 400
    config.field_kind = "nerf_mlp"
    config.nerf_mlp.depth = 8
    config.nerf_mlp.width = 256
    config.nerf_mlp.skip = 5
    config.nerf_mlp.position_degree = 10
    config.coarse_to_fine.num_coarse = 64
    config.coarse_to_fine.num_fine = 128
    config.train.num_rays = 4096
    config.train.capacity = 262_144
    config.train.learning_rate = 5e-4
    config.train.num_steps = 50_000
    config.uncertainty.log2_cells = 8
    return config
