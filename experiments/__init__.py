import sys

from experiments import signals

if sys.argv[0] == "-m":  # so it is while Python looks for the script of `python -m experiments.x`
    signals.end_at_once()
