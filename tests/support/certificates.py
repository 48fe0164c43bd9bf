"""Certificates and rules as ``docs/howto/security.md`` makes them: its own lines are run."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

from support.router_process import ROOT

_BLOCKS = re.findall(r"```sh\n(.*?)```", (ROOT / "docs/howto/security.md").read_text(), re.DOTALL)
_FIRST, _ANOTHER_ROBOT = (next(block for block in _BLOCKS if word in block) for word in ("ca-key.pem", "sed -i"))
_PARTS = re.compile(r".*?(request.*?)(issue\(\).*?\n}\n)(.*)cd \.\. .*", re.DOTALL)
_AUTHORITY, _ISSUE, _NAMES = _PARTS.fullmatch(_FIRST).groups()
_REQUEST = _AUTHORITY.partition("\n")[0] + "\n"


def make_certificates(folder: Path, robot: str, *more: str) -> None:
    """Certificates in ``folder/certificates``, those of the page for this robot the first time, and ``more`` lines."""
    certificates = folder / "certificates"
    lines = _REQUEST + _ISSUE if certificates.exists() else _AUTHORITY + _ISSUE + _NAMES.replace("arm1", robot)
    certificates.mkdir(mode=0o700, exist_ok=True)
    _run("umask 077\n" + lines + "\n".join(more), certificates)


def add_robot(folder: Path, robot: str, another: str) -> None:
    """Certificates for another robot, its rules in the router's files, and its own files ``monitor-…``, ``robot-…``."""
    lines = _REQUEST + _ISSUE + "umask 077\n" + re.sub(r"(monitor|robot)\.json5", r"\1-arm2.json5", _ANOTHER_ROBOT)
    if not (folder / f"robot-{another}.json5").exists():
        lines = lines.replace(" robot-arm2.json5", "")
    lines = re.sub(r"arm[12]", lambda found: {"arm1": robot, "arm2": another}[found[0]], lines)
    _run(lines.replace(" router.json5", " router.json5 regional.json5"), folder)


def _run(lines: str, folder: Path) -> None:
    subprocess.run(["sh", "-ec", lines], cwd=folder, check=True, capture_output=True, timeout=60.0)
