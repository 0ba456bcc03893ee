"""What the paper prints, for tables that show it beside ours."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Row:
    """One row of a table of the paper."""

    name: str  # as printed
    policy: str | None  # ours of the same kind; None: the field of the initial views
    psnr: float  # dB
    ssim: float
    lpips: float
    seconds: float | None = None  # of choosing
    candidates: int | None = None  # that were scored


# Table 2's Ours is Table 4's row with the policy: one scene, not a mean.
TABLES: dict[str, tuple[Row, ...]] = {
    "table_1": (
        Row("ActiveNeRF", "activenerf", 26.240, 0.8560, 0.1240),
        Row("Random", "random", 27.138, 0.9206, 0.0652),
        Row("ActiveNeRF*", "activenerf_star", 27.346, 0.9163, 0.0743),
        Row("Ours", "bavs_topk", 27.997, 0.9306, 0.0696),
        Row("Ours*", "bavs", 29.023, 0.9328, 0.0405),
    ),
    "table_2": (
        Row("Origin", None, 16.5965, 0.6184, 0.4783),
        Row("Random", "random", 17.1705, 0.6283, 0.3954),
        Row("Ours", "bavs", 19.7318, 0.7951, 0.2953),
    ),
    "table_4": (
        Row("no policy", "bavs_topk", 17.2311, 0.6101, 0.4125, 1408.0, 250),
        Row("with policy", "bavs", 19.7318, 0.7951, 0.2953, 197.0, 43),
    ),
}
