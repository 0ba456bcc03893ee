"""Policies on a real capture: 4 views growing to 20, 3 seeds. Name the scene: --config.scene=..."""

from experiments.configs import capture


def get_config():
    config = capture.get_config()
    config.policies = ("random", "farthest", "bavs_spread", "bavs")
    config.seeds = (0, 1, 2)
    config.image_size = 120
    config.num_initial = 4
    config.num_rounds = 4
    config.train.num_steps = 800
    config.lpips_net = ""  # as in rivals.py
    return config
