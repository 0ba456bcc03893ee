"""Table 1, under the name that results have it by; see protocols.py."""

from experiments.configs.paper.protocols import table_1 as get_config

__all__ = ["get_config"]
