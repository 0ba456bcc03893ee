"""Runs a script's start again and again: each command in a fork of a process that has imported it.

    python -m tests.option_server experiments.sweep

Reads a JSON list of arguments from each line of its input; answers with a line of JSON: how that
command ended. The work that follows the checks is replaced by an exit with `REACHED`.
"""

import importlib
import json
import os
import resource
import signal
import sys
import tempfile
import time

from absl import flags

REACHED = 77
LIMIT_S = 10  # then the fork is killed
# By script, the functions with which its work begins.
WORK = {
    "experiments.active_selection": ("runner.run_all",),
    "experiments.suggest_views": ("suggest_views",),
    "experiments.evaluate_uncertainty": ("evaluate",),
    "experiments.sweep": ("sweep",),
    "experiments.tables": ("collect_all",),
    "experiments.figures": ("write_figures",),
    "experiments.remeasure": ("remeasure",),
    "experiments.benchmark": ("benchmark",),
    "experiments.time_to_quality": ("compare_caches", "run_part"),
    "experiments.export_field": ("posthoc.saved_config", "posthoc.load_config_scene"),
    "experiments.clean_up": ("posthoc.saved_config", "posthoc.load_config_scene"),
    "experiments.posterior_draws": ("posthoc.saved_config", "posthoc.load_config_scene"),
}


def stop(*args, **kwargs):
    """In place of a script's work."""
    sys.exit(REACHED)


def replace_work(name: str, module) -> None:
    """So that a script ends where its checks do."""
    for path in WORK[name]:
        *owners, function = path.split(".")
        owner = module
        for part in owners:
            owner = getattr(owner, part)
        setattr(owner, function, stop)


def run(name: str, module, argv: list[str]) -> dict:
    """How a command ends, with what it wrote to stderr, its seconds and its memory."""
    with tempfile.TemporaryFile() as errors:
        start = time.monotonic()
        pid = os.fork()
        if pid == 0:
            signal.alarm(LIMIT_S)
            os.dup2(errors.fileno(), 2)
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            sys.argv[:] = [name, *argv]
            start_script(module)
        _, status, usage = os.wait4(pid, 0)
        errors.seek(0)
        return {
            "code": os.waitstatus_to_exitcode(status),
            "stderr": errors.read().decode(errors="replace"),
            "seconds": time.monotonic() - start,
            "gb": usage.ru_maxrss * 1024 / 1e9,
        }


def start_script(module) -> None:
    """What Python does with a script's exit, without leaving the fork by another way."""
    code = 1
    try:
        module.runtime.run_script(module.main)
        code = 0
    except SystemExit as error:
        if isinstance(error.code, int):
            code = error.code
        elif error.code is not None:
            print(error.code, file=sys.stderr)
    except BaseException:
        sys.excepthook(*sys.exc_info())
    sys.stderr.flush()
    os._exit(code)


def main() -> None:
    name = sys.argv[1]
    module = importlib.import_module(name)
    replace_work(name, module)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    own = {
        flag.name: flag.flag_type()
        for key, group in flags.FLAGS.flags_by_module_dict().items()
        if key.startswith("experiments")
        for flag in group
    }
    answers = os.fdopen(os.dup(1), "w")
    print(json.dumps(own), file=answers, flush=True)
    for line in sys.stdin:
        print(json.dumps(run(name, module, json.loads(line))), file=answers, flush=True)


if __name__ == "__main__":
    main()
