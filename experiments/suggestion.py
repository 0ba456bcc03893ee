"""Free camera poses around a capture, and the batch of them that a policy chooses by its field."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.cameras import Cameras, hemisphere_poses, num_pixels, reduced_cameras, take
from bavs_jax.candidates import Candidates, candidate_cameras
from bavs_jax.placement.ascent import Ascent, ascend, policy_scores
from bavs_jax.placement.clearance import judge_positions, matter_density, within_bounds
from bavs_jax.placement.collect import PlacementError, Proposals, check_enough, collect_poses
from bavs_jax.placement.proposals import aim, box_positions, shell_positions, turned_targets
from bavs_jax.placement.seen import focus_point, in_unknown_space, share_facing
from bavs_jax.policy_inputs import make_candidate_curvature_fn
from bavs_jax.scenes import Scene, SceneError
from bavs_jax.scenes.pose_files import read_pose_file
from bavs_jax.scenes.poses import scene_points, transform_poses, user_points, user_units
from bavs_jax.selection import SelectionError
from bavs_jax.selection.batch import SelectionInfo, acquire
from bavs_jax.selection.context import make_context
from bavs_jax.selection.information import (
    Information,
    add_curvature,
    candidate_gains,
    log_det_gain,
    make_cached_curvature_fn,
)
from bavs_jax.selection.policies import get_policy
from bavs_jax.selection.worth import Worth, worth_along
from bavs_jax.uncertainty.channel import mean_uncertainty
from bavs_jax.uncertainty.model import RECONSTRUCTION
from bavs_jax.uncertainty.models.laplace import training_curvature
from bavs_jax.uncertainty.posterior import posterior_precision
from experiments.build import stream_key
from experiments.build_model import RENDER_CHUNK
from experiments.configs import capture
from experiments.evaluate import evenly_spaced
from experiments.files import read_arrays, write_arrays
from experiments.runtime import track
from experiments.trained import TrainedRun

KINDS = ("shell", "hemisphere", "box", "file")
CLEARANCE_SHARE = 0.05  # of the median distance of the photos from what they look at
SOLID_SHARE = 0.05  # the same, over which solid matter takes away half of the light
CONDITIONED = ("coverage", "surface_coverage")  # models that were made for given candidates
REFINE_SHARE = 0.15  # of that distance: as far as a chosen pose may move, along each axis
REFINE_DEGREES = 15.0  # by which its gaze may turn, up or down and aside
OPPOSITE = 1e-3  # length of the mean of two directions below which it has none of its own
NUM_AT_ONCE = 8  # candidates between two steps of the progress bar
NUM_COMPARED = 8  # photos whose repetition is what new views are compared with
FIXES = {
    "out of bounds": "widen --bounds",
    "inside matter": "move --bounds or the poses into free space, or lower --holdout and raise "
    "--train_steps if the field is foggy",
    "too near to matter": "lower --clearance",
    "in unseen space": "raise --spread, or name the free space by --candidates=box and --bounds",
    "": "list more poses, or lower --num_views",
}


# --- options ---


class Options(NamedTuple):
    """What to propose; lengths and places are in the user's coordinates."""

    num_views: int
    policy: str
    candidates: str  # one of KINDS
    num_candidates: int
    bounds: np.ndarray | None  # [2, 3]
    poses_file: str
    clearance: float  # 0: a share of the cameras' distance from what they look at
    spread: float  # of the shell, a share of that distance
    gaze_jitter: float  # degrees
    route: bool
    start: np.ndarray | None  # [3] where the route begins; None: at the last photo
    refine: int  # steps by which each chosen pose is made better; 0: none
    seed: int


