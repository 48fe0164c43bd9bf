"""A gripper however it was made, from CAD, from images or on a plate: its file, reference, summary and picture."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from gripmon.calibrate.documents import CalibratedGripper, HandEyeCalibration, HandEyeResiduals
from gripmon.model.camera import Camera, LensSettings, make_camera
from gripmon.model.geometry import to_record
from gripmon.model.gripper import SIZE_UNKNOWN, Gripper, GripperModel
from gripmon.model.provenance import Provenance
from gripmon.model.records import Array, Image
from gripmon.model.response import Response
from gripmon.model.yaml_text import in_one_line
from gripmon.teach.drawing import draw_gripper
from gripmon.track.edges.taught import gripper_digest


@dataclass(frozen=True, kw_only=True)
class GripperResult:
    """A ``gripper``, and ``notes`` on what is unknown or was assumed.

    Where the maker knows it, the gripper's pose before a camera ``lens``: ``cam_T_grip`` (4, 4), the ``covariance``
    (6, 6) of its error (position of the TCP, then rotation, camera axes; None: it is only a view), at the opening
    ``opening_m`` of a moving jaw, from so many ``corners`` in so many ``images``, which fit to ``rms_px``, ``rms_m``;
    ``with_gripper``: the gripper is made of the same images, whose errors of size and tilt both have, and which show
    the camera's ``response``.
    """

    gripper: Gripper
    notes: tuple[str, ...] = ()
    lens: LensSettings | None = None
    cam_T_grip: Array | None = None
    covariance: Array | None = None
    opening_m: float | None = None
    corners: int = 0
    images: int = 1
    rms_px: float = 0.0
    rms_m: float = 0.0
    with_gripper: bool = False
    response: Response | None = None

    @property
    def model(self) -> GripperModel:
        """What the gripper file holds."""
        return self.gripper.model

    def text(self) -> str:
        """The gripper file: YAML with comments, without keys that have their default."""
        return "\n".join(_lines(self.model, self.notes)) + "\n"

    def reference(self, provenance: Provenance) -> HandEyeCalibration:
        """The pose as a configuration's ``reference:`` names it.  ValueError without one."""
        if self.lens is None or self.cam_T_grip is None or self.covariance is None:
            raise ValueError("no reference: a camera, cam_T_grip and its covariance")
        return HandEyeCalibration(
            camera=self.lens,
            gripper=CalibratedGripper(name=self.gripper.name, sha256=gripper_digest(self.gripper)),
            jaw_opening_m=self.opening_m,
            cam_T_grip=to_record(self.cam_T_grip),
            covariance=tuple(self.covariance.ravel().tolist()),
            residuals=HandEyeResiduals(rms_m=self.rms_m, rms_px=self.rms_px, corners=self.corners, images=self.images),
            with_gripper=self.with_gripper,
            response=self.response,
            warnings=self.notes,
            provenance=provenance,
        )

    def fingers(self) -> dict[str, dict[str, int]]:
        """By finger the numbers of its ``corners``, ``edges`` of the outline, ``inner_edges`` and ``faces``."""
        model, out = self.model, {}
        for name in self.gripper.finger_ids:
            own = [edge for edge in model.edges.values() if model.points[edge.start].finger == name]
            out[name] = {
                "edges": sum(edge.kind == "contour" for edge in own),
                "inner_edges": sum(edge.kind == "crease" for edge in own),
                "corners": sum(point.corner for point in model.points.values() if point.finger == name),
                "faces": sum(face.finger == name for face in model.faces),
            }
        return out

    def called(self, finger: str) -> str:
        """A finger as the summary calls it."""
        return finger

    def about(self) -> list[str]:
        """What the maker adds to the summary, a line each."""
        return []

    def summary(self) -> list[str]:
        """What a person should know: each finger, the jaws' range, where the gripper stands, the notes."""
        lines, known = [], self.model.scale_sigma < SIZE_UNKNOWN
        for finger, has in self.fingers().items():
            places = np.array([point.xyz_m for point in self.model.points.values() if point.finger == finger])
            size = " x ".join(f"{1e3 * v:.1f}" for v in np.ptp(places, axis=0))
            inner = f", {has['inner_edges']} inner ones" if has["inner_edges"] else ""
            faces = f", {has['faces']} faces" if has["faces"] else ""
            counts = f"{has['edges']} edges{inner}, {has['corners']} corners{faces}"
            lines.append(f"{self.called(finger)}: {counts}{f', {size} mm' if known else ''}")
        if self.model.jaw is not None:
            low, high, here = (1e3 * v for v in (self.model.jaw.min_m, self.model.jaw.max_m, self.model.jaw.nominal_m))
            lines.append(f"jaw: {low:.1f} to {high:.1f} mm, in the file {here:.1f} mm")
        lines += self.about()
        if self.cam_T_grip is not None and self.covariance is not None:
            x, y, z = (1e3 * value for value in self.cam_T_grip[:3, 3].tolist())
            sx, sy, sz = (1e3 * self.covariance[k, k] ** 0.5 for k in range(3))
            lines.append(f"TCP in the camera frame  {x:.2f} {y:.2f} {z:.2f} mm  +- {sx:.2f} {sy:.2f} {sz:.2f} mm")
        return [*lines, *(f"note: {note}" for note in self.notes)]

    def values(self) -> dict[str, Any]:
        """The result as plain values: m, rad, px."""
        out: dict[str, Any] = {"fingers": self.fingers(), "jaw_opening_m": self.opening_m, "notes": self.notes}
        if self.cam_T_grip is not None and self.covariance is not None:
            transform = to_record(self.cam_T_grip)
            out["cam_T_grip"] = {"translation_m": transform.translation_m, "rotation_xyzw": transform.rotation_xyzw}
            out["covariance"] = self.covariance.ravel().tolist()
        return out

    @property
    def camera(self) -> Camera | None:
        """The camera of the view, if there is one."""
        return None if self.lens is None else make_camera(self.lens)

    def picture(self) -> Image:
        """The model in the view, BGR: outlines, creases, corners by name.  ValueError without a view."""
        if self.camera is None or self.cam_T_grip is None:
            raise ValueError("no view: a camera and cam_T_grip")
        return draw_gripper(self.camera, self.gripper, self.cam_T_grip)


