"""How well uncertainty tells error: parts of `experiments.evaluate_uncertainty`."""
