"""The taught model: where each edge of this gripper really appears to this camera, relative to its sharp model.

Bevels, roundings, shading and the blur of the lens shift an edge from its line in the gripper file, by the same amount
in every image.  The offset is measured once, in images at the reference calibration, and added to the prediction, so
that the bias cancels; the method's own reference corners, measured in the reference image, do the same ("Corners" of
the self-viewing method).

An edge's offset is a length across the line of sight, off the plane through the camera's centre and the model's edge
(m), linear along the edge; positive to the right of someone who walks along the edge in the image.  The reference
calibration is by definition the gripper's pose in the teaching images, so that the offsets include its error.  In the
gripper frame an offset stays the same when the camera or the jaws move.  The offset along the line of sight
(``depth_m``, positive away from the camera) can't be measured from one pose; it follows from the shape of a bevel, with
a wide standard deviation, and has the more effect the more the line of sight has turned since.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from gripmon.model.camera import Camera, LensSettings
from gripmon.model.geometry import from_record, invert, rotation_angle, to_record
from gripmon.model.gripper import Gripper, contents_of
from gripmon.model.gripper.core import POLARITY
from gripmon.model.records import Array, AtReferenceRecord, ReferenceRecord, Transform
from gripmon.track.edges.settings import EdgeSettings

LARGEST_OFFSET_M = 0.02
"""Bound on an edge's offset in a file, m: more is another edge, or another unit."""

SAME_POSE = 1e-6
"""Poses are the same if no element of their matrices (m, no unit) differs by more: files hold rounded numbers."""

PoseOffset = tuple[float, float, float, float, float, float]
Length = Annotated[float, Meta(ge=-LARGEST_OFFSET_M, le=LARGEST_OFFSET_M, description="across the line of sight (m)")]
Deviation = Annotated[float, Meta(ge=0.0, le=LARGEST_OFFSET_M, description="standard deviation (m)")]
Share = Annotated[float, Meta(ge=0.0, le=1.0, description="part of the way from the edge's `from` to its `to`")]
Digest = Annotated[str, Meta(pattern="^[0-9a-f]{64}$", description="SHA-256, 64 hexadecimal digits")]


