"""What the method's own options change: lego, 4 views growing to 20, 5 seeds.

For `experiments.sweep`, which tries each of these alone beside the config as it is: the grid's L
(6); lambda (1e-4 / (2^L)^3, here 4e-10); the two radii (0.2 times the median camera distance, here
0.8); the scale of the candidates' images (0.25); the weighting (gauss_newton); the channel
(posterior); and its scale (log):

    --change=config.uncertainty.log2_cells=5,7
    --change=config.uncertainty.prior_weight=4e-8,4e-12
    --change=config.candidates.min_train_distance+config.candidates.min_candidate_distance=0.4+0.4,1.2+1.2,1.6+1.6
    --change=config.candidates.image_scale=0.125,0.5
    --change=config.uncertainty.weighting=residual_weighted,empirical_fisher
    --change=config.uncertainty.variant=bayesrays
    --change=config.uncertainty.scale=sigma

Rounds against the paper's single batch:

    --axis=config.num_rounds+config.batch_size=4+4,1+16
"""

from experiments.configs import rivals


def get_config():
    config = rivals.get_config()
    config.policies = ("bavs",)
    return config
