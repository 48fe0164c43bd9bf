"""Limits, from the configuration that the recording holds, and how large errors may have been beside them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
import yaml

from gripmon.analyse.report.content import Integrity, Limits
from gripmon.judge.policy import PolicySettings

if TYPE_CHECKING:
    from gripmon.record.read import FrameTable


def limits_of(main_text: str | None, affected_m: float | None, affected_rad: float | None) -> Limits:
    """From the text of the configuration's main file; defaults where it names none, or is none.

    ``affected_m`` and ``affected_rad`` are a person's own; None: what is worth a warning.
    """
    policy, origin = _policy(main_text)
    if affected_m is not None or affected_rad is not None:
        origin += "; what counts as affected was given with the command"
    return Limits(
        affected_m=policy.warn_m if affected_m is None else affected_m,
        affected_rad=policy.warn_rad if affected_rad is None else affected_rad,
        warn_m=policy.warn_m,
        warn_rad=policy.warn_rad,
        limit_m=policy.limit_m,
        limit_rad=policy.limit_rad,
        alert_limit_m=policy.position_limit_m,
        alert_limit_rad=policy.alert_limit_rad,
        origin=origin,
    )


def excess(size_m: float, turn_rad: float, limits: Limits) -> float:
    """How many times as large as what counts as affected; NaN counts as nothing."""
    parts = (size_m / limits.affected_m, turn_rad / limits.affected_rad)
    return max((part for part in parts if math.isfinite(part)), default=0.0)


def _policy(main_text: str | None) -> tuple[PolicySettings, str]:
    if main_text is None:
        return PolicySettings(), "gripmon's defaults: the recording holds no configuration"
    try:
        document: Any = yaml.safe_load(main_text)
        known = {field.name for field in msgspec.structs.fields(PolicySettings)}
        said = {k: v for k, v in ((document.get("monitor") or {}).get("policy") or {}).items() if k in known}
        return msgspec.convert(said, PolicySettings), "the recording's configuration"
    except (yaml.YAMLError, msgspec.ValidationError, AttributeError, TypeError):
        return PolicySettings(), "gripmon's defaults: the recording's configuration can't be read"


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
