"""Figure 8, under the name that results have it by; see protocols.py."""

from experiments.configs.paper.protocols import figure_8 as get_config

__all__ = ["get_config"]
