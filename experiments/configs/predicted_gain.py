"""Predicted against realised gain of each batch: lego from 4 to 20 views, briefly trained.

The same for the scene that comes with the project: --config.loader=procedural
--config.scene=sculpture.
"""

from experiments.configs import blender


def get_config():
    config = blender.get_config()
    config.policies = ("random", "farthest", "bavs", "coverage")
    config.seeds = (0, 1, 2)
    config.train.num_steps = 608
    config.num_test_final = config.num_test  # the last gain is over the same test views
    config.num_pictures = 1
    config.predict_gain = True
    config.lpips_net = ""
    return config
