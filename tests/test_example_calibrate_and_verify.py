"""The worked example runs as it stands in the documentation, on simulated images, and finds what is true of them."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import yaml
from support import new_user
from support.simulated import PAPER_LENS, nominal_cam_T_grip

EXAMPLE = Path(__file__).resolve().parent.parent / "docs" / "examples" / "calibrate_and_verify.py"


def test_it_finds_camera_and_gripper(tmp_path: Path):
    new_user.make_plates(tmp_path)
    rough = new_user.corners_px(np.random.default_rng(4), off_px=3.0)
    (tmp_path / "rough.yaml").write_text(yaml.safe_dump({"corners": {k: v.tolist() for k, v in rough.items()}}))
    done = subprocess.run([sys.executable, EXAMPLE, tmp_path], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    focal, sigma = map(float, re.findall(r"focal length ([0-9.]+) ± ([0-9.]+)", done.stdout)[0])
    assert abs(focal - PAPER_LENS.fx_px) < 5.0 * sigma < 5.0
    x, y, z = map(float, re.findall(r"\(([-0-9.]+), ([-0-9.]+), ([-0-9.]+)\) mm", done.stdout)[0])
    assert np.abs(np.array([x, y, z]) - 1e3 * nominal_cam_T_grip()[:3, 3]).max() < 0.15
    assert "the other image says the same" in done.stdout
