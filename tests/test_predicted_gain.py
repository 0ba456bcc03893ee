"""Predicted gains against matrices written out, and what is made of them in result files."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.active import init_active_state
from bavs_jax.cameras import take
from bavs_jax.fields.deformation import DeformationGrid, cell_sides, vertex_positions
from bavs_jax.prediction import make_predict_fn, summed_curvature
from bavs_jax.selection.information import log_det_gain
from bavs_jax.selection.predicted_gain import (
    batch_information,
    distance_gain_db,
    expected_error,
    offset_precision,
    variance_gain_db,
    views_gain_db,
)
from bavs_jax.sources import make_candidate_curvature_fn
from bavs_jax.uncertainty.model import Situation
from experiments import workdir
from experiments.build import build_problem
from experiments.build_scene import load_config_scene
from experiments.predicted import analysis
from experiments.predicted.cases import PREDICTORS, run_cases
from experiments.predicted.compare import compare, read_cases
from experiments.predicted.planned import comparable_rows
from experiments.predicted.results import RESULT_FILE, correlation_table, stop_table
from experiments.report import ReportError
from experiments.report.results import load_runs
from experiments.runner import Run
from tests import oracles_gain as oracles
from tests.report_files import make_result
from tests.test_active import silent
from tests.toy_runs import toy_config

NUM_RAYS, NUM_OFFSETS = 7, 12


def toy(seed=0):
    """Jacobians of reference rays [7, 3, 12], H [4, 3] and what two batches add to it [2, 4, 3]."""
    rng = np.random.default_rng(seed)
    precision = rng.uniform(0.1, 2.0, (4, 3))
    return rng.normal(size=(NUM_RAYS, 3, NUM_OFFSETS)), precision, rng.exponential(size=(2, 4, 3))


def curvature_of(jacobians):
    return np.square(jacobians).sum((0, 1)).reshape(4, 3)


# --- the definition --------------------------------------------------------------------------


def test_gain_is_the_fall_of_the_expected_squared_error():
    jacobians, precision, (added, _) = toy()
    before, after = (
        oracles.expected_squared_error(jacobians, h.ravel()) for h in (precision, precision + added)
    )
    reference = curvature_of(jacobians)
    np.testing.assert_allclose(expected_error(reference, precision), NUM_RAYS * before, rtol=1e-12)
    gain = variance_gain_db(reference, precision, added)
    np.testing.assert_allclose(gain, 10.0 * np.log10(before / after), rtol=1e-10)


def test_expected_error_is_that_of_draws_from_the_posterior():
    jacobians, precision, _ = toy(1)
    rng = np.random.default_rng(2)
    errors = oracles.sampled_squared_error(rng, jacobians, precision.ravel(), 20_000)
    expected = expected_error(curvature_of(jacobians), precision) / NUM_RAYS
    assert abs(errors.mean() - expected) < 4.0 * errors.std() / np.sqrt(len(errors))


def test_gain_has_its_limits():
    jacobians, precision, (added, _) = toy()
    reference = curvature_of(jacobians)
    seen = np.array([True, False, True, False])[:, None]
    assert variance_gain_db(reference, precision, 0.0 * added) == 0.0
    assert variance_gain_db(reference * seen, precision, added * ~seen) == 0.0
    assert variance_gain_db(0.0 * reference, precision, added) == 0.0
    # A batch that settles everything: the error falls by the factor (H + h) / H of all offsets.
    gain = variance_gain_db(reference, precision, 1e6 * precision)
    np.testing.assert_allclose(gain, 10.0 * np.log10(1.0 + 1e6), rtol=1e-12)


def test_gain_never_falls_with_more_curvature_and_adds_up():
    jacobians, precision, (first, second) = toy(3)
    reference = curvature_of(jacobians)
    both = variance_gain_db(reference, precision, first + second)
    one = variance_gain_db(reference, precision, first)
    then = variance_gain_db(reference, precision + first, second)
    assert 0.0 < one < both
    np.testing.assert_allclose(one + then, both, rtol=1e-10)  # the unit of q does not matter:
    np.testing.assert_allclose(variance_gain_db(7.0 * reference, precision, first), one, rtol=1e-12)


@pytest.mark.parametrize("num, added", [(1, 1), (4, 4), (16, 4)])
def test_like_views_gain_what_counting_them_predicts(num, added):
    """n views of curvature h each, and k more of the same kind, under next to no prior."""
    jacobians, h, _ = toy(4)
    gain = variance_gain_db(curvature_of(jacobians), num * h + 1e-12, added * h)
    np.testing.assert_allclose(gain, views_gain_db(num, added), rtol=1e-9)
    np.testing.assert_allclose(views_gain_db(num, added), 10.0 * np.log10(1.0 + added / num))


def test_information_is_that_of_the_policies():
    _, precision, (added, _) = toy(5)
    want = log_det_gain(jnp.asarray(added), jnp.asarray(precision))
    # float32 sums in the policies
    np.testing.assert_allclose(batch_information(precision, added), want, rtol=1e-5)
    assert batch_information(precision, 0.0 * added) == 0.0


def test_distance_gain_of_points_on_a_line():
    pool = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    # Squared distances to the nearest view fall from 0, 1, 4, 9 to 0, 1, 1, 0.
    want = 10.0 * np.log10(14.0 / 2.0)
    np.testing.assert_allclose(distance_gain_db(pool, pool[:1], pool[3:]), want)
    assert distance_gain_db(pool, pool[:1], pool[:0]) == 0.0
    assert distance_gain_db(pool, pool[:1], pool[1:]) == np.inf
    assert distance_gain_db(pool, pool, pool[1:]) == 0.0


def test_offset_precision_is_the_prior_of_a_linear_model():
    """Colours of variance s^2 and offsets of variance std^2: textbook posterior, up to the unit."""
    jac_sq_sum, num_rays, noise, std = np.array([0.0, 0.5, 40.0]), 1000, 2e-3, 0.05
    h = 2.0 / num_rays * jac_sq_sum + offset_precision(std, num_rays=num_rays, noise_variance=noise)
    textbook = jac_sq_sum / noise + 1.0 / std**2
    np.testing.assert_allclose(h * num_rays / (2.0 * noise), textbook, rtol=1e-12)


@pytest.mark.parametrize("contracted", [False, True])
def test_cell_sides_are_between_neighbouring_vertices(contracted):
    box = jnp.array([[-1.0, 0.0, 2.0], [1.0, 4.0, 5.0]])
    grid = DeformationGrid(box, 3, contracted=contracted)
    vertices = np.asarray(vertex_positions(grid)).reshape(9, 9, 9, 3)
    want = [vertices[5, 4, 4, 0], vertices[4, 5, 4, 1], vertices[4, 4, 5, 2]] - vertices[4, 4, 4]
    np.testing.assert_allclose(cell_sides(grid), want, rtol=1e-5)  # float32 positions
    np.testing.assert_allclose(want, (box[1] - box[0]) / 8.0 * (2.0 if contracted else 1.0))


# --- with a field ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def trained():
    """A briefly trained field of 3 views, as a situation with the pool as candidates."""
    config = toy_config(predict_gain=True, candidates__image_scale=0.5)
    problem = build_problem(config, load_config_scene(config, cache_dir=None))
    step = problem.make_step("random", [0, 1, 2], silent, "")
    state = init_active_state(problem.init_train(jax.random.key(0)), problem.table, [0, 1, 2])
    state, _ = step(jax.random.key(1), state)
    cameras = take(problem.scene.cameras, problem.scene.pool)
    num_rays = int(np.diff(problem.scene.offsets)[:3].sum())
    situation = Situation(state.train, state.table, state.is_training_view, num_rays, cameras)
    return problem, situation, state, step


def test_summed_curvature_is_the_sum_over_views(trained):
    problem, situation, *_ = trained
    toolbox, cameras = problem.make_toolbox(silent), situation.candidates
    dense = make_candidate_curvature_fn(toolbox, situation, cameras, 0.5)
    want = sum(np.asarray(dense(np.array([i])), np.float64)[0] for i in (3, 8, 20))
    got = summed_curvature(toolbox, situation, cameras, [3, 8, 20], 0.5)
    assert want.max() > 0.0
    # float32 sums in another order
    np.testing.assert_allclose(got, want, rtol=1e-3, atol=1e-5 * want.max())


def test_an_active_round_says_what_its_batch_may_be_worth(trained):
    problem, situation, state, step = trained
    _, info = step(jax.random.key(2), state)
    predicted = info.choice.predicted
    assert predicted.keys() == PREDICTORS.keys() and all(v > 0.0 for v in predicted.values())
    np.testing.assert_allclose(predicted["views_db"], 10.0 * np.log10(5.0 / 3.0))
    predict = make_predict_fn(problem.make_toolbox(silent), image_scale=0.5)
    candidates, selected = info.choice.candidates, info.choice.selected
    (again,) = predict(situation, candidates, [selected])
    # Taken one by one, views are worth together what they are worth at once.
    parts = predict(situation, candidates, [selected[:1], selected[1:]])
    for name, value in predicted.items():
        np.testing.assert_allclose(again[name], value, rtol=1e-3)  # float32 sums
        np.testing.assert_allclose(parts[0][name] + parts[1][name], value, rtol=1e-3)


# --- what is made of many batches ------------------------------------------------------------


def test_rank_correlation_within_groups():
    rng = np.random.default_rng(6)
    x, y, groups = rng.normal(size=30), rng.normal(size=30), np.repeat([0, 1, 2], [5, 10, 15])
    each = [oracles.spearman(x[groups == g], y[groups == g]) for g in range(3)]
    found = analysis.rank_correlation(x, y, groups.tolist())
    np.testing.assert_allclose(found.value, np.average(each, weights=[4, 9, 14]), rtol=1e-12)
    np.testing.assert_allclose(found.standard_error, 27.0**-0.5)
    # A trend over groups alone is all of the pooled correlation, and nothing within.
    trend = 100.0 * groups
    assert analysis.rank_correlation(x + trend, y + trend, [0] * 30).value > 0.8
    assert analysis.rank_correlation(x + trend, y + trend, groups.tolist()) == found
    assert analysis.rank_correlation(trend, y, groups.tolist()).value is None


def test_standard_error_is_that_of_unrelated_numbers():
    rng = np.random.default_rng(7)
    groups = [0] * 4 + [1] * 6
    found = [
        analysis.rank_correlation(rng.normal(size=10), rng.normal(size=10), groups)
        for _ in range(500)
    ]
    spread = np.std([one.value for one in found])
    # The standard deviation of 500 numbers is known to 1 / sqrt(1000); 4 standard errors.
    np.testing.assert_allclose(spread, found[0].standard_error, rtol=4.0 / np.sqrt(1000.0))


@pytest.mark.parametrize("slope", [0.7, -0.7])
def test_line_is_the_best_one_that_does_not_fall(slope):
    rng = np.random.default_rng(8)
    x = rng.uniform(0.0, 5.0, 20)
    y = 1.0 + slope * x + rng.normal(scale=0.3, size=20)
    np.testing.assert_allclose(analysis.fit_line(x, y), oracles.brute_force_line(x, y), rtol=1e-9)
    assert analysis.fit_line([2.0, 2.0], [1.0, 3.0]) == (2.0, 0.0)


def test_calibration_does_not_look_at_what_it_is_tried_on():
    x, seeds = np.arange(12.0), np.repeat([0, 1, 2], 4)
    y = 2.0 + 0.5 * x
    exact = analysis.calibrate_on_others(x, y, seeds.tolist())
    np.testing.assert_allclose(exact.predicted, y, rtol=1e-12)
    np.testing.assert_allclose(exact.constant[:4], y[4:].mean())
    spoilt = np.where(seeds == 1, 99.0, y)
    mapped = analysis.calibrate_on_others(x, spoilt, seeds.tolist()).predicted
    np.testing.assert_allclose(mapped[seeds == 1], y[seeds == 1], rtol=1e-12)
    assert np.isnan(analysis.calibrate_on_others(x, y, [0] * 12).predicted).all()
    assert analysis.root_mean_square([3.0, -4.0]) == np.sqrt(12.5)


def test_stop_rule_counts_both_kinds_of_misses():
    rule = analysis.stop_rule([0.1, 0.1, 0.9, 0.9, 0.5], [0.2, 0.8, 0.3, 1.0, 0.7], 0.5)
    # stops at the first two; the first and the third should have been stopped at
    assert (rule.num_stops, rule.false_stops, rule.missed_stops) == (2, 1, 1)
    np.testing.assert_allclose([rule.hit_rate, rule.base_rate], [0.6, 0.6])


# --- from files ------------------------------------------------------------------------------


def write_runs(folder, *, scene="toy", seeds=(0, 1, 2), policies=("bavs", "random")):
    """Finished runs whose realised gain is half of the predicted one, and 0.1 dB."""
    rng, runs = np.random.default_rng(9), []
    for policy in policies:
        for seed in seeds:
            result = make_result(policy, seed)
            result["scene"]["name"] = scene
            for before, after in zip(result["rounds"], result["rounds"][1:]):
                gain = rng.uniform(0.0, 3.0)
                after["psnr"] = before["psnr"] + 0.5 * gain + 0.1
                numbers = dict.fromkeys(PREDICTORS, 1.0) | {"variance_db": gain}
                after["predicted"] = numbers | {"distance_db": None}
            runs.append(result)
    folder.mkdir()
    path = folder / "summary.json"
    path.write_text(json.dumps({"schema_version": 1, "runs": runs}))
    return folder


def test_command_compares_several_scenes(tmp_path):
    folders = [write_runs(tmp_path / name, scene=name) for name in ("one", "two")]
    result = compare(folders, tmp_path / "out", command="")
    assert json.loads((tmp_path / "out" / RESULT_FILE).read_text()) == result
    assert len(result["cases"]) == 2 * 2 * 3 * 4 and result["left_out"] == 0
    found = result["predictors"]["variance_db"]
    assert all(one["value"] > 0.999 for one in found["correlation"].values())
    np.testing.assert_allclose(found["line"], [0.1, 0.5], rtol=1e-9)
    for held in ("seed", "scene"):
        assert found["calibration"][held]["rmse"] < 1e-9
        assert all(rule["hit_rate"] == 1.0 for rule in found["calibration"][held]["stop"])
    assert result["predictors"]["views_db"]["correlation"]["pooled"]["value"] is None
    assert "distance_db" not in result["predictors"]  # known of no case
    table = correlation_table(result)
    assert table.rows[0][1].text == "+1.00 ± 0.15" and table.rows[-1][0].text == "a constant"
    assert len(stop_table(result, "scene").rows) == 3 * 4
    page = (tmp_path / "out" / "predicted_gain.html").read_text()
    assert page.count("<svg") == 4 and "48 batches" in page


def test_rounds_on_other_test_views_are_left_out(tmp_path):
    folder = write_runs(tmp_path / "one", seeds=(0,), policies=("random",))
    (run,) = load_runs(folder)
    run.rounds[-1]["num_test_views"] = 200
    del run.rounds[1]["predicted"]
    cases, left_out = run_cases(run)
    assert [case.round for case in cases] == [2, 3] and left_out == 2


@pytest.mark.slow
def test_a_plan_begins_with_what_the_run_itself_predicted(tmp_path):
    """Runs the real loop, then predicts its batches anew from the checkpoint of round 0."""
    config = toy_config(predict_gain=True, policies=("random",), num_test_final=2)
    workdir.claim(tmp_path, config)
    problem = build_problem(config, load_config_scene(config, cache_dir=None))
    first = Run(config, problem, tmp_path, None, 0)
    first.finish()
    Run(config, problem, tmp_path, "random", 0).finish(first)
    workdir.collect(tmp_path)
    recorded, _, _ = read_cases([tmp_path])
    planned, left_out, _ = read_cases([tmp_path], planned=True)
    assert [case.round for case in planned] == [1, 2] and left_out == 0
    for name, value in recorded[0].predicted.items():
        np.testing.assert_allclose(planned[0].predicted[name], value, rtol=1e-3)  # float32 sums
    # From the second batch on the field is another one; what needs no field is the same.
    assert planned[1].predicted["variance_db"] != recorded[1].predicted["variance_db"]
    for name in ("views_db", "distance_db"):
        np.testing.assert_allclose(planned[1].predicted[name], recorded[1].predicted[name])
    assert [case.realised for case in planned] == [case.realised for case in recorded]


def test_a_plan_ends_with_the_last_batch_that_can_be_compared():
    rounds = [{"num_test_views": n, "psnr": 20.0} for n in (25, 25, 25, 200)]
    assert comparable_rows(rounds) == rounds[1:3]
    assert comparable_rows(rounds[:1]) == []


def test_one_seed_and_scene_are_not_calibrated(tmp_path):
    result = compare([write_runs(tmp_path / "one", seeds=(0,))], tmp_path, command="")
    assert result["predictors"]["variance_db"]["calibration"] == {"seed": None, "scene": None}
    assert "one seed only" in stop_table(result, "seed").reasons


def test_runs_without_predictions_are_refused_with_the_fix(tmp_path):
    path = tmp_path / "summary.json"
    path.write_text(json.dumps({"schema_version": 1, "runs": [make_result()]}))
    with pytest.raises(ReportError, match="predict_gain=True"):
        compare([tmp_path], tmp_path, command="")
