"""The scripts: `python -m experiments.NAME --help` explains each."""

import os
import signal
import sys


def stop(number: int, frame=None):
    """Handles a signal: says that the work was stopped, and waits for no thread or process."""
    sys.stdout.flush()
    os.write(2, b"stopped; the same command goes on\n")
    os._exit(128 + number)


def handle_signals(handler) -> None:
    """Sets the handler of ctrl-C and SIGTERM."""
    for number in (signal.SIGINT, signal.SIGTERM):
        # What starts a job in the background may have it ignore one.
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)


if sys.argv[0] == "-m":  # so it is while Python looks for the script of `python -m experiments.x`
    handle_signals(stop)
