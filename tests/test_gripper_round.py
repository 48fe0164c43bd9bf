"""What a gripper file holds of fingers that are round, not convex, or drawn as curves."""

from __future__ import annotations

import numpy as np
import pytest
from support.box_models import cube_model
from support.grippers import gripper_from_dict

from gripmon.model.gripper import GripperError, contents_of


def outline_model(radius_m: float = 0.004) -> dict:
    """A plate whose upper border is the outline of a cylinder about x, centre at y = 0, z = 0."""
    round_ = {"centre_m": [0.3, 0.0, 0.0], "axis": [2.0, 0.0, 0.0]}
    points = {
        "a": {"finger": "f", "xyz_m": [-0.01, -radius_m, 0.0], "corner": True, "round": round_},
        "b": {"finger": "f", "xyz_m": [0.01, -radius_m, 0.0], "corner": True, "round": round_},
        "c": {"finger": "f", "xyz_m": [0.01, 0.02, -0.02], "corner": True},
        "d": {"finger": "f", "xyz_m": [-0.01, 0.02, -0.02], "corner": True},
    }
    edges = {n: {"from": n[0], "to": n[1]} for n in ("ab", "bc", "cd", "da")}
    return {"name": "m", "fingers": {"f": {}}, "points": points, "edges": edges}


@pytest.mark.parametrize("eye_m", [(0.0, 0.0, 0.1), (0.02, 0.03, 0.08), (0.0, -0.01, 0.09)])
def test_a_round_outline_lies_where_sight_touches_the_cylinder(eye_m: tuple[float, float, float]):
    eye = np.array(eye_m)
    gripper = gripper_from_dict(outline_model())
    seen = gripper.points_grip_m(None, eye)
    for k in (0, 1):
        normal = np.array([0.0, *seen[k, 1:]]) / 0.004
        assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-12)  # on the cylinder
        assert normal @ (eye - seen[k]) == pytest.approx(0.0, abs=1e-12)  # sight touches it
        assert seen[k, 1] < 0.0 and seen[k, 0] == pytest.approx(gripper.points_grip_m()[k, 0], abs=1e-12)
    np.testing.assert_array_equal(seen[2:], gripper.points_grip_m()[2:])
    np.testing.assert_array_equal(gripper.points_grip_m(None, np.array([0.0, 0.001, 0.001])), gripper.points_grip_m())


def test_files_without_roundings_keep_their_digest():
    assert all(
        set(point) == {"finger", "xyz_m", "corner"}
        for point in contents_of(gripper_from_dict(cube_model()).model)["points"].values()
    )


@pytest.mark.parametrize(
    ("round_", "said"),
    [
        ({"centre_m": [0, 0, 0], "axis": [0, 0, 0]}, "points.a.round: holds no centre or no direction"),
        ({"centre_m": [0, -0.004, 0], "axis": [1, 0, 0]}, "points.a.round.centre_m: the axis passes the point by 0 m"),
        ({"centre_m": [0, 3, 0], "axis": [1, 0, 0]}, "points.a.round.centre_m: the axis passes the point by 3.004 m"),
    ],
)
def test_a_rounding_that_is_none_is_refused(round_: dict, said: str):
    model = outline_model()
    model["points"]["a"]["round"] = round_
    with pytest.raises(GripperError, match=said):
        gripper_from_dict(model)


def notched_model(turned: int | None = None) -> dict:
    """An L-shaped prism: its two inner faces look towards its middle."""
    profile = [(0.0, 0.0), (0.02, 0.0), (0.02, 0.004), (0.004, 0.004), (0.004, 0.02), (0.0, 0.02)]
    points = {
        f"p{k}{s}": {"finger": "f", "xyz_m": [x, y, z], "corner": True}
        for k, (x, y) in enumerate(profile)
        for s, z in (("a", 0.0), ("b", 0.01))
    }
    loops = [[f"p{k}a", f"p{(k + 1) % 6}a", f"p{(k + 1) % 6}b", f"p{k}b"] for k in range(6)]
    loops += [[f"p{k}a" for k in range(5, -1, -1)], [f"p{k}b" for k in range(6)]]
    if turned is not None:
        loops[turned].reverse()
    edges = {}
    for k in range(6):
        for s in "ab":
            edges[f"{k}{s}"] = {"from": f"p{k}{s}", "to": f"p{(k + 1) % 6}{s}"}
        edges[f"{k}"] = {"from": f"p{k}a", "to": f"p{k}b"}
    faces = [{"finger": "f", "points": loop} for loop in loops]
    return {"name": "l", "fingers": {"f": {}}, "points": points, "edges": edges, "faces": faces}


def test_a_finger_need_not_be_convex_nor_closed():
    gripper_from_dict(notched_model())
    model = notched_model()
    del model["faces"][0]
    gripper_from_dict(model)


@pytest.mark.parametrize("turned", range(8))
def test_a_face_that_is_turned_inside_out_is_still_found(turned: int):
    with pytest.raises(GripperError, match=r"faces\[\d\].points: it looks into the finger; the points counter"):
        gripper_from_dict(notched_model(turned))
