"""How well uncertainty tells error: lego from 20 views, every model, 5 seeds (like Table 3)."""

from experiments.configs import blender


def get_config():
    config = blender.get_config()
    config.num_initial = 20
    config.num_rounds = 0
    config.policies = ("random",)
    config.seeds = (0, 1, 2, 3, 4)
    config.train.num_steps = 1600
    config.lpips_net = ""
    config.num_test_final = 25  # of the run; AUSE and intervals have views of their own
    return config
