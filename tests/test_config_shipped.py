"""The configurations, grippers and scenarios that come with the package."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from gripmon.daemon.config import (
    builtin_config,
    load_config,
    read_gripper,
)
from gripmon.monitor import MonitorSettings
from gripmon.teach.accuracy import Accuracy, forecast_frame
from gripmon.teach.visibility import Rig

ROOT = Path(__file__).resolve().parent.parent
GRIPPERS = ROOT / "configs" / "grippers"


@pytest.mark.parametrize("name", sorted(path.name for path in (ROOT / "configs").glob("*.yaml")))
def test_shipped_configurations_are_sound_and_every_key_says_its_unit(name: str):
    path = builtin_config(name)
    load_config(path, check_source=False)
    for number, line in enumerate(path.read_text().splitlines(), 1):
        has_value = re.match(r"\s*\w+: *[^#\s]", line)
        assert not has_value or " # " in line, f"{path}:{number}: a comment with the unit or the choices is missing"


@pytest.mark.parametrize("name", ["two_box_fingers", "adaptive_arc_fingers"])
def test_shipped_grippers_close_to_the_tcp(name: str):
    """The innermost corners of both fingers meet at opening 0, and lie symmetric about the TCP at every opening."""
    gripper = read_gripper(GRIPPERS / f"{name}.yaml")
    inner = [gripper.point_ids.index(f"{side}_in_{which}") for which in ("near", "far") for side in ("L", "R")]
    for opening_m in np.linspace(gripper.jaw_min_m, gripper.jaw_max_m, 7):
        corners = gripper.points_grip_m(float(opening_m))[inner]
        np.testing.assert_allclose(corners[1::2, 0] - corners[0::2, 0], opening_m, atol=1e-9)
        np.testing.assert_allclose(corners[:, :2].mean(axis=0), 0.0, atol=1e-9)


def test_adaptive_fingertips_stay_on_their_arc():
    """Between two rows of the table too: within the sagitta of a 2.5 mm chord on a 57.3 mm radius."""
    gripper = read_gripper(GRIPPERS / "adaptive_arc_fingers.yaml")
    tip = gripper.point_ids.index("R_in_near")
    places = np.array([gripper.points_grip_m(float(o))[tip] for o in np.linspace(0.0, 0.08, 161)])
    radius_m, top_x_m = 0.0573, 0.006
    top_z_m = places[:, 2].max()
    distance_m = np.hypot(places[:, 0] - top_x_m, places[:, 2] - top_z_m + radius_m)
    assert np.ptp(places[:, 2]) > 0.009
    np.testing.assert_allclose(distance_m, radius_m, atol=0.0025**2 / 8 / 0.0573)


WRIST = sorted(path.name for path in (ROOT / "configs").glob("*.yaml"))


@pytest.fixture(params=WRIST)
def shipped(request: pytest.FixtureRequest) -> tuple[MonitorSettings, Accuracy]:
    """A shipped configuration's settings and what one frame of its view is expected to show."""
    config = load_config(builtin_config(request.param), check_source=False, with_taught=False)
    monitor = config.settings.monitor
    rig = Rig(config.camera, config.gripper, monitor)
    return monitor, forecast_frame(rig, config.cam_T_grip, config.jaw_opening_m)


def test_a_shipped_view_keeps_its_alert_limits(shipped: tuple[MonitorSettings, Accuracy]):
    """Else none of its transforms would ever be valid."""
    monitor, outlook = shipped
    bound = outlook.by(monitor.policy.valid_by)
    assert bound.position_m <= monitor.policy.alert_limit_m
    assert bound.rotation_rad <= monitor.policy.alert_limit_rad


def test_a_shipped_view_is_certain_enough_to_recalibrate_by_itself(shipped: tuple[MonitorSettings, Accuracy]):
    """By what one frame of it is certain to; the mean of frames whose errors last is hardly more."""
    monitor, outlook = shipped
    if monitor.recalibration.mode == "off":
        return
    assert outlook.enough and max(outlook.expected.tcp_m) <= monitor.recalibration.sure_sigma_m
