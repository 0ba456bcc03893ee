"""What the method's own options change: lego, 4 views growing to 20, 5 seeds.

For `experiments.sweep`, which tries each of these alone beside the config as it is: the grid's L
(6); lambda (1e-4 / (2^L)^3, here 4e-10); the share of candidates that the filter leaves (0.17); the
scale of the candidates' images (0.25); the weighting (gauss_newton); and the channel (posterior). A
score by log sigma in place of sigma is a policy beside it:

    --change=config.uncertainty.log2_cells=5,7
    --change=config.uncertainty.prior_weight=4e-8,4e-12
    --change=config.candidates.survivors=0.08,0.35,0.7
    --change=config.candidates.image_scale=0.125,0.5
    --change=config.uncertainty.weighting=residual_weighted,empirical_fisher
    --change=config.uncertainty.variant=bayesrays

Rounds against the paper's single batch:

    --axis=config.num_rounds+config.batch_size=4+4,1+16
"""

from experiments.configs import rivals


def get_config():
    config = rivals.get_config()
    config.policies = ("bavs", "bavs_log")
    return config
