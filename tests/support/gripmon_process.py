"""The command ``gripmon`` in a process of its own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
GRIPMON = (sys.executable, "-m", "gripmon")


def gripmon(*arguments: str | Path, timeout_s: float = 120.0) -> subprocess.CompletedProcess[str]:
    """Run the command to its end."""
    return subprocess.run([*GRIPMON, *map(str, arguments)], capture_output=True, text=True, timeout=timeout_s, cwd=ROOT)


def start(*arguments: str | Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*GRIPMON, *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT
    )
