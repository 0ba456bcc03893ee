"""Where to stand next: the parts of `python -m experiments.suggest_views`."""
