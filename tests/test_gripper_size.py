"""How large a gripper is by its jaws' travel in metres: right within the stated error, or unknown."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.outlines_seen import seen_opening, turned, wedge
from support.simulated import PAPER_LENS, nominal_cam_T_grip

from gripmon.model.camera import make_camera
from gripmon.model.records import Array
from gripmon.teach.finger_depth import place
from gripmon.teach.image_model import finger_outlines
from gripmon.teach.image_size import Length, depth_by_openings
from gripmon.teach.motion_depth import move

CAMERA = make_camera(PAPER_LENS)
OPEN_M, CLOSED_M = 0.034, 0.02
TAPERED = ((0.006, 0.006), (0.021, 0.015), 0.09)
BOX = ((0.01, 0.016), (0.01, 0.016), 0.09)
Shape = tuple[tuple[float, float], tuple[float, float], float]


def pose(tilt_deg: float = 32.0, roll_deg: float = 0.0, yaw_deg: float = 0.0) -> Array:
    cam_T_grip = nominal_cam_T_grip(tilt_deg)
    turn = Rotation.from_euler("zy", [roll_deg, yaw_deg], degrees=True).as_matrix()
    cam_T_grip[:3, :3] = turn @ cam_T_grip[:3, :3]
    return cam_T_grip


def fingers(shape: Shape, more_m: float, back: float = 0.0, right: float = 0.5) -> list[Array]:
    """Opened by ``more_m``, of which the right finger moves a part, both going ``back`` by a part of it."""
    return [
        wedge(side, OPEN_M, *shape) + more_m * np.array([side * share, 0.0, -back])
        for side, share in ((-1.0, 1.0 - right), (1.0, right))
    ]


def pivoted(shape: Shape, turns_rad: tuple[float, float]) -> list[Array]:
    """Each finger turned about a pivot 70 mm behind the tips."""
    at = np.array([0.0, 0.0, -0.07])
    return [turned(wedge(side, OPEN_M, *shape), at, turn) for side, turn in zip((-1.0, 1.0), turns_rad, strict=True)]


def size(cam_T_grip: Array, openings: dict[float, list[Array]], seed: int) -> tuple[Length | None, str]:
    rng = np.random.default_rng(seed)
    seen = {opening: seen_opening(CAMERA, cam_T_grip, shown, 0.08, rng) for opening, shown in openings.items()}
    first, *others = seen
    outlines = finger_outlines(CAMERA, seen[first])
    around = {opening: seen[opening] for opening in others}
    return depth_by_openings(move(CAMERA, outlines, seen[first], around, place(outlines), notes=[])[1], first)


@pytest.mark.parametrize(
    ("shape", "cam_T_grip", "back", "right"),
    [
        pytest.param(TAPERED, pose(), 0.0, 0.5, id="tapered"),
        pytest.param(TAPERED, pose(45.0, 6.0, 4.0), 0.0, 0.5, id="tapered, rolled"),
        pytest.param(TAPERED, pose(), 0.25, 0.5, id="tapered, on arcs"),
        pytest.param(TAPERED, pose(), 0.0, 0.52, id="tapered, unequal"),
        pytest.param(BOX, pose(), 0.0, 0.5, id="box"),
        pytest.param(BOX, pose(20.0, -5.0, 3.0), 0.0, 0.5, id="box, rolled"),
        pytest.param(BOX, pose(), 0.25, 0.5, id="box, on arcs"),
        pytest.param(BOX, pose(), 0.0, 1.0, id="box, one jaw stands"),
    ],
)
def test_the_travel_tells_the_distance_within_its_error(
    shape: Shape, cam_T_grip: Array, back: float, right: float
) -> None:
    """The TCP lies between the tips at their near or far edge: by up to half of their thickness before or behind the
    middle of that, which is part of what is allowed here.
    """
    middle_m = 0.5 * shape[0][1] * abs(cam_T_grip[2, 1])
    for seed in range(2):
        shown = {m: fingers(shape, m - OPEN_M, back, right) for m in (OPEN_M, CLOSED_M)}
        found, why = size(cam_T_grip, shown, seed)
        assert found is not None, why
        depth_m, sigma_m = found
        assert sigma_m < 0.05 * depth_m
        off_m = abs(depth_m - cam_T_grip[2, 3])
        assert off_m < 2.0 * sigma_m or off_m < middle_m + sigma_m


@pytest.mark.parametrize("shape", [TAPERED, BOX])
@pytest.mark.parametrize("turns_rad", [(0.0, 0.12), (0.1, -0.1)])
def test_pivoting_jaws_tell_it_badly_or_not_at_all(shape: Shape, turns_rad: tuple[float, float]) -> None:
    """Which of their points' distance is reported isn't known."""
    closed_m = OPEN_M - 0.07 * float(np.abs(turns_rad).sum())
    for tilt_deg in (12.0, 32.0):
        shown = {OPEN_M: pivoted(shape, (0.0, 0.0)), closed_m: pivoted(shape, turns_rad)}
        found, why = size(pose(tilt_deg), shown, 0)
        if found is None:
            assert why
        else:
            assert abs(found[0] - pose()[2, 3]) < found[1] and found[1] > 0.08 * found[0]


def test_of_tapered_jaws_one_of_which_stands_nothing_is_claimed() -> None:
    shown = {m: fingers(TAPERED, m - OPEN_M, right=1.0) for m in (OPEN_M, CLOSED_M)}
    found, why = size(pose(), shown, 0)
    assert found is None and why


@pytest.mark.parametrize("cam_T_grip", [pose(), pose(20.0), pose(45.0, 6.0, 4.0)])
@pytest.mark.parametrize("shape", [TAPERED, ((0.006, 0.012), (0.024, 0.012), 0.09)])
def test_a_tapered_side_is_no_part_of_the_tip(shape: Shape, cam_T_grip: Array) -> None:
    """It doesn't run along the finger, whose direction a calibration tells; a box's sides do."""
    given = cam_T_grip[:3, :3], cam_T_grip[:3, 3] / cam_T_grip[2, 3]
    for own, flat in ((shape, True), (BOX, False)):
        seen = seen_opening(CAMERA, cam_T_grip, fingers(own, 0.0), 0.02, np.random.default_rng(0))
        placed = place(finger_outlines(CAMERA, seen), *given)
        for points in placed.points:
            local_m = cam_T_grip[2, 3] * (points - placed.tcp) @ placed.rotation
            assert np.nanmax(np.ptp(local_m[np.isfinite(local_m).all(axis=1)], axis=0)[:2]) < own[1][0] + 0.008
        assert placed.flat or not flat
