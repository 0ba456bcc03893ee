"""Table 4: what the distance filter saves and gains on dozer: 300 candidates, 50 initial, 10 more.

`bavs` has the filter, `bavs_topk` has none. Time is that of scoring and selecting; candidates are
those that the filter leaves. The paper's pool of 300 leaves few test views or none; at laptop size
it is Table 2's 200. Name the scene: --config.scene=dozer.
"""

from experiments.configs.paper import table_2


def get_config(size: str = "laptop"):
    config = table_2.get_config(size)
    if size == "paper":
        config.load.pool_size = 300.0
    config.policies = ("bavs_topk", "bavs", "random")
    return config
