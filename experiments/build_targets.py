"""From a config to the views that policies by target information ask about."""

import numpy as np

from bavs_jax.candidates import candidate_cameras, scene_hemisphere
from bavs_jax.scenes import Scene, SceneError
from bavs_jax.scenes.pose_files import read_pose_file
from bavs_jax.scenes.poses import transform_poses
from bavs_jax.target_inputs import GAP_TARGETS, MakeTargets

TARGET_KINDS = ("pool", "hemisphere", "file")


def build_targets(config, scene: Scene) -> MakeTargets:
    """Makes the target views of a scene, with the lens and the image size of its photos.

    Poses of a file are fixed, those on the hemisphere are drawn anew in each round.

    Raises:
      SceneError: a file of poses that cannot be used.
    """
    kind = config.targets.kind
    if kind == "hemisphere":
        num = config.targets.num or GAP_TARGETS
        return lambda key: candidate_cameras(scene, scene_hemisphere(key, scene, num))
    if kind == "file":
        try:
            poses = read_pose_file(config.targets.poses_file)
        except SceneError as error:
            raise SceneError(f"config.targets.poses_file: {error}") from error
        poses = transform_poses(np.linalg.inv(scene.user_from_scene), poses)
        cameras = candidate_cameras(scene, poses)
        return lambda key: cameras
    return lambda key: None
