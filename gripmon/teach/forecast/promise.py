"""What may be promised of a view's transforms before there is any image, and whether that keeps the alert limits."""

from __future__ import annotations

import math
from dataclasses import dataclass

from gripmon.judge.policy import PolicySettings
from gripmon.model.records import Protection


@dataclass(frozen=True, slots=True)
class Promise:
    """``protection`` of a transform in which all visible edges are seen, and the limits that it is held against."""

    protection: Protection
    alert_limit_m: float
    alert_limit_rad: float

    @property
    def reachable(self) -> bool:
        """Whether a transform of this view can be valid."""
        return self.excess <= 1.0

    @property
    def excess(self) -> float:
        """The larger of both bounds over its limit: above 1, no transform can be valid."""
        bound = self.protection
        return max(bound.position_m / self.alert_limit_m, bound.rotation_rad / self.alert_limit_rad)

    @property
    def needed(self) -> str:
        """The alert limits that this view could keep, where the present ones are too tight; else empty."""
        bound, parts = self.protection, []
        if not (math.isfinite(bound.position_m) and math.isfinite(bound.rotation_rad)):
            return "more of the fingers in view: no limit would do"
        if bound.position_m > self.alert_limit_m:
            needed_m = _rounded_up(bound.position_m)
            parts.append(f"alert_limit_m of at least {needed_m:g} ({1e3 * needed_m:g} mm)")
        if bound.rotation_rad > self.alert_limit_rad:
            needed_rad = _rounded_up(bound.rotation_rad)
            parts.append(f"alert_limit_rad of at least {needed_rad:g} ({math.degrees(needed_rad):.2g} degrees)")
        return " and ".join(parts)

    def text(self) -> str:
        """One line for a person."""
        bound = self.protection
        good = f"good to {1e3 * bound.position_m:.2g} mm and {math.degrees(bound.rotation_rad):.2g} degrees"
        limits = f"{1e3 * self.alert_limit_m:g} mm, {math.degrees(self.alert_limit_rad):.2g} degrees"
        reached = "reachable" if self.reachable else f"NOT reachable: valid needs {self.needed}"
        return f"a transform of this view is {good} (risk {bound.risk:g} a frame); alert limit {limits}: {reached}"


def promise(foreseen: Protection, policy: PolicySettings) -> Promise:
    """What a view may promise, beside the policy's alert limits."""
    return Promise(foreseen, policy.alert_limit_m, policy.alert_limit_rad)


def _rounded_up(value: float) -> float:
    """To two digits, never below."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.ceil(value / unit - 1e-9) * unit
