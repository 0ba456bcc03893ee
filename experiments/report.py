"""Makes the report of a finished or running experiment again, from its files alone.

python -m experiments.report --workdir=runs/quickstart
"""

from absl import flags

from experiments import runtime
from experiments.reporting.report import write_report

WORKDIR = flags.DEFINE_string("workdir", None, "Folder with summary.json.", required=True)


def main() -> None:
    print(write_report(WORKDIR.value))


if __name__ == "__main__":
    runtime.run_script(main)
