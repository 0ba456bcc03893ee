"""A process that loads scenes it is told of, one a line, and says how each ended.

Apart from the tests, so that a crash, a hang or a growth of memory is theirs to see.
"""

from __future__ import annotations

import json
import os
import resource
import select
import subprocess
import sys
import traceback
import warnings

SECONDS = 10.0  # that a load may take
START_SECONDS = 300.0  # for the imports, and what the first load of a layout compiles


def check_scene(scene) -> None:
    """What every scene promises, whatever files it came from."""
    import numpy as np

    cameras = scene.cameras
    for field in ("world_from_cam", "intrinsics", "distortion"):
        assert np.isfinite(np.asarray(getattr(cameras, field))).all(), field
    assert (np.asarray(cameras.intrinsics)[:, :2] > 0).all()
    counts = np.asarray(cameras.sizes, np.int64).prod(axis=-1)
    assert (counts > 0).all() and np.diff(scene.offsets).tolist() == counts.tolist()
    assert scene.pixels.shape == (counts.sum(), 3) and scene.pixels.dtype == np.uint8
    assert np.isfinite(scene.box).all() and (scene.box[0] < scene.box[1]).all()
    assert 0.0 < np.float32(scene.near) < np.float32(scene.far) < np.inf
    assert np.isfinite(scene.user_from_scene).all()
    if scene.depth is not None:
        assert np.isfinite(scene.depth).all() and (scene.depth >= 0.0).all()
    views = np.concatenate([scene.pool, scene.test])
    assert len(scene.pool) and len(scene.test) and len(np.unique(views)) == len(views)
    assert len(scene.names) == len(cameras) > views.max()
    for name in (scene.name, *scene.names):
        assert name.isprintable()


def load(kind: str, options: dict) -> None:
    from bavs_jax.scenes import load_scene
    from bavs_jax.scenes.pose_files import read_pose_file

    if kind == "poses":
        read_pose_file(options["root"])
    else:
        check_scene(load_scene(kind, **options))


def peak_bytes() -> int:
    """The most memory of this process so far.

    On Linux by its own page tables: `ru_maxrss` is at least what the process that started it held,
    which is a test runner that may have grown to any size.
    """
    try:
        with open("/proc/self/status", encoding="ascii") as file:
            rows = dict(line.split(":", 1) for line in file)
        return 1024 * int(rows["VmHWM"].split()[0])
    except FileNotFoundError:
        return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def outcome(kind: str, options: dict) -> dict:
    """`error`, of a SceneError, `fault`, of anything else; and the peak of memory so far, bytes."""
    from bavs_jax.scenes import SceneError

    error = fault = None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            load(kind, options)
        except SceneError as refusal:
            error = str(refusal)
        except Exception:
            fault = traceback.format_exc()
    said = [str(w.message) for w in caught if w.category is UserWarning]
    peak = peak_bytes()
    return {"error": error, "fault": fault, "said": said, "peak": peak}


def main() -> None:
    for line in sys.stdin:
        answer = outcome(*json.loads(line))
        sys.__stdout__.write(json.dumps(answer) + "\n")
        sys.__stdout__.flush()


class Worker:
    """The process, started when it is first needed, and again after it was lost."""

    def __init__(self, log):
        self.log, self.process = log, None

    def ask(self, kind: str, options: dict, *, seconds: float = SECONDS) -> dict:
        """The outcome of a load; that the process died or hung is a `fault`."""
        if self.process is None:
            command = [sys.executable, "-u", "-m", "tests.scene_worker"]
            self.process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self.log,
                env=os.environ | {"JAX_PLATFORMS": "cpu"},
            )
        self.process.stdin.write(json.dumps([kind, options]).encode() + b"\n")
        self.process.stdin.flush()
        ready, _, _ = select.select([self.process.stdout], [], [], seconds)
        line = self.process.stdout.readline() if ready else b""
        if line:
            return json.loads(line)
        self.stop()
        return {"fault": "the process died" if ready else f"no answer within {seconds} s"}

    def stop(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.communicate()
            self.process = None


if __name__ == "__main__":
    main()
