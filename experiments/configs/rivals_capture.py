"""Policies on a real capture: 4 views growing to 20, 3 seeds. Name the scene: --config.scene=..."""

from experiments.configs import capture


def get_config():
    config = capture.get_config()
    config.update(policies=("random", "farthest", "bavs_spread", "bavs"), seeds=(0, 1, 2))
    config.update(image_size=120, num_initial=4, num_rounds=4, lpips_net="")
    config.train.num_steps = 800
    return config
