"""What options may be: the schema knows them all, every config passes, bad values do not."""

import importlib
import json
import math
import pkgutil
import re
import tracemalloc
from functools import reduce
from operator import getitem

import pytest
from ml_collections import ConfigDict

from experiments import configs
from experiments.build import check_views
from experiments.configs import base, quickstart
from experiments.configs.paper import protocols
from experiments.files import OLD_VALUES
from experiments.runtime import ConfigError
from experiments.schema import FLAG, SCHEMA, check_config, leaves
from experiments.stages import check_sizes, default_sizes
from experiments.suggestion import default_config
from experiments.sweep_plan import MAX_TRIALS, parse_axes
from experiments.trained import saved_config
from tests.toy_runs import OVERRIDES, toy_config
from tests.toy_scenes import toy_scene

# Refused by every option, whatever it is.
BAD = (
    *(math.nan, math.inf, -math.inf, -1, -0.5, 10**12, 1e300, -(10**5000), 10**5000, 1j),
    *(b"bytes", [], [1], {}, {"a": 1}, {1}, object(), int),
    *((), ((),), (((1,),),), (math.nan,), (-1,), (True,), ("",), (None,), (10**12,), ("nonsense",)),
    *("\0", "a\nb", "\x1b[2J", "\udcff", "x" * 5000),
)
ZERO_IS_FINE = {
    *("image_size", "load.downscale", "load.pool_size", "load.test_every", "load.seed"),
    *("pool.seed", "num_initial", "num_rounds", "num_test", "num_test_final", "num_pictures"),
    *("checkpoint_seconds", "hash_grid.appearance_features", "nerf_mlp.skip", "mip_mlp.skip"),
    *("flow_training.entropy_weight", "proposal.anneal_steps", "proposal.interlevel_weight"),
    *("proposal.distortion_weight", "proposal.penalty_weight", "train.learning_rate"),
    *("train.warmup_steps", "train.max_grad_norm", "train.adam_b2", "train.penalty_weight"),
    *("train.average_age", "train.roughness_weight", "train.look_ahead", "train.one_ray_share"),
    *("view_seed", "uncertainty.prior_weight", "uncertainty.max_rays", "evaluation.num_views"),
    *("evaluation.num_interval_views", "evaluation.num_interval_pixels"),
    *("candidates.min_train_distance", "candidates.min_candidate_distance"),
}


# None stands for what is best by default.
NONE_IS_FINE = {
    *("data_dir", "load.downscale", "load.pool_size", "load.test_every", "load.split"),
    *("view_seed", "sampler_kind", "train.learning_rate", "uncertainty.prior_weight"),
    *("candidates.mode", "candidates.min_train_distance", "candidates.min_candidate_distance"),
    *("targets.poses_file", "targets.num"),
}


def all_configs():
    """(name, config) of everything in experiments/configs, in every size."""
    for module in pkgutil.iter_modules(configs.__path__, f"{configs.__name__}."):
        if not module.ispkg:
            yield module.name, importlib.import_module(module.name).get_config()
    names = [f"{name},{size}" for name in protocols.PROTOCOLS for size in ("laptop", "paper")]
    for name in (*protocols.FIELDS, *names):
        yield f"protocols:{name}", protocols.get_config(name)


def with_value(option, value, config=None):
    """A config with an option that has another value, maybe of a type that it should not have."""
    values = (config or base.get_config()).to_dict()
    *groups, name = option.split(".")
    reduce(getitem, groups, values)[name] = value
    return ConfigDict(values)


def refusal(option, value) -> str:
    """The one line with which a value is refused."""
    with pytest.raises(ConfigError) as error:
        check_config(with_value(option, value))
    text = str(error.value)
    assert text.isprintable() and len(text) < 1000, text
    return text


def test_the_schema_has_exactly_the_options():
    assert leaves(base.get_config()).keys() == SCHEMA.keys()


@pytest.mark.parametrize("name, config", [*all_configs()])
def test_every_config_passes(name, config):
    assert check_config(config) is config


def test_the_config_of_suggestions_passes():
    check_config(default_config(), "holdout")
    with pytest.raises(ConfigError, match=r"config\.holdout: is no option"):
        check_config(default_config())


@pytest.mark.parametrize("option", SCHEMA)
def test_every_bad_value_of_every_option_is_refused(option):
    for value in BAD:
        if isinstance(value, dict):
            continue  # it becomes a group: see below
        assert refusal(option, value).startswith(f"config.{option}: is "), value
    if option not in NONE_IS_FINE:
        refusal(option, None)
    words = type_of(option) is str
    for value in (True, False) if SCHEMA[option] is not FLAG else (0, 1, "True"):
        refusal(option, value)
    for value in ("1", "nonsense ") if not words else (1, 1.0):
        refusal(option, value)
    if option in ZERO_IS_FINE:
        check_config(with_value(option, 0))
    else:
        refusal(option, 0)
        refusal(option, 0.0)


