"""A real capture: a folder of photographs with their poses, indoors or out of doors.

Training on 50 views of the pool, or on all of it with --config.num_initial=0; then rounds of
selection with --config.num_rounds. Name the scene: --config.scene=FOLDER.
"""

from experiments.configs import base


def get_config():
    config = base.get_config()
    config.update(loader="nerfstudio", scene="", image_size=240, rays_per_pixel=1)
    config.update(policies=("bavs",), num_initial=50, num_rounds=0)
    config.hash_grid.update(finest=512, appearance_features=4)
    config.train.update(num_steps=4000, num_rays=1024)  # each ray with all of its samples
    config.uncertainty.max_rays = 100_000
    return config
