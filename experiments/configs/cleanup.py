"""A field with floaters on purpose: lego from 8 views, 3 seeds."""

from experiments.configs import blender


def get_config():
    config = blender.get_config()
    config.update(num_initial=8, num_rounds=0, policies=("random",), seeds=(0, 1, 2), lpips_net="")
    config.num_test_final = 25  # of the untouched field; the clean-up measures for itself
    config.train.num_steps = 1000
    return config
