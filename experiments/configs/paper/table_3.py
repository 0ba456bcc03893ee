"""Table 3: AUSE of depth on a scene of the Light Field data; for experiments.evaluate_uncertainty.

Name the scene: --config.scene=torch, africa, statue or basket; CF-NeRF's own split of the last is
--config.load.split=basket-cfnerf. Trained on all views of the published split, 4 or 5 of them,
between the near and far planes of the papers and without contraction.
"""

from experiments.configs import base
from experiments.configs.paper import cf_nerf
from experiments.configs.paper.sizes import of_size


def get_config(size: str = "laptop"):
    laptop = base.get_config()
    laptop.image_size = 240
    laptop.train.num_steps = 1600
    paper = base.get_config()
    paper.image_size = 0  # factor 2 of the published images, as the loader reads them
    paper.field.num_levels = 16
    paper.field.finest = 2048
    paper.field.log2_table_size = 19
    paper.train.num_steps = 30_000
    paper.train.num_rays = 4096
    paper.train.capacity = 262_144
    paper.uncertainty.log2_cells = 8
    paper.flow.update(cf_nerf.get_config().flow)
    paper.flow_training.update(cf_nerf.get_config().flow_training)
    paper.uncertainty.flow_draws = 32
    config = of_size(size, laptop=laptop, paper=paper)
    config.loader = "lightfield"
    config.scene = ""
    config.load.split = config.get_oneway_ref("scene")
    config.num_initial = 0
    config.num_rounds = 0
    config.policies = ("random",)
    config.seeds = (0, 1, 2, 3, 4)  # the paper is silent
    config.lpips_net = ""
    config.evaluation.num_views = 0  # all test views
    return config
