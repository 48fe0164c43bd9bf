"""The worked example runs as it stands in the documentation, on simulated images, and finds what is true of them."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
from support import new_user

EXAMPLE = Path(__file__).resolve().parent.parent / "docs" / "examples" / "calibrate_and_verify.py"


def test_it_finds_camera_and_gripper(tmp_path: Path):
    for kind in ("plate", "standing"):
        new_user.simulate(tmp_path, kind)
    shutil.copy(tmp_path / "standing" / "rough.yaml", tmp_path)
    true = json.loads((tmp_path / "standing" / "truth.json").read_text())
    done = subprocess.run([sys.executable, EXAMPLE, tmp_path], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    focal, sigma = map(float, re.findall(r"focal length ([0-9.]+) ± ([0-9.]+)", done.stdout)[0])
    assert abs(focal - true["camera"]["fx_px"]) < 5.0 * sigma < 5.0
    x, y, z = map(float, re.findall(r"\(([-0-9.]+), ([-0-9.]+), ([-0-9.]+)\) mm", done.stdout)[0])
    assert np.abs(np.array([x, y, z]) - 1e3 * np.array(true["cam_T_grip"])[:3, 3]).max() < 0.15
    assert "the other image says the same" in done.stdout
