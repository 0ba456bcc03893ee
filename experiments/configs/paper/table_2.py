"""Table 2: a capture of the nerfstudio dataset, 50 random views and one batch of 10 more.

200 views make the pool, the others are test views. Origin, the field of the first 50, is round 0 of
every run. Name the scene: --config.scene=dozer.
"""

from experiments.configs import capture
from experiments.configs.paper import nerfacto
from experiments.configs.paper.sizes import of_size


def get_config(size: str = "laptop"):
    laptop = capture.get_config()
    laptop.image_size = 120
    laptop.train.num_steps = 1600
    laptop.lpips_net = ""
    laptop.num_test = 0  # Origin, too, is measured on all test views
    paper = nerfacto.get_config()
    paper.lpips_net = "alex"  # the paper is silent; nerfstudio's own is AlexNet's
    paper.num_test = 0
    config = of_size(size, laptop=laptop, paper=paper)
    config.load.pool_size = 200.0  # drawn at random; the paper does not say how
    config.num_initial = 50
    config.num_rounds = 1
    config.batch_size = 10
    config.seeds = (0, 1, 2)
    # The paper has random and bavs alone.
    config.policies = ("random", "bavs", "bavs_topk", "farthest", "bavs_spread")
    return config
