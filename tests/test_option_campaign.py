"""Options and flags drawn from generators: every one is taken, or refused in one line."""

import json
import os
import subprocess
import sys
from collections import Counter

import pytest

from experiments.runtime import ConfigError
from experiments.schema import SCHEMA, check_config
from tests.option_server import LIMIT_S, REACHED, WORK
from tests.script_server import ROOT, run_script
from tests.test_schema import with_value

hypothesis = pytest.importorskip("hypothesis")
given, st = hypothesis.given, hypothesis.strategies

CONFIG = ROOT / "experiments" / "configs" / "quickstart.py"
MAX_GB = 2.0
NUM_VALUES, NUM_COMMANDS = 1500, 60  # drawn in all, and for each script

NUMBERS = st.one_of(
    st.integers(-3, 3),
    st.integers(),
    st.integers(10**9, 10**30),
    st.floats(),
    st.sampled_from([0.0, -0.0, 1e-300, 1e300, float("nan"), float("inf"), -float("inf")]),
)
WORDS = st.one_of(
    st.text(st.characters(exclude_characters="/"), max_size=12),
    st.sampled_from(["", " ", "nonsense", "None", "True", "bavs", "\0", "\x1b[2J", "9" * 5000]),
)
VALUES = st.recursive(
    st.one_of(NUMBERS, WORDS, st.booleans(), st.none(), st.binary(max_size=4)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3).map(tuple),
        st.lists(inner, max_size=3),
        st.dictionaries(st.sampled_from("abc"), inner, max_size=2),
    ),
    max_leaves=4,
)
# As a shell gives them.
TEXTS = st.one_of(
    VALUES.map(repr),
    NUMBERS.map(str),
    WORDS,
    st.sampled_from(["/dev/null", "/dev/null/x", "/nowhere/x.py", "(" * 3000, "a" * 5000, "1,2,x"]),
    st.sampled_from(["((1,),)", "()", "(1,", "[1]*10**9", "__import__('os')", "1e999", "0x10"]),
)


def campaign(num: int) -> hypothesis.settings:
    """The same draws each time."""
    return hypothesis.settings(
        max_examples=num,
        deadline=None,
        database=None,
        derandomize=True,
        suppress_health_check=list(hypothesis.HealthCheck),
    )