def test_where_nothing_is_given_the_default_is_none():
    values = leaves(base.get_config())
    assert {option for option, value in values.items() if value is None} == NONE_IS_FINE
    for option in NONE_IS_FINE:
        config = base.get_config()
        for old in OLD_VALUES.get(option, {}):
            assert leaves(check_config(with_value(option, old, config)))[option] is None


DRAWN = {"candidates__source": "hemisphere", "candidates__hemisphere_draws": 100}

FREE = {"candidates__source": "hemisphere"}  # poses, of the procedural scene


def type_of(option):
    *groups, name = option.split(".")
    return reduce(getitem, groups, base.get_config()).get_type(name)


def test_an_option_that_is_a_group_or_missing_or_unknown_is_named():
    with pytest.raises(ConfigError, match=r"config\.train\.num_steps\.a: is no option"):
        check_config(with_value("train.num_steps", {"a": 1}))
    config = base.get_config()
    del config.train["num_steps"]
    with pytest.raises(ConfigError, match=r"config\.train\.num_steps: is missing; give a whole"):
        check_config(config)
    for config in (None, 3, [], "text"):
        with pytest.raises(ConfigError, match="return a ConfigDict"):
            check_config(config)


@pytest.mark.parametrize(
    "option, value, message",
    [
        ("train.num_steps", 0, "is 0; give a whole number from 1 to 10,000,000"),
        ("uncertainty.log2_cells", 12, "is 12; give a whole number from 1 to 9 \\(a grid of 2\\^9"),
        ("image_size", 100_000, "is 100000; give a whole number from 1 to 8,192, or 0: as the"),
        ("candidates.image_scale", -1.0, r"is -1\.0; give a number above 0 to 1"),
        ("view_seed", 2**32, "is 4294967296; give a whole number from 0 to 4,294,967,295, or None"),
        ("lpips_net", "nonsense", "is 'nonsense'; give one of '', 'alex', 'vgg'"),
        ("uncertainty.weighting", "eq12", "is 'eq12'; give one of "),
        ("policies", ("bavs", "bavs"), "each once"),
        ("policies", ("bavz",), "'bavs'"),
        ("seeds", (2**32,), "0 to 4,294,967,295"),
        ("load.pool_size", 1.5, "a whole count"),
        ("hash_grid.finest", 8, "is 8; give at least hash_grid.coarsest, 16"),
        ("proposal.finest", (8, 64), "give at least proposal.coarsest, 16"),
        ("candidates.min_train_distance", 0.5, "give both min_train_distance and"),
        ("pool.kind", "uneven", "is 'uneven'; give one of 'even', 'unbalanced', 'arc', "),
        ("pool.share", 0.33, "is 0.33; give a number from 1/3 to below 1"),
        ("pool.share", 1.0, "is 1.0; give a number from 1/3 to below 1"),
        ("pool.degrees", 361.0, "is 361.0; give a number above 0 to 360"),
        ("pool.factor", 1.0, "is 1.0; give a number above 1 to 100"),
        ("pool.num_nearest", 2.0, "is 2.0; give a whole number from 1 to"),
        ("targets.kind", "file", "targets.poses_file: goes with config.targets.kind='file'; give"),
        ("targets.poses_file", "a.json", "goes with config.targets.kind='file'; give both or"),
        ("targets.kind", "sphere", "is 'sphere'; give one of 'pool', 'hemisphere', 'file'"),
    ],
)
def test_messages_name_the_option_the_value_and_the_fix(option, value, message):
    assert re.search(message, refusal(option, value))


@pytest.mark.parametrize(
    "options, message",
    [
        ({"pool__kind": "reachable"}, r"config\.batch_size: is 2, .* give 1, and more num_rounds"),
        ({"pool__kind": "zoom"} | FREE, r"config\.candidates\.source: is 'hemisphere'.* 'zoom'"),
        ({"pool__kind": "unbalanced"} | FREE, r"config\.candidates\.source: is .*'unbalanced'"),
    ],
)
def test_a_pool_that_does_not_go_with_other_options_is_refused(options, message):
    with pytest.raises(ConfigError, match=message):
        check_config(toy_config(**options))
    mended = {"num_rounds": 0} if "batch_size" in message else {"loader": "blender"}
    check_config(toy_config(**options | mended))


