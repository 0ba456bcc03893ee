"""A campaign of malformed scenes: each loads, or is refused in one line, in time and in memory."""

from __future__ import annotations

import json
import pathlib
import tempfile

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from bavs_jax.scenes import load_procedural
from tests import scene_mutations as mutate
from tests.scene_files import orbit
from tests.scene_layouts import COLMAP, LAYOUTS, TRANSFORMS
from tests.scene_worker import START_SECONDS, Worker

MEMORY = 2 << 30  # bytes
PER_LAYOUT, POSE_FILES, PROCEDURAL = 110, 150, 50
CAMPAIGN = settings(
    deadline=None,
    derandomize=True,
    database=None,
    phases=[Phase.generate, Phase.shrink],
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def worker(tmp_path_factory):
    log = tmp_path_factory.mktemp("worker") / "log.txt"
    with log.open("wb") as file:
        one = Worker(file)
        yield one
        one.stop()


def warm_up(worker: Worker, kind: str, options: dict) -> None:
    """What is not damaged loads; and what is compiled then is there when the clock runs."""
    answer = worker.ask(kind, options, seconds=START_SECONDS)
    assert answer["fault"] is None and answer["error"] is None, answer


def check(answer: dict) -> None:
    """A load must end well, or in one line."""
    assert answer["fault"] is None, answer["fault"]
    assert answer["peak"] < MEMORY, f"{answer['peak'] / 2**30:.2f} GiB"
    for message in [*answer["said"], *([answer["error"]] if answer["error"] is not None else [])]:
        assert message.isprintable() and 0 < len(message) < 2000, message


def test_the_campaign_is_large():
    assert PER_LAYOUT * len(LAYOUTS) + POSE_FILES + PROCEDURAL >= 1200


@pytest.mark.parametrize("name", LAYOUTS)
def test_damaged_scenes(worker, name):
    if name in COLMAP:
        pytest.importorskip("pycolmap", reason="pycolmap is in the extra [colmap]")
    layout, count = LAYOUTS[name], 0
    with tempfile.TemporaryDirectory() as folder:
        root = layout.write(pathlib.Path(folder) / "scene")
        warm_up(worker, layout.kind, {"root": str(root)})

    @settings(CAMPAIGN, max_examples=PER_LAYOUT)
    @given(data=st.data())
    def campaign(data):
        nonlocal count
        count += 1
        with tempfile.TemporaryDirectory() as folder:
            root = layout.write(pathlib.Path(folder) / "scene")
            if name in TRANSFORMS and data.draw(st.booleans()):
                mutate.add_maps(data.draw, root, layout)
            mutate.damage(data.draw, root, layout)
            options = {"root": str(root), **mutate.options(data.draw)}
            kind = data.draw(st.sampled_from([layout.kind, layout.kind, "auto"]))
            check(worker.ask(kind, options))

    campaign()
    assert count >= PER_LAYOUT


def test_damaged_pose_files(worker, tmp_path):
    poses, count = np.array(orbit(3)), 0
    names = ("x", "y", "z", "qx", "qy", "qz", "qw")
    rows = [dict.fromkeys(names, 0.5) for _ in range(3)]
    forms = {
        "frames.json": json.dumps({"frames": [{"transform_matrix": p} for p in poses.tolist()]}),
        "list.json": json.dumps(poses.tolist()),
        "objects.json": json.dumps({"frames": rows}).removeprefix('{"frames": ').removesuffix("}"),
        "rows.csv": "\n".join(",".join(map(str, p.ravel().tolist())) for p in poses),
        "named.csv": "\n".join([",".join(names), *(",".join(map(str, r.values())) for r in rows)]),
    }
    for name, text in forms.items():
        (tmp_path / name).write_text(text)
        warm_up(worker, "poses", {"root": str(tmp_path / name)})

    @settings(CAMPAIGN, max_examples=POSE_FILES)
    @given(data=st.data())
    def campaign(data):
        nonlocal count
        count += 1
        with tempfile.TemporaryDirectory() as folder:
            root, name = pathlib.Path(folder), data.draw(st.sampled_from(sorted(forms)))
            path = root / name
            path.write_text(forms[name])
            changes = [mutate.cut, mutate.overwrite, mutate.insert, mutate.another_kind]
            if name == "frames.json":
                changes += [mutate.change_json] * 4
            if name.endswith(".json"):
                changes += [mutate.raw_json]
            else:
                changes += [mutate_cell] * 4
            data.draw(st.sampled_from(changes))(data.draw, root, None)
            check(worker.ask("poses", {"root": str(path)}))

    campaign()
    assert count >= POSE_FILES


def mutate_cell(draw, root, layout) -> None:
    """A cell of a CSV file becomes another, at times a very long one."""
    path = next(root.glob("*.csv"))
    lines = [line.split(",") for line in path.read_text().split("\n")]
    line = draw(st.sampled_from(lines))
    cells = mutate.NUMBERS.map(str) | mutate.WORDS | st.just("9" * 200_000) | st.just('"')
    line[draw(st.integers(0, len(line) - 1))] = draw(cells)
    text = "\n".join(",".join(line) for line in lines)
    path.write_bytes(text.encode("utf-8", "surrogatepass"))


def test_options_and_caches_of_the_procedural_scene(worker, tmp_path):
    whole, count = {"image_size": 4, "num_train": 2, "num_test": 1}, 0
    load_procedural(**whole, cache_dir=tmp_path)
    (cache,) = tmp_path.iterdir()
    content = cache.read_bytes()
    warm_up(worker, "procedural", whole)

    @settings(CAMPAIGN, max_examples=PROCEDURAL)
    @given(data=st.data())
    def campaign(data):
        nonlocal count
        count += 1
        with tempfile.TemporaryDirectory() as folder:
            root, options = pathlib.Path(folder), dict(whole)
            if data.draw(st.booleans()):
                # Sizes that are fine but not small take their time, and are no fault.
                values = mutate.VALUES.filter(lambda v: not (type(v) is int and 4 < v < 10**5))
                options[data.draw(st.sampled_from([*whole, "seed"]))] = data.draw(values)
            else:
                (root / cache.name).write_bytes(content)
                change = data.draw(st.sampled_from([mutate.cut, mutate.overwrite, mutate.insert]))
                change(data.draw, root, None)
                options["cache_dir"] = str(root)
            check(worker.ask("procedural", options))

    campaign()
    assert count >= PROCEDURAL


def test_a_photo_at_the_bound_takes_bounded_memory(worker, tmp_path):
    """The largest photo that is read, from a file of some kilobytes."""
    layout = LAYOUTS["nerfstudio"]
    root = layout.write(tmp_path / "scene")
    width, height = 12_000, 8_000
    rows = (b"\0" + b"\0" * 4 * width) * height
    (root / layout.image).write_bytes(mutate.png(width, height, 8, 6, rows))
    answer = worker.ask("nerfstudio", {"root": str(root), "image_size": 135}, seconds=START_SECONDS)
    check(answer)
    assert answer["error"] is None
