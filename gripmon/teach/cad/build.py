"""From CAD files to a gripper file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import numpy as np

from gripmon.model.camera import Camera
from gripmon.model.errors import InputError
from gripmon.model.geometry import make_transform
from gripmon.model.gripper import UNTOLD_BEVEL_M, WIDEST_BEVEL_M, Gripper, GripperError, GripperModel
from gripmon.model.progress import Progress, quiet
from gripmon.model.provenance import Provenance
from gripmon.model.records import Array, Image
from gripmon.teach.cad.depth import DepthMap, Pinhole
from gripmon.teach.cad.files import MESHES, UNITS_M, Body, joined, read_cao, read_mesh, separate
from gripmon.teach.cad.frame import AXES, approach_of, axes_of, frame_of
from gripmon.teach.cad.jaw import jaw_of
from gripmon.teach.cad.outline import outline_shape
from gripmon.teach.cad.picture import draw_gripper
from gripmon.teach.cad.solid import Shape, cut, is_solid, solid_shape
from gripmon.teach.cad.surface import Surface, surface_of
from gripmon.teach.cad.urdf import TURNS_RAD, Linkage, read_urdf
from gripmon.teach.cad.written import gripper_text, model_of

FORMATS = (*MESHES, ".urdf", ".cao")
LONGEST_M = 0.3
"""Largest length of a finger: a longer one is an arm, or in another unit."""
SHORTEST_M = 0.005
"""A finger shorter than this spans a few tens of pixels at most, or is in another unit: it gets a note."""


@dataclass(frozen=True)
class Parts:
    """The content of the files: ``fingers`` and the other bodies ``around`` them, in the CAD frame; ``paths_m``: for
    each finger the shifts (s, 3) by its joint, empty without a joint.
    """

    fingers: dict[str, Surface]
    around: list[Surface]
    paths_m: list[Array]
    notes: list[str]


@dataclass(frozen=True)
class CadGripper:
    """A gripper from CAD: its ``model`` and the ``notes`` on it; ``grip_T_cad`` (4, 4); ``camera`` and ``cam_T_grip``:
    the view that was given, None without one.
    """

    model: GripperModel
    gripper: Gripper
    shapes: dict[str, Shape]
    grip_T_cad: Array
    camera: Camera | None
    cam_T_grip: Array | None
    notes: tuple[str, ...]

    def text(self) -> str:
        """The gripper file (YAML), with comments."""
        return gripper_text(self.model, self.notes)

    def summary(self) -> list[str]:
        """A summary for people: each finger's corners, edges, faces and size, the jaw's range, and the notes."""
        lines = []
        for finger, shape in self.shapes.items():
            used = shape.points_m[sorted({p for edge in shape.edges for p in edge})]
            size = " x ".join(f"{1e3 * v:.1f}" for v in np.ptp(used, axis=0))
            counts = f"{len(shape.corners)} corners, {len(shape.edges)} edges, {len(shape.loops)} faces"
            lines.append(f"{finger}: {counts}, {size} mm")
        if self.model.jaw is not None:
            jaw = self.model.jaw
            lines.append(
                f"jaw: {1e3 * jaw.min_m:.1f} to {1e3 * jaw.max_m:.1f} mm, as drawn {1e3 * jaw.nominal_m:.1f} mm"
            )
        return [*lines, *(f"note: {note}" for note in self.notes)]

    def picture(self) -> Image:
        """The model in the view, BGR: outlines, creases, corners by name.  ValueError without a view."""
        if self.camera is None or self.cam_T_grip is None:
            raise ValueError("no view: a camera and cam_T_grip")
        return draw_gripper(self.camera, self.gripper, self.cam_T_grip)


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
    frame: str = "tcp",
    approach: str | None = None,
    length_m: float | None = None,
    bevel_m: float = UNTOLD_BEVEL_M,
    provenance: Provenance | None = None,
    progress: Progress = quiet,
) -> CadGripper:
    """A gripper model from CAD files: one mesh (STL, OBJ, PLY) or .cao per finger, or one file with both; or a URDF.

    ``unit`` of meshes: "m", "mm", "cm" or "in"; URDF and .cao are in metres.  ``frame``: "tcp" puts the origin between
    the fingertips, x across the jaws and z along ``approach`` (an axis of the CAD frame, "+z" and the like; if None,
    "+z", or for a URDF the axis along which its fingers reach); "cad" keeps the file's axes.  ``jaw_range_m``: meshes
    of two fingers move by half of the opening each; a URDF has its own motion (``joint``: its name, if several are
    possible).  ``jaw_opening_m`` is what a robot reports for the fingers as drawn; the distance of the tips if None.
    ``length_m``: the length of the fingers to use, from the tips.  ``bevel_m``: width of the bevels on real edges that
    are sharp in the CAD; 0 only for edges sharper than 0.02 mm, since protection levels include only what is stated.

    Convex fingers with flat faces are valid for every view.  Others need ``camera`` and ``cam_T_grip`` (4, 4), and are
    made for that view.  :class:`~gripmon.model.errors.InputError` says what can't be used, and what can.
    """
    _check(frame, approach, unit, length_m, bevel_m)
    parts = _read(files, unit, joint, progress)
    grip_T_cad, notes = _frame(parts, frame, approach, joint is not None or bool(parts.paths_m))
    fingers = {name: _moved(surface, grip_T_cad) for name, surface in parts.fingers.items()}
    paths = [path @ grip_T_cad[:3, :3].T for path in parts.paths_m]
    notes = [*parts.notes, *notes]
    around = [_moved(surface, grip_T_cad) for surface in parts.around]
    view = None if camera is None or cam_T_grip is None else Pinhole.of(camera, cam_T_grip)
    shapes, seen = _shapes(fingers, around, view, length_m, frame == "tcp", progress)
    if seen and view is None:
        why = f"is missing: {seen[0]}, and what shows of it depends on the view; a camera, and where the gripper stands"
        raise InputError(why, "camera" if camera is None else "reference")
    notes += [f"{each}: its edges are those of this view; make it again for another" for each in seen]
    jaw = jaw_of(fingers, paths, jaw_range_m, jaw_opening_m)
    model = model_of(name or Path(files[0]).stem, shapes, bevel_m, jaw, provenance)
    try:
        gripper = Gripper(model)
    except GripperError as error:
        raise InputError(f"{files[0]}: {_what_shows(shapes)} ({error}); another view, or --length") from None
    return CadGripper(
        model, gripper, shapes, grip_T_cad, camera, cam_T_grip, (*notes, _on_bevels(bevel_m), *gripper.notes)
    )


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
    if approach is not None and approach not in AXES:
        raise InputError(f"'{approach}' is not an axis; one of {', '.join(AXES)}", "approach")
    if frame == "cad" and length_m is not None:
        raise InputError(
            f"{length_m:g}: is measured from the tips backwards, along z; not with the CAD's own frame", "length"
        )
    if length_m is not None and not 0.0 < length_m <= LONGEST_M:
        raise InputError(f"{length_m:g} m: is not a finger's length; metres, such as 0.04", "length")
    if unit is not None and unit not in UNITS_M:
        raise InputError(f"'{unit}' is not a unit; one of {', '.join(UNITS_M)}", "unit")
    if not 0.0 <= bevel_m <= WIDEST_BEVEL_M:
        raise InputError(f"{bevel_m:g} m: is not a bevel's width; 0 to {WIDEST_BEVEL_M:g} m", "bevel")


def _read(files: Sequence[str | PathLike[str]], unit: str | None, joint: str | None, progress: Progress) -> Parts:
    """Read all files' bodies as fingers."""
    paths = [Path(file) for file in files]
    if not paths:
        raise InputError("from-cad: no file; a mesh or .cao for each finger, or a URDF")
    for path in paths:
        if path.suffix.lower() not in FORMATS:
            raise InputError(f"{path}: is not a format of CAD that is read here; one of {', '.join(FORMATS)}")
        if not path.is_file():
            raise InputError(f"{path}: there is no such file; one of {', '.join(FORMATS)}")
    for k, path in enumerate(paths):
        if path.resolve() in [other.resolve() for other in paths[:k]]:
            raise InputError(f"{path}: is named twice; a mesh for each finger, where it stands, or both in one file")
    if any(path.suffix.lower() == ".urdf" for path in paths):
        if len(paths) > 1:
            raise InputError(f"{paths[0]}: and {len(paths) - 1} more files; a URDF by itself")
        with progress(2, "step") as step:
            linkage = read_urdf(paths[0], joint)
            step()
            parts = _of_linkage(paths[0], linkage)
            step()
        return parts
    if joint is not None:
        raise InputError(f"{joint}: {paths[0]} has no joints; a URDF", "joint")
    with progress(2 * len(paths), "step") as step:
        bodies = []
        for path in paths:
            bodies.append(read_cao(path) if path.suffix.lower() == ".cao" else read_mesh(path, unit))
            step()
        bodies, notes = (bodies, []) if len(bodies) > 1 else _fingers_in(bodies[0])
        surfaces = []
        for body in bodies:
            surfaces.append(_checked(surface_of(body), body.name))
            step()
    notes += [note for body, surface in zip(bodies, surfaces, strict=True) for note in _odd(surface, body.name)]
    names = _names(len(surfaces), [body.name for body in bodies])
    order = _left_to_right(surfaces)
    return Parts({n: surfaces[k] for n, k in zip(names, order, strict=True)}, [], [], notes)


