"""The library of widespread grippers: each loads, keeps its sources' numbers, is checked and is tracked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from msgspec import structs
from support.meters import difference
from support.simulated import PAPER_LENS, nominal_cam_T_grip
from support.watched import pose_of, reference_of

from gripmon.cli import main
from gripmon.daemon.config import read_gripper
from gripmon.model.camera import make_camera
from gripmon.model.gripper import Gripper
from gripmon.model.records import Origin
from gripmon.monitor import Monitor, MonitorSettings
from gripmon.simulate import Scenario, paper_rig
from gripmon.simulate.scenario import Background, JawScript

GRIPPERS = Path(__file__).resolve().parent.parent / "configs" / "grippers"
LIBRARY = ("adaptive_two_finger_85", "parallel_two_finger_80", "printed_fixed_jaw")
NEAR = (0.0004, 0.0013, 0.115)


def test_the_adaptive_gripper_has_its_sources_stroke_and_arc():
    gripper = read_gripper(GRIPPERS / "adaptive_two_finger_85.yaml")
    tip = gripper.point_ids.index("R_in_near")
    places = np.array([gripper.points_grip_m(float(o))[tip] for o in np.linspace(0.0, 0.085, 86)])
    np.testing.assert_allclose(places[:, 0], np.linspace(0.0, 0.0425, 86), atol=1e-6)
    # The pivot bar of the MuJoCo model when it is open by 85.4 mm: from the spring link's joint to the follower's.
    bar = np.array([0.055 - 0.018, 0.0375 + 0.0065])
    radius, sine = np.hypot(*bar), bar[0] / np.hypot(*bar) + (places[:, 0] - 0.0427) / np.hypot(*bar)
    height = radius * np.sqrt(1.0 - sine**2)
    np.testing.assert_allclose(places[:, 2] - places[0, 2], height - height[0], atol=2.5e-5)  # rows lie 4.25 mm apart
    assert np.ptp(gripper.points_grip_m()[:, 1]) == pytest.approx(0.022)


@pytest.mark.parametrize("name", LIBRARY)
def test_a_library_gripper_passes_check_in_a_simulated_view(name: str, tmp_path: Path):
    config = yaml.safe_load((GRIPPERS.parent / "demo.yaml").read_text())
    config["gripper"] = str(GRIPPERS / f"{name}.yaml")
    if not read_gripper(GRIPPERS / f"{name}.yaml").has_jaw:
        del config["jaw"]
    path = tmp_path / "config.yaml"
    path.write_text(yaml.safe_dump(config))
    assert main(["check", str(path), "--verbose"]) == 0


def drawn(gripper: Gripper, bevel_m: float) -> Gripper:
    """With bevels of this width on all edges."""
    edges = {name: structs.replace(edge, bevel_m=bevel_m) for name, edge in gripper.model.edges.items()}
    return Gripper(structs.replace(gripper.model, edges=edges))


@pytest.mark.parametrize(
    ("name", "bevel_m"), [*((name, 0.0) for name in LIBRARY), ("adaptive_two_finger_85", 2e-4)]
)
def test_a_library_gripper_is_tracked(name: str, bevel_m: float):
    """Sharp ones are where their file has them; of bevelled ones the bound knows.  The reference, exact here, makes
    frames in its place valid.
    """
    gripper = read_gripper(GRIPPERS / f"{name}.yaml")
    camera, pose = make_camera(PAPER_LENS), nominal_cam_T_grip(tcp_m=NEAR)
    middle = gripper.jaw_nominal_m
    jaw = JawScript(knots=((0.0, middle), (1.0, middle + 0.004))) if gripper.has_jaw else JawScript()
    scenario = Scenario(name="library", duration_s=2.0, fps=30.0, jaw=jaw, background=Background(kind="speckle"))
    simulator = paper_rig(drawn(gripper, bevel_m), pose).simulator(scenario, 1)
    monitor = Monitor(camera, gripper, MonitorSettings(), reference_of(pose))
    errors = []
    for k in range(simulator.frame_count):
        record, truth = monitor.process(simulator.frame(k)), simulator.truth(k)
        if record.cam_T_grip is not None and record.source is not Origin.HELD:
            errors.append(difference(pose_of(record.cam_T_grip), truth.cam_T_grip))
            assert record.protection is not None
            assert np.linalg.norm(errors[-1][:3]) < record.protection.position_m
    if bevel_m:
        assert len(errors) > 0.5 * simulator.frame_count
        return
    # One jaw shows four edges, and three have to be told from what is behind them.  Where its tip isn't, nothing says
    # how far it has slid along itself: the transform is held.  With two fingers there is always another edge.
    assert len(errors) >= (0.98 if gripper.has_jaw else 0.9) * simulator.frame_count
    across, along = np.linalg.norm(np.array(errors)[:, :2], axis=1), np.abs(np.array(errors)[:, 2])
    assert np.quantile(across, 0.95) < 1e-4
    # One jaw of 8 mm by itself hardly tells its distance, and is never valid: its file says so.
    assert np.quantile(along, 0.95) < (3e-4 if gripper.has_jaw else 3e-3)
