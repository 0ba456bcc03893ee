"""Policies on pools that are not even: 4 initial views, one batch of 8, default training, 5 seeds.

Name the pool, or compare the same policies on several of them:

    python -m experiments.active_selection --config=experiments/configs/pools.py \\
        --config.pool.kind=unbalanced --workdir=runs/unbalanced
    python -m experiments.sweep --config=experiments/configs/pools.py \\
        --axis=config.pool.kind=even,unbalanced,arc,zoom --workdir=runs/pools

The scene is the procedural one, or any other: --config.loader=blender --config.scene=lego
--config.data_dir=FOLDER. With --config.pool.seed another band is crowded, runs begin on another
side, and views have other distances. In a pool of kind "reachable" one view is taken in a round:
see reachable.py.
"""

from experiments.configs import base


def get_config():
    config = base.get_config()
    config.update(policies=("random", "farthest", "bavs_spread", "bavs"), seeds=(0, 1, 2, 3, 4))
    config.update(num_initial=4, batch_size=8, num_rounds=1, lpips_net="")
    return config
