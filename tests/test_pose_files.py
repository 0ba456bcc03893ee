"""Files of reachable poses: every form reads to the same poses, every fault is one line."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bavs_jax.scenes.base import SceneError
from bavs_jax.scenes.pose_files import read_pose_file


@pytest.fixture
def poses():
    rotations = Rotation.random(4, rng=np.random.default_rng(0)).as_matrix()
    return np.concatenate([rotations, np.random.default_rng(1).normal(size=(4, 3, 1))], axis=-1)


def quaternion_rows(poses):
    quaternions = Rotation.from_matrix(poses[:, :, :3]).as_quat()
    return np.concatenate([poses[:, :, 3], quaternions], axis=-1)


def test_every_form_holds_the_same_poses(tmp_path, poses):
    square = [[*pose.tolist(), [0.0, 0.0, 0.0, 1.0]] for pose in poses]
    names = ("x", "y", "z", "qx", "qy", "qz", "qw")
    rows = quaternion_rows(poses)
    forms = {
        "frames.json": json.dumps({"frames": [{"transform_matrix": m} for m in square]}),
        "square.json": json.dumps(square),
        "matrices.json": json.dumps(poses.tolist()),
        "objects.json": json.dumps([dict(zip(names, row)) for row in rows.tolist()]),
        "named.csv": "\n".join(
            ["name," + ",".join(names)] + ["p," + ",".join(map(repr, r)) for r in rows.tolist()]
        ),
        "rows12.csv": "\n".join(",".join(map(repr, p.ravel().tolist())) for p in poses),
        "rows16.csv": "\n\n".join(",".join(map(repr, np.ravel(m).tolist())) for m in square),
    }
    for name, text in forms.items():
        (tmp_path / name).write_text(text)
        np.testing.assert_allclose(read_pose_file(tmp_path / name), poses, atol=1e-12)


@pytest.mark.parametrize(
    "name, text, message",
    [
        ("a.json", "{", "line 1: .*mend the JSON"),
        ("a.json", "{}", "frames: missing"),
        ("a.json", "[]", "holds no pose"),
        ("a.json", "3", "is no list"),
        ("a.json", '{"frames": [{}]}', r"frames\[0\]"),
        ("a.json", "[[[1, 0], [0, 1]]]", "entry 0: has shape"),
        ("a.json", "[[[2,0,0,0],[0,2,0,0],[0,0,2,0]]]", "is no rotation"),
        ("a.json", "[[[1,0,0,0],[0,1,0,0],[0,0,-1,0]]]", "is no rotation"),
        ("a.json", "[[[1,0,0,NaN],[0,1,0,0],[0,0,1,0]]]", "not finite"),
        ("a.json", '[{"x": 1, "y": 2}]', "z: missing"),
        ("a.csv", "x,y,z,qx,qy,qz,qw\n1,2,3,0,0,0,0", "row 2: the quaternion"),
        ("a.csv", "x,y,z,qx,qy,qz,qw\n1,2,3,0,0,0,b", "row 2: is no pose"),
        ("a.csv", "1,2,3", "row 1: has shape"),
        ("a.csv", "x,y,z\n1,2,3", "give a header"),
        ("a.csv", "", "holds no pose"),
    ],
)
def test_faults_are_one_line(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(SceneError, match=message) as error:
        read_pose_file(tmp_path / name)
    assert "\n" not in str(error.value) and str(tmp_path) in str(error.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(SceneError, match=r"none\.csv"):
        read_pose_file(tmp_path / "none.csv")
