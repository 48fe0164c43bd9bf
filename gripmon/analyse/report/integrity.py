"""How large errors may have been, and how often that was within the alert limits."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gripmon.analyse.report.content import Integrity, Limits

if TYPE_CHECKING:
    from gripmon.record.read import FrameTable


def integrity_of(table: FrameTable, limits: Limits) -> Integrity | None:
    """Of one recording; None where no frame has bounds."""
    known = np.isfinite(table.protection_m) & np.isfinite(table.protection_rad)
    if not known.any() or limits.alert_limit_m is None or limits.alert_limit_rad is None:
        return None
    position_m, rotation_rad = table.protection_m[known], table.protection_rad[known]
    within = (position_m <= limits.alert_limit_m) & (rotation_rad <= limits.alert_limit_rad)
    median_m, p99_m = np.percentile(position_m, (50.0, 99.0)).tolist()
    median_rad, p99_rad = np.percentile(rotation_rad, (50.0, 99.0)).tolist()
    return Integrity(
        frames=int(known.sum()),
        valid=float(np.mean(table.verdict == table.VERDICTS.index("valid"))),
        within=float(within.sum() / len(table)),
        median_m=median_m,
        p99_m=p99_m,
        median_rad=median_rad,
        p99_rad=p99_rad,
        risk=float(np.median(table.integrity_risk[known])),
    )
