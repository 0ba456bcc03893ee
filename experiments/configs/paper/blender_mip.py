"""A NeRF-synthetic scene with Mip-NeRF 360 in its bounded form, at its full size; for a GPU."""

from experiments.configs import blender


def get_config():
    config = blender.get_config()
    config.image_size = 400
    config.field_kind = "mip_mlp"
    config.mip_mlp.depth = 8
    config.mip_mlp.width = 1024
    config.mip_mlp.skip = 5
    config.mip_mlp.position_degree = 12
    config.mip_mlp.proposal_depth = 4
    config.mip_mlp.proposal_width = 256
    config.proposal.num_proposals = (64, 64)
    config.proposal.num_samples = 32
    config.proposal.anneal_steps = 1000
    config.proposal.distortion_weight = 0.01
    config.train.num_rays = 16_384  # some 20 GB of activations; 4096 fit a smaller GPU
    config.train.capacity = 65_536
    config.train.learning_rate = 2e-3
    config.train.final_share = 0.01
    config.train.warmup_steps = 512
    config.train.max_grad_norm = 1e-3
    config.train.adam_b2 = 0.999
    config.train.adam_eps = 1e-6
    config.train.num_steps = 50_000
    config.uncertainty.log2_cells = 8
    config.uncertainty.max_rays = 409_600  # a uniform subset: 4 views have 2.6 million
    return config
