"""A NeRF-synthetic scene at laptop size: 4 views growing to 20, as in the paper's Table 1."""

from experiments.configs import base


def get_config():
    config = base.get_config()
    config.update(loader="blender", scene="lego", image_size=100, num_rounds=4)
    return config
