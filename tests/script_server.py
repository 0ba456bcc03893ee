"""Runs scripts to their end in forks of one process that has imported what they need.

To start Python and to import JAX takes longer than most scripts that tests start. `run_script` does
what `python -m experiments.NAME` does but for that: the script is `__main__` of a process of its
own, with the environment of the test. Tests of the process itself, of signals and of limits, start
one by `subprocess`.
"""

from __future__ import annotations

import functools
import gc
import importlib
import json
import os
import pathlib
import runpy
import signal
import subprocess
import sys
import tempfile

ROOT = pathlib.Path(__file__).parents[1]
# What scripts import; no script itself, whose flags would stand in the way of those of another.
IMPORTED = (
    *("experiments.runner", "experiments.suggestion"),
    *("experiments.reporting.report", "experiments.reporting.result_tables"),
)


def run_script(name: str, *flags: str, seconds: int = 300) -> subprocess.CompletedProcess:
    """Runs `python -m name flags` at the root of the project; killed after some seconds."""
    # JAX reads its variables as it is imported: of each set of them there is one server.
    server = _server(tuple(sorted(v for v in os.environ.items() if v[0].startswith("JAX_"))))
    with tempfile.TemporaryDirectory() as folder:
        streams = [pathlib.Path(folder, stream) for stream in ("out", "err")]
        request = [[name, *flags], dict(os.environ), [str(path) for path in streams], seconds]
        print(json.dumps(request), file=server.stdin, flush=True)
        code = int(server.stdout.readline())
        out, err = (path.read_text(errors="replace") for path in streams)
    if code == -signal.SIGALRM:
        raise subprocess.TimeoutExpired([name, *flags], seconds, out, err)
    return subprocess.CompletedProcess([name, *flags], code, out, err)


@functools.cache
def _server(variables: tuple) -> subprocess.Popen:
    """A process that ends with this one, by the end of its input."""
    command = [sys.executable, "-m", "tests.script_server"]
    return subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )


def serve() -> None:
    """Reads a request a line; answers with the exit code of its script, negative for a signal."""
    for module in IMPORTED:
        importlib.import_module(module)
    gc.freeze()  # a fork that ends would write to all of this, and so copy it
    answers = os.fdopen(os.dup(1), "w")
    for line in sys.stdin:
        pid = os.fork()
        if pid == 0:
            start(*json.loads(line))
        _, status = os.waitpid(pid, 0)
        print(os.waitstatus_to_exitcode(status), file=answers, flush=True)


def start(argv: list[str], environment: dict[str, str], streams: list[str], seconds: int) -> None:
    """Makes this process that of a script, to its end."""
    signal.alarm(seconds)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    for number, path in enumerate(streams, start=1):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT), number)
    os.environ.clear()
    os.environ.update(environment)
    sys.argv[:] = argv
    runpy.run_module(argv[0], run_name="__main__", alter_sys=True)
    sys.exit()


if __name__ == "__main__":
    serve()