_ABOUT = {
    "name": "any text; appears in recordings",
    "fingers": "how each moves: `axis` (m of motion for each m of opening) or `table` (opening, dx, dy, dz, m)",
    "points": "x, y, z (m) at the nominal opening; `corner: true`: measured as a fingertip corner; `round`: on the "
    "outline of a part that is round about an axis",
    "edges": "between two points, straight, or curved through the points `via`; `kind`: where faces don't say; "
    "`bevel_m`: width of a bevel, or of where the edge may lie (m)",
    "faces": "loops of points, counter-clockwise seen from outside; they decide what is visible",
    "jaw": "openings (m): smallest, largest, and the one at which the coordinates below hold",
    "scale_sigma": "standard deviation of a factor on all lengths; 1: the size is unknown",
    "tilt_sigma_rad": "standard deviation of the tilt of the plane that the fingers' points lie in (rad)",
}


def _lines(model: GripperModel, notes: Sequence[str]) -> Iterator[str]:
    yield f"# Gripper '{model.name}', written by gripmon."
    for note in notes:
        yield f"# {note}"
    yield "# Gripper frame, metres: origin at the TCP, x across the jaws, z out of it, unless a note above differs."
    for key, value in _short(model).items():
        about = f"  # {_ABOUT[key]}" if key in _ABOUT else ""
        if isinstance(value, dict) and key != "jaw":
            yield f"{key}:{about}"
            yield from (f"  {in_one_line(name)}: {in_one_line(part)}" for name, part in value.items())
        elif isinstance(value, list):
            yield f"{key}:{about}"
            yield from (f"  - {in_one_line(part)}" for part in value)
        else:
            yield f"{key}: {in_one_line(value)}{about}"


def _short(part: Any) -> Any:
    """Plain values without those at their default."""
    if isinstance(part, msgspec.Struct):
        fields = [field for field in msgspec.structs.fields(part) if getattr(part, field.name) != field.default]
        return {field.encode_name: _short(getattr(part, field.name)) for field in fields}
    if isinstance(part, dict):
        return {key: _short(value) for key, value in part.items()}
    return [_short(value) for value in part] if isinstance(part, list | tuple) else part
