"""Table 1: a NeRF-synthetic scene, 4 views growing to 20 by 4 every 40,000 iterations.

Policies: the paper's five rows, then farthest-view and ours. Other scenes with --config.scene=...;
--config.loader=procedural --config.scene=sculpture is the scene that comes with the project.
"""

from experiments.configs import rivals
from experiments.configs.paper import blender_mip
from experiments.configs.paper.sizes import of_size


def get_config(size: str = "laptop"):
    paper = blender_mip.get_config()  # "the default training setup" of Mip-NeRF 360
    paper.image_size = 800  # the paper is silent; this is the size of the files
    paper.num_test_final = 0  # all 200 test views
    paper.from_scratch = False  # as in ActiveNeRF, whose protocol the paper takes over
    paper.train.num_steps = 40_000
    paper.seeds = (0, 1, 2, 3, 4)  # the paper is silent
    paper.lpips_net = "vgg"  # the paper is silent; what NeRF's own tables have
    # Each round from scratch at laptop size, so that a view counts the same whenever it came in.
    config = of_size(size, laptop=rivals.get_config(), paper=paper)
    config.policies = (
        *("activenerf", "random", "activenerf_star", "bavs_topk", "bavs"),
        *("farthest", "bavs_spread"),
    )
    return config
