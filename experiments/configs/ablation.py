"""What the method's own options change: lego, 4 views growing to 20, 5 seeds.

For `experiments.sweep`, with one of these axes at a time; the first value is the default, which the
others are compared with. The grid's L; lambda (0 stands for 1e-4 / (2^L)^3, here 4e-10); the two
radii (0 stands for 0.2 times the median camera distance, here 0.8); the scale of the candidates'
images; the weighting; the channel; and rounds against the paper's single batch:

    --axis=config.uncertainty.log2_cells=6,5,7
    --axis=config.uncertainty.prior_weight=0.0,1e-8,1e-11
    --axis=config.candidates.min_train_distance+config.candidates.min_candidate_distance=0+0,0.4+0.4,1.2+1.2
    --axis=config.candidates.image_scale=0.25,0.125,0.5
    --axis=config.uncertainty.weighting=eq13,eq11,empirical
    --axis=config.uncertainty.variant=posterior,bayesrays
    --axis=config.num_rounds+config.batch_size=4+4,2+8,1+16
"""

from experiments.configs import rivals


def get_config():
    config = rivals.get_config()
    config.policies = ("bavs",)
    return config