def _fingers_in(body: Body) -> tuple[list[Body], list[str]]:
    """A file's separate pieces as one finger or two: small pieces belong to the nearer of the two largest."""
    pieces = separate(body)
    if len(pieces) == 1:
        return pieces, []
    middles = [piece.points_m.mean(axis=0) for piece in pieces]
    sizes = [float(np.ptp(piece.points_m, axis=0).max()) for piece in pieces]
    if sizes[1] < 0.5 * sizes[0]:
        return [joined(pieces, body.name)], [f"{body.name}: {len(pieces)} pieces, taken as one finger"]
    near = [int(np.linalg.norm(m - middles[1]) < np.linalg.norm(m - middles[0])) for m in middles]
    two = [joined([p for p, side in zip(pieces, near, strict=True) if side == k], body.name) for k in (0, 1)]
    return two, [f"{body.name}: {len(pieces)} pieces, taken as two fingers"]


def _of_linkage(path: Path, linkage: Linkage) -> Parts:
    """A URDF's fingers: the links that move without turning."""
    straight = [m for m in linkage.moving if m.turns_rad <= TURNS_RAD]
    if not straight:
        turns = np.degrees(max(m.turns_rad for m in linkage.moving))
        raise InputError(
            f"{path}: its fingers turn by {turns:.0f} degrees while joint '{linkage.joint}' moves; a gripper file "
            "holds fingers that don't turn: a mesh of the finger that stands, or of both at the opening that is used"
        )
    surfaces = [_checked(surface_of(m.body), m.body.name) for m in straight]
    notes = [note for m, s in zip(straight, surfaces, strict=True) for note in _odd(s, m.body.name)]
    turning = [m.body for m in linkage.moving if m.turns_rad > TURNS_RAD]
    if turning:
        names = ", ".join(body.name for body in turning)
        notes.append(f"links that turn aren't fingers; they only hide what is behind them: {names}")
    order = _left_to_right(surfaces)
    names_ = _names(len(surfaces), [m.body.name for m in straight])
    others = [*turning, *([linkage.base] if linkage.base is not None else [])]
    fingers = {n: surfaces[k] for n, k in zip(names_, order, strict=True)}
    return Parts(fingers, [surface_of(body) for body in others], [straight[k].path_m for k in order], notes)


