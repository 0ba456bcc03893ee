"""Time to quality: when a target counts as reached, and the script with fresh processes."""

import json
import os
import pathlib
import subprocess
import sys

import numpy as np
import pytest

from experiments.reporting.benchmark import QUALITY, first_seconds, plateau, quality_tables
from experiments.reporting.tables import collected_text
from tests.script_server import run_script
from tests.toy_runs import toy_flags

ROOT = pathlib.Path(__file__).parents[1]


def test_a_target_is_reached_where_it_is_first_seen():
    curve = [
        {"step": n, "seconds": s, "psnr": p}
        for n, s, p in ((1, 2.0, 20.0), (2, 3.0, 25.0), (3, 4.0, 24.0), (4, 5.0, 28.5))
    ]
    assert first_seconds(curve, ["25", "28", "30"]) == {"25": 3.0, "28": 5.0, "30": None}


@pytest.mark.parametrize(
    ("psnrs", "db", "seconds"),
    [
        ([20.0, 25.0, 29.75, 29.6, 30.0], 30.0, 5.0),  # 0.4 below once more, at 4 s
        ([20.0, 29.7, 30.0, 29.8], 30.0, 2.0),  # 0.3 below is near
        ([20.0, 30.0, 29.0], 30.0, None),
        ([30.0], 30.0, 1.0),
    ],
)
def test_the_plateau_begins_where_no_later_look_is_further_below_the_best(psnrs, db, seconds):
    curve = [{"step": n, "seconds": n, "psnr": p} for n, p in enumerate(psnrs, start=1)]
    assert plateau(curve) == {"db": db, "seconds": seconds}


@pytest.mark.slow
def test_script_measures_with_a_cold_and_a_warm_cache(tmp_path):
    command = [sys.executable, "-m", "experiments.time_to_quality", f"--workdir={tmp_path}"]
    command += [*toy_flags(train__num_steps=16, train__steps_per_call=8, march__num_slots=8)]
    command += ["--num_views=3", "--num_test_views=2", "--every=8", "--targets=99,5"]
    env = os.environ | {"XDG_CACHE_HOME": str(tmp_path)}
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "time_to_quality.json").read_text())
    assert result["runs"].keys() == {"cold", "warm"} and result["num_test_views"] == 2
    for run in result["runs"].values():
        assert [point["step"] for point in run["curve"]] == [8, 16]
        seconds = [point["seconds"] for point in run["curve"]]
        assert 0 < seconds[0] < seconds[1]
        # 5 dB is less than any image in [0, 1] is likely to have; 99 dB is out of reach.
        assert run["plateau"]["db"] == max(point["psnr"] for point in run["curve"])
        assert run["seconds_to_db"] == {"5": seconds[0], "99": None}
    cold, warm = (run["curve"] for run in result["runs"].values())
    np.testing.assert_allclose(  # the same seed and the same programs
        [point["psnr"] for point in cold], [point["psnr"] for point in warm], atol=1e-3
    )
    assert any((tmp_path / "compiled").iterdir())
    assert not (tmp_path / "cold.json").exists()
    assert "not reached" in collected_text(quality_tables(tmp_path / QUALITY))
    assert (tmp_path / "time_to_quality.html").read_text().count("<svg") == 1


def test_targets_that_are_no_numbers_are_refused(tmp_path):
    command = ["experiments.time_to_quality", f"--workdir={tmp_path}", "--targets=25,high"]
    done = run_script(*command)
    assert done.returncode == 1 and done.stderr.startswith("error: --targets: ")