class TaughtImage(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """An image that was taught from."""

    file: str
    sha256: Digest
    jaw_opening_m: Annotated[float, Meta(ge=0.0, le=0.5, description="jaw opening in this image (m)")] | None = None


class Provenance(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Origin of a taught model; ``closure_px``: largest distance of the gripper from the reference in its images,
    measured with the model.
    """

    gripmon: str
    time: str
    command: str
    images: Annotated[tuple[TaughtImage, ...], Meta(min_length=1)]
    closure_px: Annotated[float, Meta(ge=0.0)]


class TaughtGripper(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    name: str
    sha256: Digest


class TaughtReference(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The reference that was taught at; ``offset``: the perturbation (6,) from it to the gripper in the images, as far
    as bevels don't explain it (m, rad); ``images_covariance`` (36,), 6 x 6 row by row: how well the images alone show
    where the gripper is, None in files of earlier versions.  ``seen``: where a monitor that knows the edges sees the
    gripper in the images, on average, and ``play`` (6,), standard deviations from image to image (m, rad); without
    either where too little was seen, and in files of earlier versions.
    """

    id: str
    cam_T_grip: Transform
    offset: PoseOffset = (0.0,) * 6
    images_covariance: Annotated[tuple[float, ...], Meta(min_length=36, max_length=36)] | None = None
    play: PoseOffset = (0.0,) * 6
    seen: AtReferenceRecord | None = None


class TaughtEdge(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One edge: ``offset_m`` and ``sigma_m`` at the two ends ``share`` of the visible part, linear between them, and
    its depth behind the model's edge.
    """

    share: tuple[Share, Share]
    offset_m: tuple[Length, Length]
    sigma_m: tuple[Deviation, Deviation]
    depth_m: Length = 0.0
    depth_sigma_m: Deviation = 0.0
    crease: bool
    brighter: Literal["left", "right", "any"] = "any"
    rms_px: Annotated[float, Meta(ge=0.0, description="of the edge points about the taught line (px)")] = 0.0
    seen: Annotated[float, Meta(ge=0.0, le=1.0, description="part of its search lines that showed it")] = 1.0
    left: dict[str, float] | None = None
    right: dict[str, float] | None = None
    """In files of earlier versions, the finger's grey level on that side; not used."""


_UNTAUGHT = TaughtEdge(share=(0.0, 1.0), offset_m=(0.0, 0.0), sigma_m=(0.0, 0.0), crease=False)


class TaughtCorner(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where the taught edges meet at the reference and the first image's jaw opening."""

    uv_px: tuple[float, float]
    sigma_px: Annotated[float, Meta(ge=0.0)]


class TaughtModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The contents of a file of ``gripmon teach``."""

    provenance: Provenance
    camera: LensSettings
    gripper: TaughtGripper
    reference: TaughtReference
    edge_settings: EdgeSettings
    edges: Annotated[dict[str, TaughtEdge], Meta(min_length=1)]
    corners: dict[str, TaughtCorner] = {}


class Mismatch(NamedTuple):
    """Why a taught model doesn't fit the configuration."""

    key: str
    wrong: str
    right: str


def gripper_digest(gripper: Gripper, name: str | None = None) -> str:
    """SHA-256 of a gripper file's contents, optionally under another ``name``; comments, order and spelling of numbers
    don't count.
    """
    model = gripper.model if name is None else msgspec.structs.replace(gripper.model, name=name)
    return hashlib.sha256(msgspec.json.encode(contents_of(model), order="sorted")).hexdigest()


def identity(
    camera: Camera, gripper: Gripper, reference_id: str, cam_T_grip: Array
) -> tuple[LensSettings, TaughtGripper, TaughtReference]:
    """Camera, gripper and reference that a taught model is bound to."""
    return (
        camera.settings,
        TaughtGripper(name=gripper.name, sha256=gripper_digest(gripper)),
        TaughtReference(id=reference_id, cam_T_grip=to_record(cam_T_grip)),
    )


def mismatch(
    model: TaughtModel, camera: Camera, gripper: Gripper, cam_T_grip: Array, edge_settings: EdgeSettings
) -> Mismatch | None:
    """The first contradiction between a taught model and the configuration, or within the model; None without any."""
    again = "teach again (gripmon teach), or use what it was taught with"
    taught_kind, kind = (type(lens).__struct_config__.tag for lens in (model.camera, camera.settings))
    if taught_kind != kind:
        return Mismatch("camera.model", f"taught with {taught_kind}, the configuration has {kind}", again)
    for field in camera.settings.__struct_fields__:
        taught, now = getattr(model.camera, field), getattr(camera.settings, field)
        if taught != now:
            return Mismatch(f"camera.{field}", f"taught with {taught}, the configuration has {now}", again)
    if model.gripper.sha256 != gripper_digest(gripper):
        same = " with other contents" if model.gripper.name == gripper.name else ""
        wrong = f"taught with {model.gripper.name}{same}, the configuration has {gripper.name}"
        return Mismatch("gripper", wrong, again)
    taught_T = taught_pose(model)
    if np.abs(taught_T - cam_T_grip).max() > SAME_POSE:
        away_mm = 1e3 * float(np.linalg.norm(taught_T[:3, 3] - cam_T_grip[:3, 3]))
        turned = np.degrees(rotation_angle(taught_T[:3, :3].T @ cam_T_grip[:3, :3]))
        wrong = f"taught at {model.reference.id}, {away_mm:.3f} mm and {turned:.3f}° from the configured reference"
        return Mismatch("reference.cam_T_grip", wrong, again)
    for field in edge_settings.__struct_fields__:
        taught, now = getattr(model.edge_settings, field), getattr(edge_settings, field)
        if taught != now:
            wrong = f"taught with {taught}, the configuration has {now} in monitor.corners.edges"
            return Mismatch(f"edge_settings.{field}", wrong, again)
    for section, known in (("edges", gripper.edge_ids), ("corners", gripper.corner_ids)):
        for name in getattr(model, section):
            if name not in known:
                return Mismatch(f"{section}.{name}", "the gripper has no such", f"one of {', '.join(known)}")
    for name, edge in model.edges.items():
        if not edge.share[1] - edge.share[0] > 1e-3:
            return Mismatch(f"edges.{name}.share", f"is {list(edge.share)}", "two shares, ascending")
    return None


def taught_pose(model: TaughtModel) -> Array:
    """The reference calibration (4, 4) that the model was taught at."""
    return from_record(model.reference.cam_T_grip)


@dataclass(frozen=True, slots=True)
class TaughtEdges:
    """A taught model in arrays over all edges of the gripper.

    ``known`` (e,): the edge was taught; ``crease`` (e,): as a line between two visible faces; ``share`` (e, 2): its
    visible part; ``shift_grip_m`` (e, 2, 3): the line's shift at both ends of the model's edge, gripper frame;
    ``sigma_m`` (e,): its standard deviation across the line of sight; ``depth_grip`` (e, 3): the line of sight when
    taught, across the edge; ``depth_sigma_m`` (e,): the standard deviation along it; ``polarity`` (e,): int8 as in the
    gripper (1: brighter to the right); ``shown`` (e,): part of it that showed.  An edge that isn't known has no shift,
    and is expected to show.  ``usual_m`` (e,): root mean square offset of the taught edges of its kind that were seen,
    which others may have, too.  ``reference_error`` (k, 6): of the reference that they were taught at, which their
    offsets have in them: one standard deviation along each of k directions, m and rad, given both the reference's own
    covariance and what the teaching images show of where the gripper was.
    ``reference_offset`` (6,): how far off that reference the gripper appeared in the teaching images, m and rad; all
    poses are off by as much if the camera moved since the calibration.  ``at_reference``: what a monitor measures of
    these images, and the mount's ``play`` (6,) between them, standard deviations, m and rad; None and zeros where that
    isn't known.
    """

    known: NDArray[np.bool_]
    crease: NDArray[np.bool_]
    share: Array
    shift_grip_m: Array
    sigma_m: Array
    depth_grip: Array
    depth_sigma_m: Array
    polarity: NDArray[np.int8]
    shown: Array
    usual_m: Array
    reference_error: Array
    reference_offset: Array
    at_reference: AtReferenceRecord | None = None
    play: PoseOffset = (0.0,) * 6

    @classmethod
    def of(
        cls,
        edges: Mapping[str, TaughtEdge],
        gripper: Gripper,
        cam_T_grip: Array,
        jaw_opening_m: float | None,
        covariance: Sequence[float] | None = None,
        offset: Sequence[float] = (0.0,) * 6,
        images_covariance: Sequence[float] | None = None,
    ) -> TaughtEdges:
        """Arrays of edges taught at a pose and a jaw opening; ``covariance``: :func:`own_covariance` of the pose; None
        where it is exact, or only differences from it count; ``offset`` (6,): from it to the gripper in the images, of
        which ``images_covariance`` says as above how well they show it, None if not at all.
        """
        listed = [edges.get(name, _UNTAUGHT) for name in gripper.edge_ids]
        points_grip_m = gripper.points_grip_m(jaw_opening_m)
        across, depth = sight_axes(gripper, points_grip_m, cam_T_grip)
        crease = gripper.edge_view(points_grip_m, invert(cam_T_grip)[:3, 3]).crease
        share = np.array([e.share for e in listed])
        offset_m = np.array([e.offset_m for e in listed])
        slope_m = (offset_m[:, 1] - offset_m[:, 0]) / (share[:, 1] - share[:, 0])
        ends_m = offset_m[:, :1] + slope_m[:, None] * (np.array([0.0, 1.0]) - share[:, :1])
        depth_m = np.array([e.depth_m for e in listed])
        return cls(
            np.array([name in edges for name in gripper.edge_ids], dtype=bool),
            np.array([e.crease for e in listed], dtype=bool),
            share,
            ends_m[:, :, None] * across[:, None] + (depth_m[:, None] * depth)[:, None],
            np.sqrt(np.square([e.sigma_m for e in listed]).mean(axis=1)),
            depth,
            np.array([e.depth_sigma_m for e in listed]),
            np.array([POLARITY[e.brighter] for e in listed], dtype=np.int8),
            np.array([e.seen for e in listed]),
            _usual_m(listed, crease),
            np.zeros((0, 6)) if covariance is None else _error(covariance, images_covariance),
            np.array(offset),
        )

    @classmethod
    def of_model(cls, model: TaughtModel, gripper: Gripper, covariance: Sequence[float] | None = None) -> TaughtEdges:
        """Arrays of a file without a :func:`mismatch`, at the mean of its images' jaw openings; ``covariance`` as
        above, of the reference.
        """
        openings = [i.jaw_opening_m for i in model.provenance.images if i.jaw_opening_m is not None]
        opening_m = float(np.mean(openings)) if openings else None
        at, shown = taught_pose(model), model.reference
        edges = cls.of(model.edges, gripper, at, opening_m, covariance, shown.offset, shown.images_covariance)
        return replace(edges, at_reference=shown.seen, play=shown.play)

    @property
    def digest(self) -> str:
        """Digest of the edges' shifts, to the nanometre."""
        places = np.rint(1e9 * self.shift_grip_m).astype("<i8")
        return hashlib.sha256(self.known.tobytes() + places.tobytes()).hexdigest()[:16]

    def shift_at_m(self, edge: NDArray[np.intp], fraction: Array) -> Array:
        """Shift (n, 3), gripper frame, of points on edges (n,) at fractions (n,) between their two ends."""
        shift_m = self.shift_grip_m[edge]
        return shift_m[:, 0] + fraction[:, None] * (shift_m[:, 1] - shift_m[:, 0])

    def spread_m(self, gripper: Gripper, points_grip_m: Array, cam_T_grip: Array) -> Array:
        """(e,) standard deviation of each taught edge's offset seen from a pose, m: that of its depth contributes by as
        much as the line of sight has turned.
        """
        across, _ = sight_axes(gripper, points_grip_m, cam_T_grip)
        return np.hypot(self.sigma_m, np.einsum("ei,ei->e", across, self.depth_grip) * self.depth_sigma_m)


def _usual_m(edges: Sequence[TaughtEdge], crease: NDArray[np.bool_]) -> Array:
    """(e,) root mean square offset of the taught ``edges`` (e,) that were seen, for outlines that of outlines, for
    others, by ``crease`` (e,), that of creases, or of all where there is none of the kind; 0 without any.
    """
    seen = [edge for edge in edges if edge is not _UNTAUGHT and edge.seen > 0.0]
    out = np.zeros(len(edges))
    for kind in (False, True) if seen else ():
        same = [edge.offset_m for edge in seen if edge.crease == kind] or [edge.offset_m for edge in seen]
        out[crease == kind] = np.sqrt(np.mean(np.square(same)))
    return out


def own_covariance(reference: ReferenceRecord, gripper: Gripper) -> tuple[float, ...]:
    """(36,) covariance of what a reference is off by besides the gripper file's errors, row by row.

    Made of the same images as the file, it is off by these errors: a size, along the line of sight, and a tilt, which
    the file states itself.
    """
    if not reference.with_gripper:
        return reference.covariance
    kept = np.eye(6)
    if gripper.model.scale_sigma:
        at_m = np.array(reference.cam_T_grip.translation_m)
        kept[:3, :3] -= np.outer(at_m, at_m) / float(at_m @ at_m)
    if gripper.model.tilt_sigma_rad:
        kept[3:, 3:] = 0.0
    own = kept @ np.reshape(reference.covariance, (6, 6)) @ kept.T
    return tuple(own.ravel().tolist())


def _error(covariance: Sequence[float], images_covariance: Sequence[float] | None) -> Array:
    """(6, 6) one standard deviation along each of six directions of a pose of which two things tell, independently."""
    both = np.reshape(covariance, (6, 6))
    if images_covariance is not None:
        both = both - both @ np.linalg.solve(both + np.reshape(images_covariance, (6, 6)), both)
    variances, directions = np.linalg.eigh(0.5 * (both + both.T))
    return np.asarray(np.sqrt(np.maximum(variances, 0.0))[:, None] * directions.T)


def sight_axes(gripper: Gripper, points_grip_m: Array, cam_T_grip: Array) -> tuple[Array, Array]:
    """Two unit vectors (e, 3) for every edge, gripper frame: off the plane through the camera's centre and the edge, to
    the right of someone who walks along it in the image; and in that plane, across the edge, away from the camera.
    """
    ends = points_grip_m[gripper.edge_points]
    sight = ends[:, 0] - invert(cam_T_grip)[:3, 3]
    along = ends[:, 1] - ends[:, 0]
    across = _cross(sight, along)
    across /= np.sqrt(np.einsum("ei,ei->e", across, across))[:, None]
    depth = _cross(along, across)
    depth /= np.sqrt(np.einsum("ei,ei->e", depth, depth))[:, None]
    return across, depth


def _cross(a: Array, b: Array) -> Array:
    """Cross products of the rows; np.cross would spend most of its time on checks."""
    out = np.empty_like(a)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[:, i] = a[:, j] * b[:, k] - a[:, k] * b[:, j]
    return out
