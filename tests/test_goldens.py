"""Tiny runs of fixed seeds come to what they came to before."""

import json
import pathlib

import numpy as np
import pytest

from tests.goldens import CASES, run_case, run_models

GOLDENS = json.loads(pathlib.Path(__file__).with_name("goldens.json").read_text())
pytestmark = pytest.mark.slow


def assert_alike(found, wanted, path=""):
    """Names, views and counts are equal; measures but for the last digits of float32 sums."""
    if isinstance(wanted, dict):
        assert found.keys() == wanted.keys(), path
        for name in wanted:
            assert_alike(found[name], wanted[name], f"{path}/{name}")
    elif isinstance(wanted, list):
        assert len(found) == len(wanted), path
        for number, (one, other) in enumerate(zip(found, wanted)):
            assert_alike(one, other, f"{path}/{number}")
    elif isinstance(wanted, float):
        np.testing.assert_allclose(found, wanted, rtol=2e-3, atol=2e-3, err_msg=path)
    else:
        assert found == wanted, path


def test_runs_of_all_policies_choose_the_same_views_and_measure_the_same(users_compilation):
    assert_alike(run_case(CASES["all policies"]), GOLDENS["all policies"])


@pytest.mark.parametrize("name", [name for name in CASES if name != "all policies"])
def test_a_tiny_run_chooses_the_same_views_and_measures_the_same(name):
    assert_alike(run_case(CASES[name]), GOLDENS[name])


def test_every_uncertainty_model_measures_the_same():
    assert_alike(run_models(), GOLDENS["models"])