def check_options(options: Options) -> None:
    """Checks what does not depend on the capture, files of poses among it.

    Raises:
      PlacementError, SelectionError, SceneError: options or a file that cannot be used.
    """
    o = options
    if o.num_candidates < o.num_views:
        raise PlacementError(
            f"--num_candidates: {o.num_candidates} cannot be used: give at least --num_views"
        )
    if o.bounds is not None and not (o.bounds[0] < o.bounds[1]).all():
        raise PlacementError("--bounds: each of x1,y1,z1 must be above x0,y0,z0: change them")
    if o.candidates == "box" and o.bounds is None:
        raise PlacementError("--bounds: is missing: --candidates=box needs x0,y0,z0,x1,y1,z1")
    if (o.candidates == "file") != bool(o.poses_file):
        raise PlacementError("--poses_file: goes with --candidates=file: give both or neither")
    if o.refine and o.poses_file:
        raise PlacementError("--refine: poses of a file stay where they are: leave it out")
    if o.start is not None and not o.route:
        raise PlacementError("--start: is only of use with --route: give both or neither")
    if o.poses_file:
        read_pose_file(o.poses_file)  # what is wrong there shows before anything is trained
    policy = get_policy(o.policy)
    if "true_error_fn" in policy.needs:
        reason = "needs the candidates' photos, which do not exist yet"
    elif policy.field_kind != RECONSTRUCTION:
        reason = f"needs a field of kind {policy.field_kind!r}"
    elif o.refine and (policy.update_fn is None and not policy.needs):
        reason = "has no score that a pose could be moved by (--refine)"
    elif o.refine and policy.uncertainty in CONDITIONED:
        reason = "knows its candidates alone, so that none can be moved (--refine)"
    else:
        return
    raise SelectionError(f"--policy: {o.policy!r} {reason}; use another policy, such as bavs")


# --- the field ---


def default_config():
    """The config of a field that is trained once on every photo of a capture."""
    config = capture.get_config()
    config.loader, config.image_size = "auto", 135
    config.num_initial = 0  # all of the pool
    config.holdout = 0  # photos left out of training, to measure the field on
    config.train.num_steps = 2400
    config.lpips_net = ""
    config.checkpoint_seconds = 20.0
    # Every photo's rays weigh in the curvature through a uniform subset, scaled up.
    config.uncertainty.max_rays = 40_000
    return config


def all_for_training(scene: Scene, holdout: int) -> Scene:
    """The scene with every view in the pool, but for `holdout` evenly spaced ones to test on."""
    views = np.arange(scene.num_views, dtype=np.int32)
    if not 0 <= holdout <= scene.num_views - 2:
        raise SceneError(
            f"{scene.name}: --holdout={holdout} of {scene.num_views} photos leaves fewer than 2 "
            "to train on: give a smaller number"
        )
    test = evenly_spaced(views, holdout) if holdout else views[:0]
    return dataclasses.replace(scene, pool=np.setdiff1d(views, test), test=test)


def photo_curvature(run: TrainedRun) -> jax.Array:
    """`jac_sq_sum` [G, 3] of all training photos, kept in the run's folder once it is made."""
    path, setup = run.folder / "curvature.npz", run.problem.setup
    if (kept := read_arrays(path, "jac_sq_sum")) is not None:
        return jnp.asarray(kept["jac_sq_sum"])
    key = stream_key(run.seed, "photos")
    jac_sq_sum = training_curvature(key, setup, run.acquired, setup.laplace.weighting)
    write_arrays(path, jac_sq_sum=np.asarray(jac_sq_sum))
    return jac_sq_sum


# --- candidates ---


class Surroundings(NamedTuple):
    """What the photos say about the place, in scene units."""

    focus: np.ndarray  # [3] what the photos look at
    distance: float  # median of the photos from there
    faces_focus: bool  # false: the photos look outwards
    clearance: float  # free radius that a camera needs


def look_around(scene: Scene, options: Options) -> Surroundings:
    """Finds the focus of the photos and sets the lengths that follow from it."""
    poses = np.asarray(scene.cameras.world_from_cam)
    focus = focus_point(poses, scene.centre)
    distance = float(np.median(np.linalg.norm(poses[:, :, 3] - focus, axis=-1)))
    clearance = options.clearance / user_units(scene) or CLEARANCE_SHARE * distance
    return Surroundings(focus, distance, share_facing(poses, focus) >= 0.5, clearance)


def in_matter(positions, density_fn: Callable, around: Surroundings) -> tuple:
    """Which places [N, 3] are inside of matter [N], and which too near to it [N]."""
    return judge_positions(
        positions,
        density_fn,
        clearance=around.clearance,
        solid_density=matter_density(SOLID_SHARE * around.distance),
    )


