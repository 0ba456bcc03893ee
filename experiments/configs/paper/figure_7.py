"""Figure 7: a Mip-NeRF 360 scene, 10 views growing by 10 every 3,000 iterations up to 30,000.

ActiveNeRF and bavs side by side on the same test views. Name the scene: --config.scene=garden.
"""

from experiments.configs import capture
from experiments.configs.paper import nerfacto
from experiments.configs.paper.sizes import of_size


def get_config(size: str = "laptop"):
    laptop = capture.get_config()
    laptop.image_size = 120
    laptop.lpips_net = ""
    laptop.train.num_steps = 800
    laptop.num_rounds = 3
    paper = nerfacto.get_config()
    paper.load.downscale = 4  # the paper is silent; outdoor scenes of Mip-NeRF 360 have 4, indoor 2
    paper.train.num_steps = 3000
    paper.num_rounds = 9  # the tenth period is the last round's training
    config = of_size(size, laptop=laptop, paper=paper)
    config.loader = "mipnerf360"
    config.num_initial = 10
    config.batch_size = 10
    config.from_scratch = False
    config.policies = ("activenerf", "bavs", "random")
    config.num_pictures = 6
    return config
