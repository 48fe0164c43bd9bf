"""Laser set-ups with known truth, as the benchmark has them."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "tools"))

from benchmarks.laser_scenes import PAPER_LENS, LaserData, paper_setup, sampled

__all__ = ["PAPER_LENS", "LaserData", "paper_setup", "sampled"]
