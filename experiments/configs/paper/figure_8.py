"""Figure 8: colour and uncertainty of test views, ours and random, by Table 2's protocol."""

from experiments.configs.paper import table_2


def get_config(size: str = "laptop"):
    config = table_2.get_config(size)
    config.policies = ("bavs", "random")
    config.seeds = (0,)
    config.num_pictures = 8
    return config
