"""Every option of an active-selection run, with its default and what it means."""

from ml_collections import ConfigDict
from ml_collections.config_dict import placeholder  # None, with a type


def get_config() -> ConfigDict:
    config = ConfigDict()

    # --- the scene ---
    config.loader = "procedural"  # a key of bavs_jax.scenes.LOADERS
    config.data_dir = placeholder(str)  # folder of scenes; None: $BAVS_DATA/<loader>
    config.scene = "sculpture"  # folder in data_dir; of "procedural": "sculpture" or "interior"
    config.image_size = 100  # pixels of the image width; 0: as the files are

    # --- how its files are read (bavs_jax/scenes); None: as the loader sees fit ---
    config.load = ConfigDict()
    config.load.strict = False  # whether a listed image without a file is an error, or a warning
    config.load.downscale = placeholder(int)  # N reads the images of the folder images_N
    config.load.pool_size = placeholder(float)  # views to train on: a count, or a share below 1
    config.load.test_every = placeholder(int)  # instead: every so many-th view is a test view
    config.load.seed = 0  # draws the pool
    config.load.split = placeholder(str)  # of loader "lightfield"; see scenes/lightfield.py

    # --- the pool: which views are on offer, and where a run begins (bavs_jax/pools.py) ---
    config.pool = ConfigDict()
    # "even": all of it. "unbalanced": most of it in one of three bands of elevation. "arc": runs
    # begin with views of one side. "reachable": the nearest to the view taken last, one in a round.
    # "zoom": free distance, in the test views too; photos larger than image_size, or "procedural".
    config.pool.kind = "even"
    config.pool.seed = 0  # draws which band, which side, and every view's distance
    config.pool.share = 0.75  # of "unbalanced": of its views, in the crowded band
    config.pool.degrees = 60.0  # of "arc": of azimuth, between any two initial views
    config.pool.num_nearest = 5  # of "reachable": unused views on offer
    config.pool.factor = 3.0  # of "zoom": from the farthest to the nearest view

    # --- the experiment ---
    config.policies = ("bavs", "random")  # see --list_policies; the first one's views are exported
    config.seeds = (0,)
    config.num_initial = 4  # views, drawn from the pool by seed and scene alone; 0: all of them
    config.view_seed = placeholder(int)  # whose initial views all begin with; None: each its own
    config.batch_size = 4  # views chosen at once
    config.num_rounds = 2  # batches after the initial views; 1 is the paper's single iteration
    config.from_scratch = True  # train anew in each round, or train on
    config.num_test = 25  # test views between rounds, evenly spaced in the test split; 0: all
    config.num_test_final = 0  # test views after the last round; 0: all
    config.num_pictures = 4  # test views shown in the report, of the first seed
    config.lpips_net = "alex"  # "alex", "vgg" or "" for none; needs bavs_jax[lpips]
    config.checkpoint_seconds = 30.0  # at most this much work is lost when a run is killed

    # --- the field and how rays are sampled for it ---
    config.field_kind = "hash_grid"  # a key of build_model.SAMPLERS
    # "occupancy", "proposal" or "coarse_to_fine"; None: what suits field and scene.
    config.sampler_kind = placeholder(str)

    # Rays through each pixel, whose mean is its colour, in training and on test views: 1, 4 or 9.
    config.rays_per_pixel = 4

    # --- field_kind "hash_grid" (fields/hash_grid.py) ---
    config.hash_grid = ConfigDict()
    config.hash_grid.num_levels = 8
    config.hash_grid.coarsest = 16  # cells per side of the coarsest level
    config.hash_grid.finest = 128
    config.hash_grid.features = 2  # per vertex
    config.hash_grid.log2_table_size = 16
    config.hash_grid.width = 64
    config.hash_grid.geometry_features = 15
    # Of a side of the scene box, before training; in a room that cameras stand in a 15th of it.
    config.hash_grid.initial_optical_depth = 0.3
    config.hash_grid.direction_degree = 2  # spherical-harmonics bands, 1 .. 4
    config.hash_grid.appearance_features = 0  # of a code for each view trained on; 0: none

    # --- field_kind "nerf_mlp", the paper's own (fields/nerf_mlp.py); 8 x 256 in the paper ---
    config.nerf_mlp = ConfigDict()
    config.nerf_mlp.depth = 4
    config.nerf_mlp.width = 64
    config.nerf_mlp.skip = 3  # hidden layers before the encoding comes in again; 5 in the paper
    config.nerf_mlp.position_degree = 8  # octaves; 10 in the paper
    config.nerf_mlp.direction_degree = 4

    # --- field_kind "mip_mlp": the same over cones, with networks as proposals ---
    config.mip_mlp = ConfigDict()
    config.mip_mlp.depth = 4
    config.mip_mlp.width = 64
    config.mip_mlp.skip = 3
    config.mip_mlp.position_degree = 10
    config.mip_mlp.direction_degree = 4
    config.mip_mlp.proposal_depth = 2
    config.mip_mlp.proposal_width = 32

    # --- the distribution over fields of "cf_nerf" (fields/flow_field.py) ---
    config.flow = ConfigDict()
    config.flow.condition_features = 32  # 64 in its paper
    config.flow.num_flows = 4
    config.flow_training = ConfigDict()  # training/flow_loss.py
    config.flow_training.num_draws = 8  # in each step; 32 in its paper
    config.flow_training.entropy_weight = 0.01
    config.flow_training.floor = 0.01  # added to the kernels' width; 1e-5 in its code

    # --- sampler_kind "coarse_to_fine" (rendering/coarse_to_fine.py); 64 and 128 in the paper ---
    config.coarse_to_fine = ConfigDict()
    config.coarse_to_fine.num_coarse = 24
    config.coarse_to_fine.num_fine = 24

    # --- sampler_kind "occupancy" (rendering/sampling.py) ---
    config.march = ConfigDict()
    config.march.num_steps = 192  # steps through the diagonal of the scene box
    config.march.num_slots = 64  # most samples of a ray
    config.march.occupancy_resolution = 64

    # --- sampler_kind "proposal" (rendering/proposals.py) ---
    config.proposal = ConfigDict()
    config.proposal.num_proposals = (64, 32)  # samples of each proposal
    config.proposal.num_samples = 32  # of a ray, where the field is read
    config.proposal.far = 1000.0  # end of the rays of an unbounded scene, half sides of its box
    config.proposal.num_levels = 4
    config.proposal.coarsest = 16
    config.proposal.finest = (64, 128)  # of each proposal
    config.proposal.log2_table_size = 14
    config.proposal.width = 16
    config.proposal.anneal_steps = 500  # until proposals are fully trusted
    config.proposal.interlevel_weight = 1.0
    config.proposal.distortion_weight = 0.002
    config.proposal.penalty_weight = 0.1  # of the proposals' own penalty

    # --- training (training/train.py) ---
    config.train = ConfigDict()
    config.train.num_steps = 4000  # optimiser steps of each round
    config.train.num_rays = 2048  # of one step; those that do not fit into it are left out
    config.train.capacity = 8192  # samples evaluated in one step
    config.train.one_ray_share = 0.5  # of a round's steps, the first, with one ray for each pixel
    config.train.look_ahead = 2  # times as many are looked at, to leave out hidden ones; 0: never
    config.train.random_background = True  # for each ray, where photos have alpha
    config.train.learning_rate = placeholder(float)  # None: what suits the field kind
    config.train.final_share = 0.1  # of the learning rate, at the end of a round
    config.train.warmup_steps = 32  # until the learning rate has its full height
    config.train.max_grad_norm = 0.0  # longer gradients are cut to this; 0: never
    config.train.adam_b2 = 0.99
    config.train.adam_eps = 1e-15
    config.train.penalty_weight = 0.1  # of the field's own penalty: hash tables stay small
    config.train.roughness_weight = 4000.0  # of coarse hash levels, over all training pixels
    config.train.average_age = 0.07  # of what is rendered, as share of the steps done; 0: the last
    config.train.steps_per_call = 16  # compiled together

    # --- uncertainty (bavs_jax/uncertainty) ---
    config.uncertainty = ConfigDict()
    config.uncertainty.log2_cells = 6  # L: a grid of 2^L cells per side
    config.uncertainty.prior_weight = placeholder(float)  # lambda; None: 1e-4 / (2^L)^3
    config.uncertainty.weighting = (
        "gauss_newton"  # "gauss_newton", "residual_weighted" or "empirical_fisher"
    )
    config.uncertainty.variant = "posterior"  # "posterior" or "bayesrays"
    # Of pictures and AUSE, "log": log10(sigma / third of the box) on [0, 1]; "sigma".
    config.uncertainty.scale = "log"
    config.uncertainty.extent = "box"  # what counts: the scene "box", or all "space" around it too
    config.uncertainty.offset_cells = 0.3  # of "laplace_predictive": offsets a priori, in cells
    config.uncertainty.flow_draws = 16  # of "cf_nerf" when rendering; 32 in its paper
    config.uncertainty.ensemble_size = 3  # fields, the run's own among them
    config.uncertainty.max_rays = 0  # training rays in the curvature; 0: all

    # --- experiments.evaluate_uncertainty ---
    config.evaluation = ConfigDict()
    config.evaluation.models = (
        *("laplace", "laplace_predictive", "cf_nerf", "learned_variance", "ensemble", "entropy"),
    )
    config.evaluation.num_views = 50  # test views of AUSE, evenly spaced; 0: all
    config.evaluation.scale_depth = False  # one factor for all depths, where their unit is unknown
    config.evaluation.variant = "depth_mae_per_image"  # that the page shows first
    # Views for intervals, none trained on: test views, then unused ones of the pool; 0: all. A
    # quarter fits the scale, a half calibrates (48 or more promise 95 % well), a quarter tests.
    config.evaluation.num_interval_views = 200
    config.evaluation.num_interval_pixels = 1000  # of each such view, drawn uniformly; 0: all
    config.evaluation.interval_scale = "isotonic"  # "isotonic", "uncertainty" or "constant"

    # --- candidates (bavs_jax/candidates.py, bavs_jax/selection) ---
    config.candidates = ConfigDict()
    # "dataset", "hemisphere" (Eq 14), or "free": as the views of a procedural scene are drawn.
    config.candidates.source = "dataset"
    config.candidates.hemisphere_draws = 100  # poses drawn each round, unless from the dataset
    config.candidates.image_scale = 0.25  # of width and height, for the score (Eq 15)
    config.candidates.mode = placeholder(str)  # "top_k", "greedy"; None: the policy's own
    config.candidates.survivors = 0.17  # share that the max-min distance filter leaves (Fig 5)
    # Its radii in place of that, scene units.
    config.candidates.min_train_distance = placeholder(float)
    config.candidates.min_candidate_distance = placeholder(float)

    # --- what policies by target information ask about (bavs_jax/selection/targets.py) ---
    config.targets = ConfigDict()
    config.targets.kind = "pool"  # "pool": the candidates; "hemisphere" (Eq 14); "file"
    # Most target views, evenly spaced among those there are; None: 32, or 128 for gaps.
    config.targets.num = placeholder(int)
    # Of kind "file": poses in your own coordinates, such as the transforms.json of suggest_views.
    config.targets.poses_file = placeholder(str)

    return config
