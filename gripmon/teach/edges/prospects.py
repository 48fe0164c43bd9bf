"""What a camera that sees the gripper like this will be able to tell: accuracy of a frame, smallest drift noticed."""

from __future__ import annotations

from dataclasses import dataclass

from gripmon.judge.drift import foresee
from gripmon.judge.recalibrate import refusal
from gripmon.model.camera import Camera
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, ReferenceRecord
from gripmon.monitor import CORNER_COUNTS, MonitorSettings
from gripmon.teach.forecast import FEWEST_EDGES, Promise, expect, promise
from gripmon.track.edges import TaughtEdges


@dataclass(frozen=True, slots=True)
class Prospects:
    """Expected of one frame, vectors (6,) of position, then rotation, m and rad: ``sigma`` standard deviations,
    ``weakest`` one standard deviation along the least certain direction, ``smallest`` step along each axis that the
    drift test notices; ``promise``: bounds on its error, beside the alert limits.  ``delay_frames``: after how many
    frames it notices a step of the TCP by 0.1 mm along x, y and z, None for never.  ``recalibration``: why the corners
    in view give no new pose, None if they do.
    """

    edges: int
    sigma: Array
    weakest: Array
    smallest: Array
    promise: Promise
    delay_frames: tuple[int | None, ...]
    recalibration: str | None


STEP_M = 1e-4
"""Step of the TCP for which the delay is told."""


def prospects(
    camera: Camera,
    gripper: Gripper,
    settings: MonitorSettings,
    reference: ReferenceRecord,
    jaw_opening_m: float | None,
    taught: TaughtEdges | None = None,
) -> Prospects | None:
    """The numbers that ``gripmon check`` prints; None where too few edges are in view to measure anything."""
    outlook = expect(camera, gripper, settings, reference, jaw_opening_m, taught)
    if outlook.edges < FEWEST_EDGES:
        return None
    foresight = foresee(outlook.covariance, settings.drift)
    taken = gripper.innermost_corners(outlook.corners, CORNER_COUNTS[settings.recalibrate_corners])
    points_grip_m = gripper.points_grip_m(jaw_opening_m)[gripper.corner_points][taken]
    return Prospects(
        outlook.edges,
        outlook.sigma,
        outlook.weakest,
        foresight.smallest,
        promise(outlook.protection, settings.policy),
        tuple(foresight.delay_frames(STEP_M, axis) for axis in range(3)),
        refusal(points_grip_m),
    )
