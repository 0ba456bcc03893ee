"""A field with floaters on purpose: lego from 8 views, 3 seeds."""

from experiments.configs import blender


def get_config():
    config = blender.get_config()
    config.num_initial = 8
    config.num_rounds = 0
    config.policies = ("random",)
    config.seeds = (0, 1, 2)
    config.train.num_steps = 1000
    config.num_test_final = 25  # of the untouched field; the clean-up measures for itself
    config.lpips_net = ""
    return config
