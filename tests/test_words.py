"""Fingers and edges in words of the picture."""

from __future__ import annotations

import numpy as np
import pytest
from support.grippers import gripper_from_dict

from gripmon.daemon.config import builtin_config, load_config
from gripmon.model.geometry import exp_rotation
from gripmon.track.edges.words import in_words

FACING = np.eye(4)
FACING[2, 3] = 0.2
"""x to the right in the image, z away from the camera: the fingers' tips point into the picture."""


def turned(about_z_deg: float, tilt_deg: float = 60.0) -> np.ndarray:
    """A camera beside the fingers, which point to its picture's upper border, rolled about its axis."""
    pose = FACING.copy()
    pose[:3, :3] = exp_rotation(np.radians([0.0, 0.0, about_z_deg])) @ exp_rotation(np.radians([tilt_deg, 0.0, 0.0]))
    return pose


def plates(fingers: int) -> dict[str, object]:
    """Flat fingers in the plane y = 0, a centimetre wide and 30 mm long, side by side along x, two centimetres apart;
    the first one at the smallest x.
    """
    points, edges = {}, {}
    for k in range(fingers):
        x = 0.02 * (k - 0.5 * (fingers - 1))
        for name, dx, z in (("tl", -0.005, 0.0), ("tr", 0.005, 0.0), ("bl", -0.005, -0.03), ("br", 0.005, -0.03)):
            points[f"{k}{name}"] = {"finger": f"f{k}", "xyz_m": [x + dx, 0.0, z], "corner": name[0] == "t"}
        edges |= {f"{k}low_x": {"from": f"{k}tl", "to": f"{k}bl"}, f"{k}high_x": {"from": f"{k}tr", "to": f"{k}br"}}
        edges[f"{k}tip"] = {"from": f"{k}tl", "to": f"{k}tr"}
        edges[f"{k}back"] = {"from": f"{k}bl", "to": f"{k}br"}
    return {"name": "plates", "fingers": {f"f{k}": {} for k in range(fingers)}, "points": points, "edges": edges}


@pytest.mark.parametrize(
    ("roll_deg", "first", "second"), [(0.0, "left", "right"), (180.0, "right", "left"), (90.0, "upper", "lower")]
)
def test_two_fingers_are_named_by_their_places_in_the_image(roll_deg: float, first: str, second: str):
    """Each place in the image is computed beside it, by the projection of the points alone."""
    gripper, pose = gripper_from_dict(plates(2)), turned(roll_deg)
    words = in_words(gripper, pose)
    assert words.fingers == (f"the {first} finger", f"the {second} finger")
    said = dict(zip(gripper.edge_ids, words.edges, strict=True))
    assert said["0low_x"] == f"the {first} finger's outer border (0low_x)"
    assert said["0high_x"] == f"the {first} finger's inner border (0high_x)"
    assert said["1low_x"] == f"the {second} finger's inner border (1low_x)"
    assert said["0tip"] == f"the {first} finger's tip (0tip)" and "back end" in said["1back"]
    cam_m = gripper.points_grip_m() @ pose[:3, :3].T + pose[:3, 3]
    u, v = (cam_m[:, :2] / cam_m[:, 2:]).T
    means = [[w[gripper.point_finger == k].mean() for k in (0, 1)] for w in (u, v)]
    lower_first = {"left": means[0][0] < means[0][1], "right": means[0][0] > means[0][1]}
    assert lower_first.get(first, means[1][0] < means[1][1])


def test_a_lone_finger_and_many_have_words_too():
    lone = in_words(gripper_from_dict(plates(1)), turned(0.0))
    assert lone.fingers == ("the finger",)
    assert {"the finger's left border (0low_x)", "the finger's right border (0high_x)"} < set(lone.edges)
    three = in_words(gripper_from_dict(plates(3)), turned(0.0))
    assert three.fingers == ("the left finger", "the middle finger", "the right finger")
    four = in_words(gripper_from_dict(plates(4)), turned(0.0))
    assert four.fingers == ("finger f0", "finger f1", "finger f2", "finger f3")


def test_every_text_finds_its_edges_again():
    config = load_config(builtin_config("demo.yaml"))
    gripper = config.gripper
    words = in_words(gripper, config.cam_T_grip)
    for k, name in enumerate(words.edges):
        (found,) = np.flatnonzero(words.meant(f"{name} belongs to something else", gripper))
        assert found == k
    ends = {gripper.edge_ids[k] for k in np.flatnonzero(words.meant(f"the ends of {words.fingers[0]} belong", gripper))}
    assert ends == {"L_tip_in", "L_tip_far", "L_tip_out", "L_tip_near"}
    inner = words.meant("the fingers' inner edges belong to what is grasped", gripper)
    assert {gripper.edge_ids[k] for k in np.flatnonzero(inner)} >= {"L_in_near_along", "R_in_near_along"}
    assert not words.meant("the jaw opening is wrong", gripper).any()
