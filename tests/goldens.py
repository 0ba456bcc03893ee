"""What tiny runs of fixed seeds come to, for each kind of field, sampler, model and policy.

    python -m tests.goldens OUT.json

`tests/goldens.json` was made so; `test_goldens.py` compares. A change that is meant to change
numbers makes the file anew and says why.
"""

import json
import pathlib
import sys
import tempfile

from bavs_jax.selection.policies import POLICIES
from tests.script_server import run_script
from tests.toy_runs import SMALL_NETWORKS, toy_flags

SMALL = {**SMALL_NETWORKS, "num_rounds": 1}
CASES = {
    "all policies": {"policies": repr(tuple(POLICIES))},
    "proposals": {"sampler_kind": "proposal", **SMALL},
    "nerf_mlp": {"field_kind": "nerf_mlp", **SMALL},
    "nerf_mlp, proposals": {
        "field_kind": "nerf_mlp",
        "sampler_kind": "proposal",
        **SMALL,
    },
    "mip_mlp": {"field_kind": "mip_mlp", **SMALL},
    "poses on a hemisphere": {"candidates__source": "hemisphere", "num_rounds": 1},
    "training on": {"from_scratch": "False", "uncertainty__weighting": "residual_weighted"},
    "bayesrays": {
        "uncertainty__variant": "bayesrays",
        "uncertainty__weighting": "empirical_fisher",
        "uncertainty__scale": "sigma",
        "uncertainty__max_rays": 100,
        "num_rounds": 1,
    },
}


def run_case(options: dict) -> dict:
    """Views chosen and measures of each round, by policy."""
    with tempfile.TemporaryDirectory() as folder:
        flags = toy_flags(**{"policies": "('bavs','d_optimal')", **options})
        _script("active_selection", folder, flags)
        runs = json.loads((pathlib.Path(folder) / "summary.json").read_text())["runs"]
    names = ("selected", "psnr", "ssim", "depth_mae")
    return {run["policy"]: [{n: row[n] for n in names} for row in run["rounds"]] for run in runs}


def run_models() -> dict:
    """AUSE of every uncertainty model, on its own field and on one common field."""
    with tempfile.TemporaryDirectory() as folder:
        more = {"evaluation__num_views": 2, "num_rounds": 0}
        _script("evaluate_uncertainty", folder, toy_flags(**more))
        rows = json.loads((pathlib.Path(folder) / "uncertainty.json").read_text())["rows"]
    return {row["model"]: {field: row[field] for field in ("own", "common")} for row in rows}


def _script(name: str, folder: str, flags: list[str]) -> None:
    done = run_script(f"experiments.{name}", f"--workdir={folder}", *flags, seconds=1200)
    if done.returncode:
        raise RuntimeError(f"{' '.join(done.args)}: {done.stderr[-2000:]}")


def main(out: str) -> None:
    """Runs all cases and writes what they came to."""
    found = {name: run_case(options) for name, options in CASES.items()}
    found["models"] = run_models()
    pathlib.Path(out).write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1])
