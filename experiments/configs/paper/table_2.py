"""Table 2, under the name that results have it by; see protocols.py."""

from experiments.configs.paper.protocols import table_2 as get_config

__all__ = ["get_config"]
