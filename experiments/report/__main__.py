"""Makes the report of a finished or running experiment again, from its files alone.

python -m experiments.report --workdir=runs/quickstart
"""

from absl import app, flags

from experiments.report import ReportError, write_report

_WORKDIR = flags.DEFINE_string("workdir", None, "Folder with summary.json.", required=True)


def main(argv):
    if len(argv) > 1:
        raise app.UsageError(f"unknown argument {argv[1]!r}; use --workdir=FOLDER")
    try:
        print(write_report(_WORKDIR.value))
    except ReportError as error:
        raise SystemExit(f"error: {error}") from error


if __name__ == "__main__":
    app.run(main)
