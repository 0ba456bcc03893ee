"""A real capture with a field of nerfacto's size and schedule; for a GPU."""

from experiments.configs import capture


def get_config():
    config = capture.get_config()
    config.image_size = 0  # as the files are; --config.load.downscale=2 takes the folder images_2
    config.field.num_levels = 16
    config.field.finest = 2048
    config.field.log2_table_size = 19
    config.field.direction_degree = 4
    config.field.appearance_features = 32
    config.proposal.num_proposals = (256, 96)
    config.proposal.num_samples = 48
    config.proposal.num_levels = 5
    config.proposal.finest = (128, 256)
    config.proposal.log2_table_size = 17
    config.train.num_steps = 30_000
    config.train.num_rays = 4096
    config.train.capacity = 262_144
    config.uncertainty.log2_cells = 8
    config.uncertainty.max_rays = 0
    return config
