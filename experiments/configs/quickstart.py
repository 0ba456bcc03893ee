"""A few minutes on a laptop: the scene that comes with the project, 4 views growing to 12."""

from experiments.configs import base


def get_config():
    config = base.get_config()
    # The paper's own policy, "bavs", loses to chance here; see the tables of the README.
    config.policies = ("bavs_spread", "random")
    config.train.num_steps = 1400
    config.rays_per_pixel = 1  # more of them pay in longer training
    return config