class Server:
    """A process that has imported a script, and starts it in forks of itself."""

    def __init__(self, name, folder):
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.option_server", name],
            cwd=folder,
            env=os.environ | {"PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.flags = json.loads(self.process.stdout.readline())

    def run(self, *argv) -> dict:
        print(json.dumps(argv), file=self.process.stdin, flush=True)
        return json.loads(self.process.stdout.readline())

    def close(self):
        self.process.stdin.close()
        assert self.process.wait(30) == 0


def common_flags(name, folder) -> list[str]:
    """What a script cannot do without."""
    found = [f"--workdir={folder}"]
    if name.endswith(("active_selection", "sweep", "evaluate_uncertainty", "export_field")):
        found.append(f"--config={CONFIG}")
    return [*found, f"--data={folder}"] if name.endswith("suggest_views") else found


def check_end(argv, end) -> None:
    """One line or none, in little time and memory."""
    lines = end["stderr"].strip().splitlines()
    shown = (argv, end)
    assert "Traceback" not in end["stderr"] and end["code"] in (0, 1, REACHED), shown
    assert end["seconds"] < LIMIT_S and end["gb"] < MAX_GB, shown
    if end["code"] == 1:
        assert len(lines) == 1 and lines[0].startswith("error: "), shown


@pytest.mark.slow
def test_values_of_options_are_taken_or_refused_in_one_line():
    """Of any type, as a config file may give them."""
    ends = Counter()

    @campaign(NUM_VALUES)
    @given(st.sampled_from(sorted(SCHEMA)), VALUES)
    def draw(option, value):
        try:
            config = with_value(option, value)
        except (AttributeError, TypeError, ValueError):
            hypothesis.reject()  # ConfigDict does not hold such a thing
        try:
            check_config(config)
            ends["taken"] += 1
        except ConfigError as error:
            # Of two options that go together the error names what they share.
            group = f"config.{option}".rpartition(".")[0] + ": "
            assert str(error).isprintable()
            assert str(error).startswith((f"config.{option}", group))
            ends["refused"] += 1

    draw()
    assert ends["refused"] >= 0.8 * NUM_VALUES, ends


@pytest.mark.slow
@pytest.mark.parametrize("name", WORK)
def test_flags_of_every_script_are_taken_or_refused_in_one_line(name, tmp_path):
    server = Server(name, tmp_path)
    (tmp_path / "work").mkdir()
    common = common_flags(name, tmp_path / "work")
    own = sorted(server.flags.keys() - {"config", "sizes"})
    options = [f"config.{option}" for option in SCHEMA] if "config" in server.flags else []
    options += ["config", "config.", "config.nothing"] if options else []
    options += ["sizes.repeats", "sizes.matmul"] if "sizes" in server.flags else []
    names = (
        st.one_of(st.sampled_from(own), st.sampled_from(options))
        if options
        else (st.sampled_from(own))
    )
    try:
        plain = server.run(*common)
        assert plain["code"] == REACHED, plain

        @campaign(NUM_COMMANDS)
        @given(names, TEXTS)
        def draw(flag, text):
            argv = [*common, f"--{flag}={text}"]
            check_end(argv, server.run(*argv))

        draw()
        for flag in own:
            for text in ("nan", "-1", "1e999", "", "\0", "/dev/null/x", str(10**30)):
                argv = [*common, f"--{flag}={text}"]
                check_end(argv, server.run(*argv))
    finally:
        server.close()


BAD_COMMANDS = [
    *(f"active_selection --config.{option}" for option in (
        "policies=()", "policies=(1,)", "policies=('bavz',)", "seeds=()", "seeds=(-1,)",
        "seeds=(4294967296,)", "image_size=100000", "hash_grid.coarsest=0", "hash_grid.finest=8",
        "march.num_steps=0", "train.steps_per_call=0", "train.num_rays=0", "train.capacity=0",
        "train.capacity=8", "train.num_steps=0", "train.learning_rate=nan",
        "uncertainty.log2_cells=12", "lpips_net=nonsense", "load.seed=-1", "batch_size=-3",
        "batch_size=97", "num_rounds=-1", "num_initial=1000", "candidates.image_scale=-1.0",
    )),
    "active_selection --config=/nowhere.py",
    "active_selection --coordinator=nowhere",
    "active_selection --coordinator=127.0.0.1:9 --num_processes=2 --process_id=1 --join_seconds=1",
    "sweep --axis=seed=0:100000000",
    "sweep --gb_per_trial=nan",
    "suggest_views --poses_file=/nowhere.csv --candidates=file",
    "suggest_views --num_views=0",
    "benchmark --sizes.matmul=0",
    "time_to_quality --targets=nan",
    "tables --page=/nowhere.md",
    "figures --workdir=/dev/null",
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("command", BAD_COMMANDS)
def test_a_bad_command_ends_in_one_line_before_any_work(command, tmp_path):
    name, *argv = command.split(" ")
    common = common_flags(f"experiments.{name}", tmp_path / "work")
    given = {flag.partition("=")[0] for flag in argv}
    if "--page" not in given:
        argv = [flag for flag in common if flag.partition("=")[0] not in given] + argv
    if name == "active_selection" and not given & {"--config", "--config.image_size"}:
        argv.append("--config.image_size=16")  # some are refused once the scene is there
    (tmp_path / "work").mkdir()
    done = run_script(f"experiments.{name}", *argv, seconds=60)
    lines = done.stderr.strip().splitlines()
    assert done.returncode == 1 and len(lines) == 1 and lines[0].startswith("error: "), done.stderr
    assert "train on" not in done.stdout and not list((tmp_path / "work").glob("*/*"))
