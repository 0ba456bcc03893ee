"""FisherRF: the views whose curvature is largest in proportion to what is there already.

Differs from the published code: h is summed per channel (theirs squares the sum over channels),
and the prior is the same for a single view and within a batch.
"""

from bavs_jax.selection.information import trace_ratio_gain
from bavs_jax.selection.policies.d_optimal import make_informative

POLICY = make_informative(
    name="fisher_ratio",
    summary="Greedily the view of largest sum h / H over the field's posterior (FisherRF).",
    gain=trace_ratio_gain,
)
