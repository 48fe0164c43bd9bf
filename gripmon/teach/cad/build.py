"""From CAD files to a gripper file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import numpy as np

from gripmon.model.camera import Camera
from gripmon.model.errors import InputError
from gripmon.model.geometry import invert
from gripmon.model.gripper import UNTOLD_BEVEL_M, WIDEST_BEVEL_M, FingerModel, Gripper, GripperError
from gripmon.model.progress import Progress, quiet
from gripmon.model.provenance import Provenance
from gripmon.model.records import Array
from gripmon.teach.cad.depth import DepthMap, Pinhole
from gripmon.teach.cad.files import UNITS_M
from gripmon.teach.cad.frame import AXES, axes_of, check_level, frame_of
from gripmon.teach.cad.jaw import jaw_of
from gripmon.teach.cad.outline import outline_shape
from gripmon.teach.cad.parts import LONGEST_M, STRAIGHT_NOTE, Parts, read_parts
from gripmon.teach.cad.solid import cut, is_solid, solid_shape
from gripmon.teach.cad.surface import Surface
from gripmon.teach.result import GripperResult
from gripmon.teach.shape import Shape, model_of


@dataclass(frozen=True, kw_only=True)
class CadGripper(GripperResult):
    """A gripper from CAD, in the view that was given, if one was; ``origins``: the file, bodies or links of each
    finger; ``grip_T_cad`` (4, 4).
    """

    origins: tuple[str, ...]
    grip_T_cad: Array

    def called(self, finger: str) -> str:
        """A finger with where it comes from."""
        return f"{finger} ({self.origins[self.gripper.finger_ids.index(finger)]})"


def gripper_from_cad(
    files: Sequence[str | PathLike[str]],
    *,
    unit: str | None = None,
    name: str | None = None,
    camera: Camera | None = None,
    cam_T_grip: Array | None = None,
    jaw_range_m: tuple[float, float] | None = None,
    jaw_opening_m: float | None = None,
    joint: str | None = None,
    body: str | None = None,
    frame: str = "tcp",
    approach: str | None = None,
    length_m: float | None = None,
    bevel_m: float = UNTOLD_BEVEL_M,
    provenance: Provenance | None = None,
    progress: Progress = quiet,
) -> CadGripper:
    """A gripper model from CAD files: one mesh (STL, OBJ, PLY, DAE) or .cao per finger, one file with both, or a URDF.

    ``unit`` of meshes: "m", "mm", "cm" or "in"; URDF, DAE and .cao have theirs.  ``body``: which bodies of a file are
    fingers ("all" for one, "1,2", "1+3,2"), or which links of a URDF.  ``frame``: "tcp" puts the origin between the
    fingertips, x across the jaws, from the finger called left to the right one, and z along ``approach`` (an axis of
    the CAD frame, "+z" and the like, or two with a comma: z and x; if None, "+z", or for a URDF the axis along which
    its fingers reach); "cad" keeps the file's axes.

    ``jaw_range_m``: meshes of two fingers move by half of the opening each; a URDF has its own motion, cut to the
    range.  ``joint``: the URDF's joint that opens the jaws, if several are possible, "NAME=POSITION" (m or rad) where
    it stands, or two with a comma.  ``jaw_opening_m`` is what a robot reports for the fingers as drawn; the distance of
    the tips if None.  ``length_m``: the length of the fingers to use, from the tips.  ``bevel_m``: width of the bevels
    on real edges that are sharp in the CAD; 0 only for edges sharper than 0.02 mm, since protection levels include only
    what is stated.

    Convex fingers with flat faces are valid for every view.  Others need ``camera`` and ``cam_T_grip`` (4, 4), and are
    made for that view.  :class:`~gripmon.model.errors.InputError` says what can't be used, and what can.
    """
    _check(frame, approach, unit, length_m, bevel_m)
    parts = read_parts([Path(file) for file in files], unit, joint, body, approach, progress)
    # The tips' frame, in which fingers are cut and measured; what is written may be in the CAD's.
    whole = frame == "cad" and len(parts.fingers) == 1 and length_m is None and not parts.paths_m
    tip_T_cad, notes = (np.eye(4), []) if whole else _frame(parts, approach)
    fingers = {name: _moved(surface, tip_T_cad) for name, surface in parts.fingers.items()}
    around = [_moved(surface, tip_T_cad) for surface in parts.around]
    grip_T_tip = invert(tip_T_cad) if frame == "cad" else np.eye(4)
    view = None if camera is None or cam_T_grip is None else Pinhole.of(camera, cam_T_grip @ grip_T_tip)
    shapes, seen = _shapes(fingers, around, view, length_m, frame == "tcp" or length_m is not None, progress)
    if seen and view is None:
        why = f"is missing: {seen[0]}, and what shows of it depends on the view; a camera, and where the gripper stands"
        raise InputError(why, "camera" if camera is None else "reference")
    shapes = {name: shape.moved(grip_T_tip) for name, shape in shapes.items()}
    jaw = jaw_of(fingers, [path @ tip_T_cad[:3, :3].T for path in parts.paths_m], jaw_range_m, jaw_opening_m)
    notes = [*parts.notes, *(["the frame is the CAD's own"] if frame == "cad" else notes)]
    if jaw is not None and not parts.paths_m:
        notes.append(STRAIGHT_NOTE)
    notes += [f"{each}: its edges are those of this view; make it again for another" for each in seen]
    jaw = None if jaw is None else jaw.turned(grip_T_tip[:3, :3])
    moving = {finger: FingerModel(motion=None if jaw is None else jaw.motion(finger)) for finger in shapes}
    called = name or Path(files[0]).stem
    model = model_of(called, shapes, bevel_m, moving, None if jaw is None else jaw.model, provenance)
    try:
        gripper = Gripper(model)
    except GripperError as error:
        raise InputError(f"{files[0]}: {_what_shows(shapes)} ({error}); another view, or --length") from None
    notes += [_on_bevels(bevel_m), *gripper.notes]
    lens = None if camera is None else camera.settings
    return CadGripper(
        gripper=gripper, notes=tuple(notes), lens=lens, cam_T_grip=cam_T_grip, origins=parts.origins,
        grip_T_cad=grip_T_tip @ tip_T_cad,
    )  # fmt: skip


def _shapes(
    fingers: dict[str, Surface],
    around: list[Surface],
    view: Pinhole | None,
    length_m: float | None,
    mounted: bool,
    progress: Progress,
) -> tuple[dict[str, Shape], list[str]]:
    """Each finger's points and edges, and as texts the fingers whose shape depends on the view; these have no shape
    without one.
    """
    shapes: dict[str, Shape] = {}
    seen: list[str] = []
    depth: DepthMap | None = None
    with progress(len(fingers), "finger") as step:
        for finger, surface in fingers.items():
            low, foremost = surface.points_m[:, 2].min(), float(surface.points_m[:, 2].max())
            lowest = None if length_m is None else foremost - length_m
            if is_solid(surface):
                shorter = surface if lowest is None or lowest <= low + 1e-4 else cut(surface, lowest)
                shapes[finger] = solid_shape(shorter, mounted)
            else:
                seen.append(f"finger '{finger}' is {_kind(surface)}")
                if view is not None:
                    depth = depth or DepthMap(view, [*fingers.values(), *around])
                    shapes[finger] = outline_shape(surface, view, depth, lowest, mounted)
            step()
    return shapes, seen


def _check(frame: str, approach: str | None, unit: str | None, length_m: float | None, bevel_m: float) -> None:
    if frame not in ("tcp", "cad"):
        raise InputError(f"'{frame}' is not a frame; tcp or cad", "frame")
    if approach is not None:
        keys = approach.split(",")
        if len(keys) > 2 or not set(keys) <= set(AXES) or (len(keys) > 1 and AXES[keys[0]] @ AXES[keys[1]] != 0.0):
            right = f"one of {', '.join(AXES)}; or the one out of the gripper and the one across the jaws, as +z,+x"
            raise InputError(f"'{approach}' is not an axis; {right}", "approach")
    if length_m is not None and not 0.0 < length_m <= LONGEST_M:
        raise InputError(f"{length_m:g} m: is not a finger's length; metres, such as 0.04", "length")
    if unit is not None and unit not in UNITS_M:
        raise InputError(f"'{unit}' is not a unit; one of {', '.join(UNITS_M)}", "unit")
    if not 0.0 <= bevel_m <= WIDEST_BEVEL_M:
        raise InputError(f"{bevel_m:g} m: is not a bevel's width; 0 to {WIDEST_BEVEL_M:g} m", "bevel")


def _kind(surface: Surface) -> str:
    if not surface.closed:
        return "open"
    return "not convex" if surface.flat() else "round in parts"


def _moved(surface: Surface, grip_T_cad: Array) -> Surface:
    rotation = grip_T_cad[:3, :3]
    return replace(
        surface, points_m=surface.points_m @ rotation.T + grip_T_cad[:3, 3], normals=surface.normals @ rotation.T
    )


def _frame(parts: Parts, approach: str | None) -> tuple[Array, list[str]]:
    """``tip_T_cad`` (4, 4), and notes on it."""
    fingers = list(parts.fingers.values())
    approach = approach or parts.approach
    axes = axes_of(fingers, approach, parts.along, parts.pivot)
    if parts.pivot is None and "," not in (approach or ""):
        check_level(fingers, axes[2])
    transform, corners = frame_of(fingers, axes)
    way = f", from finger {' to '.join(list(parts.fingers)[:: len(fingers) - 1])}" if len(fingers) > 1 else ""
    notes = [f"z points along {_axis(axes[2])} of the CAD frame, x along {_axis(axes[0])}{way}"]
    x, y, z = (0.0 + round(v, 5) for v in (-transform[:3, :3].T @ transform[:3, 3]).tolist())
    notes.append(f"between the fingertips is ({x:g}, {y:g}, {z:g}) m of the CAD frame: the TCP, unless --frame cad")
    if not all(corners):
        notes.append("a fingertip has no sharp corners: the TCP is between the tips' innermost points")
    return transform, notes


def _axis(direction: Array) -> str:
    for name, axis in AXES.items():
        if np.allclose(direction, axis, atol=1e-9):
            return name
    return "(" + ", ".join(f"{v:.4f}" for v in direction) + ")"


def _on_bevels(bevel_m: float) -> str:
    if not bevel_m:
        return "sharp edges are taken as exact: were they broken by 0.1 mm, a valid transform could be beyond its bound"
    return (
        f"sharp edges may be broken by {1e3 * bevel_m:g} mm (bevel_m), which makes bounds wide, mostly too wide for a "
        "valid transform, until gripmon teach has measured how the edges really show"
    )


def _what_shows(shapes: dict[str, Shape]) -> str:
    parts = [f"{len(s.edges)} edges and {len(s.corners)} corners of '{n}'" for n, s in shapes.items()]
    return f"this view shows {', '.join(parts)}"
