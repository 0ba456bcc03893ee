"""`python -m tests.killed_script FOLDER KIND N FLAGS...`: experiments.active_selection on a folder,
killed as by SIGKILL at its N-th operation of a kind on the files there."""

import os
import pathlib
import sys

from experiments import active_selection, runtime
from tests.file_operations import watched


def main() -> None:
    folder, kind, number = pathlib.Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
    sys.argv[1:] = [f"--workdir={folder}", *sys.argv[4:]]
    count = 0

    def on_operation(name, path):
        nonlocal count
        count += name == kind
        if count == number:
            os._exit(137)

    with watched(folder, on_operation):
        runtime.run_script(active_selection.main)


if __name__ == "__main__":
    main()
