"""Alert limits of the scenes of ``tools/bench integrity``: kept as data, so that what is judged never proposes its own.

They are what an integrator took from ``check`` at one commit: ``data/integrity_limits.json`` says which, and how.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

FILE = Path(__file__).parent / "data" / "integrity_limits.json"
POSITIONS_M = (0.5e-3, 1e-3, 2e-3)
"""Alert limits of the position at which availability is counted, too, whatever a scene's own."""


@dataclass(frozen=True)
class AlertLimits:
    """What a task tolerates of the TCP's position (m) and of the rotation (rad)."""

    position_m: float
    rotation_rad: float


def frozen_limits(gripper: str, jaw_exact: bool, px_per_mm: float) -> AlertLimits:
    """Of a gripper by its name, with the jaw opening known exactly or not, at an image scale at the TCP.

    Raises KeyError for a gripper without limits.
    """
    data = _data()
    row = next((r for r in data["rows"] if r["gripper"] == gripper and r["jaw_exact"] is jaw_exact), None)
    if row is None:
        raise KeyError(f"{FILE}: no limits of {gripper}, jaw opening {'' if jaw_exact else 'not '}exact; add a row")

    def limit(unit: str) -> float:
        value = row[f"limit_{unit}"] * (px_per_mm / data["at_px_per_mm"]) ** row[f"power_{unit}"]
        return float(min(max(value, data["least"][unit]), data["most"][unit]))

    return AlertLimits(limit("m"), limit("rad"))


@cache
def _data() -> dict[str, Any]:
    data: dict[str, Any] = json.loads(FILE.read_text(encoding="utf-8"))
    return data
