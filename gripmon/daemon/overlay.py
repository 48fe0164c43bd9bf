"""A monitor's frame as a picture for people: the image with its measurements."""

from __future__ import annotations

from gripmon.io.sources.payload import PayloadError, snapshot_image
from gripmon.model.camera import Camera
from gripmon.model.canvas import Canvas, Colour
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, FrameRecord, Image, Outlines, Snapshot
from gripmon.teach.snapping import outlines_px

_POINTS = 17  # per edge, which the lens bends
_OUTLINE: dict[str, Colour] = {"valid": (120, 220, 60), "suspect": (60, 190, 255)}
_LOST: Colour = (80, 80, 255)
_REFERENCE: Colour = (255, 255, 255)
_CORNER, _REFUSED = (40, 220, 250), (80, 80, 255)
_RING_PX = 5.0
_QUALITY = 85  # of JPEG, percent


def outlines_of(camera: Camera, gripper: Gripper, cam_T_grip: Array | None, jaw_opening_m: float | None) -> Outlines:
    """The gripper's visible edges, px; none without a transform."""
    if cam_T_grip is None:
        return ()
    opening_m = jaw_opening_m if gripper.has_jaw else None
    lines = outlines_px(camera, gripper, cam_T_grip, opening_m, _POINTS).values()
    return tuple(tuple((round(float(u), 2), round(float(v), 2)) for u, v in line) for line in lines)


def picture_of(
    snapshot: Snapshot, data: bytes | None, width_px: int, reference_px: Outlines | None = None
) -> bytes:
    """:func:`overlay` of a monitor's snapshot, whose image is ``data``.  Raises ValueError, which says why there is no
    picture.
    """
    if not data or snapshot.image is None:
        raise ValueError("its newest frame has no image")
    try:
        image = snapshot_image(data, snapshot.image)
    except PayloadError as error:
        raise ValueError(f"its image: {error}") from None
    return overlay(image, snapshot.record, snapshot.outlines_px, width_px, reference_px)


def overlay(
    image: Image, record: FrameRecord, outlines: Outlines, width_px: int, reference_px: Outlines | None = None
) -> bytes:
    """JPEG ``width_px`` wide: the outlines, green if the transform is valid, orange if suspect, and the corners, yellow
    if they were used, red if not; ``reference_px``: instead of these, white, where the edges are to be.
    """
    canvas = Canvas(image, width_px / image.shape[1])
    for line_px in outlines:
        canvas.line(line_px, _OUTLINE.get(record.verdict.value, _LOST), 2)
    for line_px in reference_px or ():
        canvas.line(line_px, _REFERENCE)
    for corner in record.corners if reference_px is None else ():
        if corner.uv_px is not None:
            canvas.circle(corner.uv_px, _RING_PX, _CORNER if corner.used else _REFUSED, 2)
    return canvas.jpeg(_QUALITY)
