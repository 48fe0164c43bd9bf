"""The schema of a gripper file."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from gripmon.model.errors import InputError
from gripmon.model.provenance import Provenance

Vector = tuple[float, float, float]
SIZE_UNKNOWN = 1.0
"""``scale_sigma`` of a gripper whose size isn't known: its lengths are in units of its distance from the camera."""
Opening = Annotated[float, Meta(ge=0.0, le=0.5, description="jaw opening (m)")]


class GripperError(InputError):
    """A gripper file that can't be used; the text is ``key: what is wrong; what would be right``."""


class JawModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``nominal_m``: where the file's coordinates hold; openings beyond ``min_m`` to ``max_m`` are impossible."""

    nominal_m: Opening
    min_m: Opening
    max_m: Opening


class AxisMotion(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Finger motion in the gripper frame, in metres per metre of opening beyond the nominal one."""

    axis: Vector


class TableMotion(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Rows ``opening_m, dx_m, dy_m, dz_m`` with ascending openings; linear between rows, and beyond them, where what
    an arc would deviate is in every bound.
    """

    table: Annotated[tuple[tuple[float, float, float, float], ...], Meta(min_length=2)]


class FingerModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    motion: dict[str, Any] | None = None


class RoundModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The round surface that a point of an outline lies on: a surface of revolution around ``axis`` through
    ``centre_m``.

    The outline of a cylinder or ball isn't a fixed line on it: it lies where the surface turns away from the eye, and
    moves as the view changes.  Coordinates are given like the point's own, at the nominal opening.
    """

    centre_m: Vector
    axis: Vector


class PointModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    finger: str
    xyz_m: Vector
    corner: bool = False
    round: RoundModel | msgspec.UnsetType = msgspec.UNSET  # not None: keeps the digests of files without it


UNTOLD_BEVEL_M = 2e-4
"""Width of a bevel that no one has stated: where a drawing leaves the shape of its edges open (ISO 13715) or asks for
them broken by 0.1 to 0.3 mm, as is usual for machined parts.
"""

WIDEST_BEVEL_M = 0.02
MOST_VIA = 62
"""Most points on a curved edge between its ends."""


class EdgeModel(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, rename={"start": "from", "end": "to"}
):
    start: str
    end: str
    kind: Literal["contour", "crease"] = "contour"
    brighter: Literal["left", "right", "any"] = "any"
    bevel_m: Annotated[float, Meta(ge=0.0, le=WIDEST_BEVEL_M, description="width of a bevel or rounding (m)")] = 0.0
    via: Annotated[
        tuple[Vector, ...],
        Meta(max_length=MOST_VIA, description="a curved edge: points on it in turn, without its ends (m)"),
    ] = ()


class FaceModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    finger: str
    points: Annotated[tuple[str, ...], Meta(min_length=3)]


class GripperModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A gripper file; see ``configs/grippers`` for commented ones."""

    name: str
    fingers: dict[str, FingerModel]
    points: dict[str, PointModel]
    edges: dict[str, EdgeModel]
    jaw: JawModel | None = None
    faces: tuple[FaceModel, ...] = ()
    scale_sigma: Annotated[
        float,
        Meta(
            ge=0.0,
            le=1.0,
            description="standard deviation of a factor on all lengths, for the protection level; 0: the unit is "
            "exact; 1: the size is unknown, and lengths are in units of the distance from the camera",
        ),
    ] = 0.0
    tilt_sigma_rad: Annotated[
        float,
        Meta(
            ge=0.0,
            le=1.0,
            description="standard deviation of the tilt of the plane that the fingers' points lie in, as far as the "
            "images that the file was made of don't show it (rad); 0: exact",
        ),
    ] = 0.0
    provenance: Provenance | None = None


def contents_of(model: GripperModel) -> dict[str, Any]:
    """The contents of a gripper file that describe the gripper, for digests: all but its provenance."""
    contents = {key: value for key, value in msgspec.to_builtins(model).items() if key != "provenance"}
    for key in ("scale_sigma", "tilt_sigma_rad"):
        if not contents[key]:  # as digests from before it
            del contents[key]
    for edge in contents["edges"].values():
        if not edge["via"]:  # digests of grippers without curves date from before curves
            del edge["via"]
    return contents
