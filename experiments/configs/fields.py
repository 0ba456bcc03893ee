"""Fields alone: trained once on random views and measured, without any choice of views.

    python -m experiments.sweep --config=experiments/configs/fields.py --config.data_dir=FOLDER \\
        --axis=config.num_initial=4,8,12,20 --axis=seed=0:5 --workdir=runs/fields

The spread over seeds is that of views and training together; with --config.view_seed=0 all seeds
have the same views, and it is that of training alone.
"""

from experiments.configs import blender


def get_config():
    config = blender.get_config()
    config.update(policies=("random",), seeds=(0, 1, 2, 3, 4), num_initial=12, num_rounds=0)
    config.update(num_test_final=25, num_pictures=1, lpips_net="")
    return config
