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
    config.train.learning_rate = 2e-3
    config.train.final_share = 0.01
    config.train.num_steps = 50_000
    config.uncertainty.log2_cells = 8
    return config