def propose(
    scene: Scene, density_fn: Callable, around: Surroundings, options: Options
) -> Proposals:
    """Draws and judges candidate poses; `density_fn`: points [K, 3] -> density [K], scene units.

    Raises:
      PlacementError: fewer than `options.num_views` are left.
    """
    judge = make_judge(scene, density_fn, around, options)
    draw = partial(draw_poses, scene, around, options)
    wanted = options.num_candidates
    if options.candidates == "file":
        wanted = max(wanted, len(draw(0)))
    proposals = collect_poses(draw, judge, wanted)
    check_enough(proposals, options.num_views, fixes=FIXES)
    return proposals


def make_judge(scene: Scene, density_fn: Callable, around: Surroundings, options: Options):
    """From poses [N, 3, 4] to why a camera may not stand there [N]: of `REASONS`, or -1."""
    photos = take(scene.cameras, scene.pool)

    def judge(poses):
        positions = poses[:, :, 3]
        inside, near = in_matter(positions, density_fn, around)
        in_bounds = within_bounds(user_points(scene, positions), options.bounds)
        # The first reason counts, in the order of `clearance.REASONS`.
        reason = np.select([~in_bounds, inside, near], [0, 1, 2], -1)
        if options.candidates == "shell":
            # The other kinds are places that the user has named.
            left = np.flatnonzero(reason < 0)
            reach = options.spread * around.distance
            unseen = in_unknown_space(positions[left], photos, density_fn, reach=reach)
            reason[left[unseen]] = 3
        return reason

    return judge


def draw_poses(scene: Scene, around: Surroundings, options: Options, lap: int) -> np.ndarray:
    """Poses [n, 3, 4] of one lap of drawing, scene coordinates; a file has one lap."""
    num, up = options.num_candidates, scene.up
    if options.candidates == "file":
        poses = read_pose_file(options.poses_file) if lap == 0 else np.zeros((0, 3, 4))
        return transform_poses(np.linalg.inv(scene.user_from_scene), poses)
    if options.candidates == "hemisphere":
        key = jax.random.fold_in(stream_key(options.seed, "places"), lap)
        return hemisphere_poses(key, num, centre=around.focus, radius=around.distance, up=up)
    rng = np.random.default_rng([options.seed, lap])
    targets = np.broadcast_to(around.focus, (num, 3))
    if options.candidates == "box":
        positions = scene_points(scene, box_positions(rng, num, options.bounds))
    else:
        cameras = np.asarray(scene.cameras.world_from_cam, np.float64)
        positions, pairs = shell_positions(
            rng, num, cameras[:, :, 3], focus=around.focus, up=up, spread=options.spread
        )
        if not around.faces_focus:
            # Photos that look outwards have nothing in common to look at.
            targets = positions + around.distance * gaze_between(-cameras[pairs, :, 2])
    return aim(positions, turned_targets(rng, positions, targets, options.gaze_jitter), up)


def gaze_between(directions) -> np.ndarray:
    """Unit directions [N, 3] midway between two [N, 2, 3]; of opposite ones, the first."""
    middle = directions.mean(axis=1)
    length = np.linalg.norm(middle, axis=-1, keepdims=True)
    return np.where(length > OPPOSITE, middle / np.maximum(length, OPPOSITE), directions[:, 0])


# --- the choice ---


class Suggestion(NamedTuple):
    """The chosen of C candidates, in the order of picking."""

    around: Surroundings
    proposals: Proposals
    cameras: Cameras  # [C] of these
    selected: np.ndarray  # [k] indices of candidates
    scores: np.ndarray  # [C] Eq 15 for all candidates
    info: SelectionInfo
    worth: Worth  # of what each pick tells, and the best one left would tell, nats
    photo_gain: float  # what one more photo from where there is one would tell, nats
    ascent: Ascent | None = None  # how the chosen ones were moved, if they were


