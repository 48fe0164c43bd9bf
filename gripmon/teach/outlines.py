"""Fingertips of an unknown gripper: how their corners are named, which edges meet in them, and the resulting gripper
file.

Names are FINGER_POINT.  FINGER is ``left`` or ``right``: the gripper's x axis points from left to right.  POINT is,
with the left finger on the left in the image (imagine the image turned if it isn't):

    inner_near, inner_far   where the fingertip's contact face ends on the other finger's side; near is the upper one
                            in the image, far the lower one
    outer_near, outer_far   where it ends on the other side
    end_near, end_far       any point on the next edge that lies in the contact plane, where its end is out of view
    rise_near, rise_far     any point on the next edge that rises from the contact plane, along the finger

The outline of a fingertip is the chain (end or rise far), (outer far), inner far, inner near, (outer near), (end or
rise near), closed if both outer ones are there and neither end nor rise.  A corner is where two of its edges meet.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta
from scipy.linalg import block_diag

from gripmon.calibrate.plane import FingerCorners
from gripmon.calibrate.plane_equations import FEWEST_CORNERS, FreePose, stand
from gripmon.calibrate.sighting import CalibrationError
from gripmon.model.camera import Camera
from gripmon.model.gripper import AxisMotion, EdgeModel, FingerModel, Gripper, GripperModel, JawModel, PointModel
from gripmon.model.provenance import Provenance
from gripmon.model.records import Array, Image
from gripmon.monitor.tracker import USUAL_SHARE
from gripmon.teach.views import EVERYWHERE
from gripmon.track.edges import FingertipMeter, MeasurementSettings

FINGERS = ("left", "right")
SIDES = ("near", "far")
INNERMOST = tuple(f"{finger}_inner_{side}" for finger in FINGERS for side in SIDES)
RISE = "_rise_"
POINTS = ("inner", "outer", "end", "rise")
_HALF_OPENING = {"left": -0.5, "right": 0.5}


@dataclass(frozen=True, slots=True)
class Outline:
    """``points`` (p, 2) rough, px, by ``names``; ``edges`` (e, 2) indices of their two ends; ``corners``: indices of
    the points in which two edges meet, the four innermost ones first.
    """

    names: tuple[str, ...]
    points: Array
    edges: tuple[tuple[int, int], ...]
    corners: tuple[int, ...]


def outlines_of(rough: Mapping[str, tuple[float, float]]) -> Outline:
    """The outlines of both fingertips from rough corners by name.  :class:`CalibrationError` for unknown names, or too
    few of them.
    """
    known = [f"{finger}_{kind}_{side}" for finger in FINGERS for kind in POINTS for side in SIDES]
    strange = [name for name in rough if name not in known]
    if strange:
        raise CalibrationError(
            f"corners.{strange[0]}: is not a name of a fingertip's corner; one of {', '.join(known)}"
        )
    missing = [name for name in INNERMOST if name not in rough]
    if missing:
        raise CalibrationError(f"corners.{missing[0]}: is missing; the four innermost corners {', '.join(INNERMOST)}")
    edges: list[tuple[str, str]] = []
    for finger in FINGERS:
        edges += _edges_of(finger, rough)
    names = tuple(dict.fromkeys((*INNERMOST, *(n for edge in edges for n in edge))))
    index = {name: k for k, name in enumerate(names)}
    pairs = tuple((index[a], index[b]) for a, b in edges)
    met = np.bincount(np.ravel(pairs), minlength=len(names))
    points = np.array([rough[name] for name in names], dtype=float)
    return Outline(names, points, pairs, tuple(np.flatnonzero(met >= 2).tolist()))


def _edges_of(finger: str, rough: Mapping[str, tuple[float, float]]) -> list[tuple[str, str]]:
    near, far = ([n for n in (f"{finger}_{kind}_{side}" for kind in POINTS) if n in rough] for side in SIDES)
    for side, names in zip(SIDES, (near, far), strict=True):
        if f"{finger}_end_{side}" in names and f"{finger}_rise_{side}" in names:
            raise CalibrationError(f"corners.{finger}_end_{side}: is there beside {finger}_rise_{side}; one of the two")
        if len(names) < 2:
            others = " or ".join(f"{finger}_{kind}_{side}" for kind in POINTS[1:])
            raise CalibrationError(
                f"corners.{finger}_inner_{side}: only one edge of its own is given; {others}, on the next one"
            )
    pairs = list(itertools.pairwise([*reversed(far), *near]))
    closed = near[-1].endswith("_outer_near") and far[-1].endswith("_outer_far")
    return [*pairs, (near[-1], far[-1])] if closed else pairs


def points_in_gripper(camera: Camera, outline: Outline, uv_px: Array, cam_T_grip: Array) -> Array:
    """The outline's points (p, 3) in the gripper's frame: in the contact plane z = 0; those on rising edges where their
    line of sight is nearest to the parallel of z through the corner from which the edge rises.
    """
    xy = camera.undistort(uv_px)
    eye = -cam_T_grip[:3, :3].T @ cam_T_grip[:3, 3]
    sight = np.column_stack([xy, np.ones(len(xy))]) @ cam_T_grip[:3, :3]
    out: Array = eye - sight * (eye[2] / sight[:, 2])[:, None]
    for k, name in enumerate(outline.names):
        if RISE in name:
            foot = next(a + b - k for a, b in outline.edges if k in (a, b))
            flat = sight[k, :2]
            out[k] = eye + sight[k] * float(flat @ (out[foot, :2] - eye[:2]) / (flat @ flat))
    return out


def inferred_model(
    name: str,
    outline: Outline,
    points_m: Array,
    jaw_range_m: tuple[float, float] | None,
    jaw_opening_m: float | None,
    provenance: Provenance | None,
) -> GripperModel:
    """The gripper file for ``points_m`` (p, 3), the outline's points in the gripper's frame.

    With a range of the jaw each finger moves by half of it; ``jaw_opening_m`` is what the robot reports for these
    coordinates, the distance between the fingers if None.  :class:`CalibrationError` for an opening out of its range.
    """
    jaw = None
    motion = {finger: FingerModel() for finger in FINGERS}
    if jaw_range_m is not None:
        inner = {n: points_m[outline.names.index(n), 0] for n in INNERMOST}
        apart_m = float(inner["right_inner_near"] - inner["left_inner_near"])
        nominal_m = apart_m if jaw_opening_m is None else jaw_opening_m
        low, high = jaw_range_m
        if not low <= nominal_m <= high:
            raise CalibrationError(
                f"the jaws are {nominal_m:.4f} m open, beyond --jaw-range {low:g}:{high:g}; a range that holds this "
                "opening, or --jaw-opening with what the robot reports"
            )
        jaw = JawModel(nominal_m=round(nominal_m, 7), min_m=low, max_m=high)
        for finger, share in _HALF_OPENING.items():
            motion[finger] = FingerModel(motion={"axis": list(AxisMotion(axis=(share, 0.0, 0.0)).axis)})
    points = {}
    for k, point in enumerate(outline.names):
        x, y, z = (round(v, 7) for v in points_m[k].tolist())
        points[point] = PointModel(finger=point.partition("_")[0], xyz_m=(x, y, z), corner=k in outline.corners)
    edges = {_edge_name(outline, a, b): (outline.names[a], outline.names[b]) for a, b in outline.edges}
    return GripperModel(
        name=name,
        fingers=motion,
        points=points,
        edges={edge: EdgeModel(start=a, end=b) for edge, (a, b) in edges.items()},
        jaw=jaw,
        provenance=provenance,
    )


def _edge_name(outline: Outline, a: int, b: int) -> str:
    """Name by the point at its outer end: left_inner, left_near (the side's edge), left_rise_near and so on."""
    finger, kind_a, side_a = outline.names[a].split("_")
    _, kind_b, side_b = outline.names[b].split("_")
    if side_a != side_b:
        return f"{finger}_{kind_a}"
    if "inner" in (kind_a, kind_b) and "rise" not in (kind_a, kind_b):
        return f"{finger}_{side_a}"
    return f"{finger}_{kind_a if POINTS.index(kind_a) > POINTS.index(kind_b) else kind_b}_{side_a}"


Pixel = tuple[float, float]


class RoughCorners(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``corners``: u right, v down in pixels, the centre of the first one at (0, 0); several pixels off is fine."""

    corners: Annotated[dict[str, Pixel], Meta(min_length=1, description="name: [u, v] (px)")]

    def of(self, gripper: Gripper) -> dict[str, Pixel]:
        """Without the points on edges of this gripper, which a file that it was inferred from names, too."""
        return {n: at for n, at in self.corners.items() if n in gripper.corner_ids or n not in gripper.point_ids}


JAW_SIGMA_M = 2e-4
"""Assumed standard deviation of the jaw opening in an image on a plate."""
_ROUGH_PX = 3.0  # standard deviation of a rough corner


def rough_pose(
    camera: Camera,
    gripper: Gripper,
    cam_T_plate: Array,
    rough: Mapping[str, tuple[float, float]],
    jaw_opening_m: float | None,
    contact_m: float,
) -> Array:
    """``cam_T_grip`` (4, 4) from rough corners of a known gripper, good to some pixels.

    Raises :class:`CalibrationError`.
    """
    check_rough(gripper, rough)
    points_m = gripper.points_grip_m(jaw_opening_m)
    known = np.array([points_m[gripper.point_ids.index(name)] for name in rough])
    each = np.tile(np.eye(2) * _ROUGH_PX**2, (len(rough), 1, 1))
    return stand(camera, cam_T_plate, np.array(list(rough.values()), dtype=float), each, known, contact_m).cam_T_grip


def check_rough(gripper: Gripper, rough: Mapping[str, tuple[float, float]]) -> None:
    """Raise :class:`CalibrationError` for rough corners that the gripper doesn't have, or too few of them."""
    strange = [name for name in rough if name not in gripper.corner_ids]
    if strange:
        raise CalibrationError(
            f"corners.{strange[0]}: {gripper.name} has no such corner; one of {', '.join(gripper.corner_ids)}"
        )
    if len(rough) < FEWEST_CORNERS:
        raise CalibrationError(f"{len(rough)} corner ({', '.join(rough)}); at least {FEWEST_CORNERS}, which lie apart")


def measure_known(
    camera: Camera,
    gripper: Gripper,
    image: Image,
    expected_cam_T_grip: Array,
    jaw_opening_m: float | None,
    wanted: Mapping[str, object] | None = None,
) -> tuple[FingerCorners, dict[str, str]]:
    """The corners of a known gripper near an expected pose, all or the ``wanted`` ones, and why others are missing.

    Raises :class:`CalibrationError` where the gripper isn't seen.
    """
    opening_m = gripper.jaw_nominal_m if jaw_opening_m is None else jaw_opening_m
    meter = FingertipMeter(camera, gripper, MeasurementSettings(), JAW_SIGMA_M)
    found = meter.measure(image, expected_cam_T_grip, opening_m, USUAL_SHARE, EVERYWHERE)
    if not found.trusted:
        raise CalibrationError(
            f"the gripper isn't seen where it should be ({100.0 * found.consensus.share:.0f} % of its edges' "
            "search lines are inliers); rough corners nearer to the real ones, the right gripper file and jaw opening, "
            "an image in focus"
        )
    corners = found.corners
    named = np.array([wanted is None or name in wanted for name in gripper.corner_ids])
    missing = {
        name: str(fault.value if fault is not None else "not measured")
        for name, fault, usable, want in zip(gripper.corner_ids, corners.fault, corners.usable, named, strict=True)
        if want and not usable
    }
    taken = corners.usable & named
    if np.count_nonzero(taken) < FEWEST_CORNERS:
        reasons = ", ".join(f"{name} {reason}" for name, reason in missing.items()) or "too few were asked for"
        raise CalibrationError(
            f"{np.count_nonzero(taken)} corner(s) of the gripper ({reasons}); at least {FEWEST_CORNERS}, that lie apart"
        )
    lens = block_diag(*found.prediction.corners.d_uv_d_xy[taken])
    covariance = lens @ corners.joint_covariance_xy(taken) @ lens.T
    names = tuple(name for name, use in zip(gripper.corner_ids, taken, strict=True) if use)
    free = FreePose(found.cam_T_grip, found.covariance[:6, :6], camera, gripper.points_grip_m(jaw_opening_m))
    return FingerCorners(names, corners.uv_px[taken], 0.5 * (covariance + covariance.T), free), missing
