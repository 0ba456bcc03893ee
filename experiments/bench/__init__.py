"""How fast everything is: the parts of `python -m experiments.benchmark`."""
