"""Openings beyond those at which a gripper file knows its fingers' motion: measured, with a larger bound."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from support.changing_backgrounds import CAMERA, moving_robot
from support.grippers import gripper_from_dict
from support.simulated import BOX_FINGERS, nominal_cam_T_grip

from gripmon.model.geometry import from_record, to_record
from gripmon.model.gripper import Gripper
from gripmon.model.records import Frame, ReferenceRecord
from gripmon.monitor import Monitor
from gripmon.monitor.settings import MonitorSettings


def known_from(low_m: float, high_m: float) -> Gripper:
    """Box fingers whose motion is known for a part of their jaws' range, 0 to 60 mm."""
    model = yaml.safe_load(BOX_FINGERS.read_text())
    for name, side in (("left", -0.5), ("right", 0.5)):
        rows = [[m, side * (m - 0.034), 0.0, 0.0] for m in (low_m, high_m)]
        model["fingers"][name]["motion"] = {"table": rows}
    return gripper_from_dict(model)


def test_fingers_go_on_straight_and_less_certain() -> None:
    exact, known = known_from(0.0, 0.06), known_from(0.028, 0.04)
    for opening_m in (0.0, 0.026, 0.034, 0.05):
        assert np.allclose(known.points_grip_m(opening_m), exact.points_grip_m(opening_m))
        assert exact.beyond_m(opening_m) == 0.0
    assert known.beyond_m(0.028) == known.beyond_m(0.04) == 0.0
    # Of a circle of 50 mm: each finger moved 6 mm, and 1 mm more; its sagitta there is (7² - 6 * 7) / 100.
    assert known.beyond_m(0.026) == known.beyond_m(0.042) == pytest.approx(7e-5)


def test_a_frame_there_is_measured_with_a_larger_bound_and_refused_only_beyond_the_jaws() -> None:
    bounds, pose = {}, nominal_cam_T_grip()
    reference = ReferenceRecord(
        "r", 1, 0, "configuration", to_record(pose), tuple(np.diag([1e-8] * 3 + [1e-6] * 3).flat)
    )
    images = moving_robot(71, "printed", opening_m=0.026, motion="still")
    for name, gripper in (("exact", known_from(0.0, 0.06)), ("known", known_from(0.028, 0.04))):
        monitor = Monitor(CAMERA, gripper, MonitorSettings(), reference)
        for k in range(3):
            record = monitor.process(Frame(k, k * 33_000_000, images.render(k), 0.026, ""))
            monitor.run_pending()
        assert record.cam_T_grip is not None and record.protection is not None
        off_m = np.linalg.norm(from_record(record.cam_T_grip)[:3, 3] - pose[:3, 3])
        bounds[name] = record.protection.position_m
        assert off_m < bounds[name]
        refused = monitor.process(Frame(9, 10**9, images.render(0), 0.062, ""))
        assert "jaw opening 0.062 m; 0 to 0.06 m" in (refused.reason or "")
    assert bounds["exact"] + 1e-4 < bounds["known"] < bounds["exact"] + 1e-3