def suggest(
    run: TrainedRun, jac_sq_sum, around: Surroundings, proposals: Proposals, options: Options
) -> Suggestion:
    """Chooses `num_views` of C candidates and follows what the best one left would still tell.

    `jac_sq_sum` [G, 3] is the curvature of the photos. Raises SelectionError as `acquire`.
    """
    problem, policy = run.problem, get_policy(options.policy)
    cameras = candidate_cameras(problem.scene, proposals.poses)
    small = reduced_cameras(cameras, problem.setup.image_scale)
    render = problem.render(run.state.train, jac_sq_sum, run.num_rays)
    with track(int(num_pixels(small).sum()), f"score {len(cameras)} candidates", "rays") as bar:
        scores = mean_uncertainty(render, small, chunk=RENDER_CHUNK, progress_fn=bar.advance)
    information = photo_information(run, jac_sq_sum, cameras)
    gains = information_gains(information, len(cameras), "what candidates would tell")

    source_key, choose_key = jax.random.split(stream_key(options.seed, "choice"))
    acquired = run.acquired._replace(candidates=cameras)
    fields = {"mean_uncertainty_fn": lambda rows, picked: scores[rows], "information": information}
    is_known = (policy.uncertainty, policy.measure) == ("laplace", "uncertainty")
    if not is_known or not policy.needs <= fields.keys():
        everyone = Candidates(cameras, np.arange(len(cameras)), np.ones(len(cameras), bool))
        fields |= problem.inputs(policy, source_key, acquired, everyone).fields
    about = {
        "training_positions": np.asarray(problem.table.cameras.positions),
        "is_training_view": acquired.is_training_view,
        "centre": around.focus,
    }
    context = make_context(cameras.positions, **about, **fields)
    selected, info = acquire(policy, choose_key, context, options.num_views)
    ascent = None
    if options.refine:

        def context_fn(every: Cameras, mask):
            found = Candidates(every, np.arange(len(every)), mask)
            inputs = problem.inputs(policy, source_key, acquired, found).fields
            return make_context(
                every.positions, mask=mask, places=cameras.positions, **about, **inputs
            )

        density_fn = partial(problem.density, run.state.train)
        judge = make_judge(problem.scene, density_fn, around, options)
        with track(options.refine * len(selected), "move the chosen poses", "steps") as bar:
            ascent = ascend(
                proposals.poses[selected],
                policy_scores(policy, choose_key, cameras, context_fn),
                lambda trials: judge(trials) < 0,
                up=problem.scene.up,
                length=REFINE_SHARE * around.distance,
                angle=np.radians(REFINE_DEGREES),
                steps=options.refine,
                progress_fn=bar.advance,
            )
        poses = np.array(cameras.world_from_cam)
        poses[selected] = ascent.poses
        cameras = cameras.replace(world_from_cam=poses)
        small = reduced_cameras(take(cameras, selected), problem.setup.image_scale)
        scores[selected] = mean_uncertainty(render, small, chunk=RENDER_CHUNK)
        information = photo_information(run, jac_sq_sum, cameras)
        gains[selected] = candidate_gains(information, selected, gain=log_det_gain)

    gains_of = partial(candidate_gains, gain=log_det_gain)
    worth = worth_along(information, selected, gains, add_fn=add_curvature, score_fn=gains_of)
    photos = take(problem.scene.cameras, evenly_spaced(problem.scene.pool, NUM_COMPARED))
    again = photo_information(run, jac_sq_sum, photos)
    photo_gains = information_gains(again, len(photos), "what photos would tell again")
    gain = float(np.median(photo_gains))
    return Suggestion(around, proposals, cameras, selected, scores, info, worth, gain, ascent)


def photo_information(run: TrainedRun, jac_sq_sum, cameras: Cameras) -> Information:
    """The posterior after all photos, and what each of C cameras' photos would add to it.

    The sum of Eq 13 knows no colours, so a pose is enough.
    """
    setup = run.problem.setup
    precision = posterior_precision(
        jac_sq_sum,
        num_rays=run.num_rays,
        prior_weight=setup.laplace.prior_weight,
        weighting=setup.laplace.weighting,
    )
    curvature_fn = make_cached_curvature_fn(
        make_candidate_curvature_fn(setup, run.acquired, cameras, setup.image_scale),
        num_vertices=setup.grid.num_vertices,
        group_size=setup.curvature.group_size,
    )
    return Information(precision, curvature_fn)


def information_gains(information: Information, num: int, label: str) -> np.ndarray:
    """What each of `num` cameras would tell, `sum log(1 + h / H)`, nats [num]."""
    gains = []
    with track(num, label, "views") as bar:
        for indices in np.array_split(np.arange(num), -(-num // NUM_AT_ONCE)):
            gains.append(candidate_gains(information, indices, gain=log_det_gain))
            bar.advance(len(indices))
    return np.concatenate(gains)
