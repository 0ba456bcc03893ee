"""Policies of a robot that moves to one of the 5 nearest unused views at a time: 4 views, then 8.

    python -m experiments.active_selection --config=experiments/configs/reachable.py \\
        --workdir=runs/reachable

Each view is a round of its own, since what is in reach depends on the one before. So that a run
costs little more than the one batch of pools.py, its rounds train on, 1000 steps each: 9000 steps
where that takes 8000. Anew, with the default steps, they would be 36000. Curvature and scores are
made 8 times instead of once, but of 5 candidates.
"""

from experiments.configs import pools


def get_config():
    config = pools.get_config()
    config.pool.kind = "reachable"
    config.update(batch_size=1, num_rounds=8, from_scratch=False)
    config.train.num_steps = 1000
    return config