def _names(count: int, given: list[str]) -> list[str]:
    return {1: ["finger"], 2: ["left", "right"]}.get(count, given if len(set(given)) == count else []) or [
        f"finger{k + 1}" for k in range(count)
    ]


def _left_to_right(surfaces: list[Surface]) -> list[int]:
    """The fingers' order along the axis of the CAD frame along which they are farthest apart."""
    middles = np.array([0.5 * (s.points_m.min(axis=0) + s.points_m.max(axis=0)) for s in surfaces])
    return np.argsort(middles[:, int(np.ptp(middles, axis=0).argmax())], kind="stable").tolist()


def _checked(surface: Surface, name: str) -> Surface:
    if not len(surface.triangles) and not len(surface.lines):
        raise InputError(f"{name}: no triangle has an area; a mesh of the finger's surface")
    if float(np.ptp(surface.points_m, axis=0).max()) > LONGEST_M:
        size = " x ".join(f"{1e3 * v:.0f}" for v in np.ptp(surface.points_m, axis=0))
        raise InputError(
            f"{name}: a finger of {size} mm; at most {1e3 * LONGEST_M:.0f} mm: its unit, or only the finger"
        )
    return surface


def _odd(surface: Surface, name: str) -> list[str]:
    """Notes on a surface too small for its unit, and on one that isn't closed: its borders show as edges."""
    out = []
    longest_m = float(np.ptp(surface.points_m, axis=0).max())
    if longest_m < SHORTEST_M:
        out.append(f"{name}: a finger of {1e3 * longest_m:.2g} mm: is its unit right?")
    count = int(np.count_nonzero(surface.border))
    if count:
        no = f"{count} sides of triangles have no neighbour"
        out.append(f"{name}: the surface is open ({no}): borders are taken as edges")
    return out


def _kind(surface: Surface) -> str:
    if not surface.closed:
        return "open"
    return "not convex" if surface.flat() else "round in parts"


def _moved(surface: Surface, grip_T_cad: Array) -> Surface:
    rotation = grip_T_cad[:3, :3]
    return replace(
        surface, points_m=surface.points_m @ rotation.T + grip_T_cad[:3, 3], normals=surface.normals @ rotation.T
    )


def _frame(parts: Parts, frame: str, approach: str | None, linked: bool) -> tuple[Array, list[str]]:
    """``grip_T_cad`` (4, 4), and notes on it."""
    if frame == "cad":
        return make_transform(np.eye(3), np.zeros(3)), ["the frame is the CAD's own"]
    fingers = list(parts.fingers.values())
    chosen = approach or (approach_of(fingers, parts.around) if linked else "+z")
    transform, corners = frame_of(fingers, axes_of(fingers, chosen))
    notes = [f"z points along {chosen} of the CAD frame, x along {_axis(transform[0, :3])}"]
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
