"""Figure 6: PSNR against views, bavs and random, by Table 1's protocol.

The curve is on the report's first plot and, as numbers, in the `by_round` table of
experiments.tables.
"""

from experiments.configs.paper import table_1


def get_config(size: str = "laptop"):
    config = table_1.get_config(size)
    config.policies = ("bavs", "random")
    return config
