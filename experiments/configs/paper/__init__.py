"""The paper's tables and figures, and its fields at their full size.

`table_*.py` and `figure_*.py` come in two sizes: `--config=experiments/configs/paper/table_1.py` is
what two cores can do, the same with `:paper` behind it is as printed, for a GPU. Comments say where
the paper is silent.
"""
