"""A real capture: a folder of photographs with their poses, indoors or out of doors.

Training on 50 views of the pool, or on all of it with --config.num_initial=0; then rounds of
selection with --config.num_rounds. Name the scene: --config.scene=FOLDER.
"""

from experiments.configs import base


def get_config():
    config = base.get_config()
    config.loader = "nerfstudio"
    config.scene = ""
    config.image_size = 240
    config.policies = ("bavs",)
    config.num_initial = 50
    config.num_rounds = 0
    config.rays_per_pixel = 1
    config.hash_grid.finest = 512
    config.hash_grid.appearance_features = 4
    config.train.num_rays = 1024  # each with all of its samples
    config.train.num_steps = 4000
    config.uncertainty.max_rays = 100_000
    return config