@pytest.mark.parametrize("name", leaves(default_sizes()))
def test_every_bad_size_of_the_benchmark_is_refused(name):
    check_sizes(default_sizes())
    for value in (*BAD, 0, True, "1", (64, 64)):
        with pytest.raises(ConfigError, match=rf"sizes\.{name}"):
            check_sizes(with_value(name, value, default_sizes()))


@pytest.mark.parametrize(
    "values, message",
    [
        ({"scene": "lego"}, r"scene: is 'lego'; the loader has 'sculpture', 'interior': give one"),
        (
            {"scene": "interior", "candidates.source": "hemisphere"},
            "source: is 'hemisphere', .* walls of 'interior'; give 'dataset' or 'free'",
        ),
        (
            {"loader": "blender", "candidates.source": "free"},
            "source: is 'free', .*loader is 'blender'; give 'dataset', 'hemisphere', or",
        ),
    ],
)
def test_scenes_and_candidates_that_do_not_go_together_are_refused(values, message):
    config = base.get_config()
    config.update_from_flattened_dict(values)
    with pytest.raises(ConfigError, match=rf"^config\.\S*{message}"):
        check_config(config)
    config.update(loader="procedural", scene="interior")
    config.candidates.source = "free"
    assert check_config(config) is config


# --- what depends on the scene, before anything is trained ---


@pytest.mark.parametrize(
    "options, message",
    [
        ({"num_initial": 4, "num_rounds": 2, "batch_size": 50}, "2 rounds of 50 take 100 views"),
        ({"num_initial": 1000}, "num_initial is 1000, but the pool has"),
        (
            DRAWN | {"batch_size": 101},
            "candidates.hemisphere_draws, 100",
        ),
        (
            DRAWN
            | {"num_rounds": 10_000, "batch_size": 2000, "candidates__hemisphere_draws": 2000},
            "20000000 pictures, more than",
        ),
    ],
)
def test_more_views_than_there_are_is_an_error_before_training(options, message):
    with pytest.raises(ValueError, match=message):
        check_views(toy_config(**options), toy_scene())
    check_views(toy_config(), toy_scene())


# --- axes of a sweep ---


@pytest.mark.parametrize(
    "texts, message",
    [
        (["seed=0:100000000"], "more than 10,000 values"),
        (["seed=0:999999999999999999999999"], "not of type int"),
        (["seed=0:999999999999999999"], "more than 10,000 values"),
        (["seed=0:5:0"], "step of 0"),
        (["seed=0:9000", "seed=1"], "given twice"),
        (
            ["seed=0:9000", "config.batch_size=1:9000"],
            r"2 x 9000 x 1 x 8999 are 161,982,000 trials",
        ),
        (["seed=" + ",".join(map(str, range(20_000)))], "100,000"),
        (["seed=" + "," * 90_000], "not of type int"),
        (["config.proposal.finest=" + "(" * 50_000], "not of type tuple"),
        (["config.proposal.finest=([],),(1,)"], "not of type tuple"),
    ],
)
def test_a_sweep_that_is_too_large_is_refused_before_it_is_made(texts, message):
    tracemalloc.start()
    with pytest.raises(ConfigError, match=message) as error:
        parse_axes(texts, quickstart.get_config())
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2**26 and "\n" not in str(error.value)


def test_a_sweep_of_the_largest_size_is_taken():
    axes = parse_axes([f"seed=0:{MAX_TRIALS // 2}"], quickstart.get_config())
    assert len(axes.seeds) * len(axes.policies) == MAX_TRIALS


def test_the_toy_config_passes():
    check_config(toy_config())
    assert OVERRIDES.keys() <= SCHEMA.keys()


@pytest.mark.parametrize(
    "old, new",
    [
        ("eq13", "gauss_newton"),
        ("eq11", "residual_weighted"),
        ("empirical", "empirical_fisher"),
        ("gauss_newton", "gauss_newton"),
    ],
)
def test_old_names_are_read_as_the_new_ones(old, new):
    config = base.get_config()
    config.lock()
    config.uncertainty.weighting = old
    assert check_config(config).uncertainty.weighting == new


def test_a_run_saved_under_the_old_names_is_read(tmp_path):
    saved = base.get_config().to_dict()
    saved["field"] = saved.pop("hash_grid") | {"finest": 64}
    saved["uncertainty"] |= {"weighting": "eq11", "prior_weight": 0.0}
    saved |= {"view_seed": "3", "sampler_kind": ""}
    (tmp_path / "config.json").write_text(json.dumps(saved))
    config = saved_config(tmp_path)
    assert (config.hash_grid.finest, config.uncertainty.weighting) == (64, "residual_weighted")
    assert (config.view_seed, config.sampler_kind) == (3, None)
    assert config.uncertainty.prior_weight is None
