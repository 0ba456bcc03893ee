"""ActiveNeRF on the paper's own network at its full size, with its field or ours; for a GPU."""

from experiments.configs.paper import blender_nerf


def get_config():
    config = blender_nerf.get_config()
    config.policies = ("activenerf", "activenerf_star")
    return config
