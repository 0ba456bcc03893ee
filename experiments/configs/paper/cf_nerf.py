"""CF-NeRF at its full size: the paper's network at twice its width, 32 draws; for a GPU."""

from experiments.configs.paper import blender_nerf


def get_config():
    config = blender_nerf.get_config()
    config.policies = ("cf_nerf",)
    config.nerf_mlp.width = 512
    config.flow.condition_features = 64
    config.flow_training.num_draws = 32
    config.uncertainty.flow_draws = 32
    # 128 samples of a ray in all.
    config.coarse_to_fine.num_coarse = 64
    config.coarse_to_fine.num_fine = 64
    return config
