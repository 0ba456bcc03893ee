"""Every acquisition policy on one NeRF-synthetic scene: 4 views growing to 20, 5 seeds."""

from bavs_jax.selection.policies import POLICIES
from experiments.configs import blender


def get_config():
    config = blender.get_config()
    config.policies = tuple(POLICIES)
    config.seeds = (0, 1, 2, 3, 4)
    config.train.num_steps = 1000
    config.lpips_net = ""  # it would take longer than rendering the test views
    return config
