"""How well uncertainty tells error: lego from 20 views, every model, 5 seeds (like Table 3)."""

from experiments.configs import blender


def get_config():
    config = blender.get_config()
    config.update(num_initial=20, num_rounds=0, policies=("random",), seeds=(0, 1, 2, 3, 4))
    config.update(lpips_net="", num_test_final=25)  # of the run; AUSE has views of its own
    config.train.num_steps = 1600
    return config
