"""Makes the report of a finished or running experiment again, from its files alone.

python -m experiments.report --workdir=runs/quickstart
"""

import sys

from absl import flags

from experiments import runtime
from experiments.report import ReportError, write_report

WORKDIR = flags.DEFINE_string("workdir", None, "Folder with summary.json.", required=True)


def main() -> None:
    try:
        print(write_report(WORKDIR.value))
    except ReportError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    runtime.run_script(main)
