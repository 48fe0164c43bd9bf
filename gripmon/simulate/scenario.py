"""What happens in a simulated sequence: settings only, all lengths in metres, times in seconds from the first frame.

A scenario contains no camera, gripper or nominal calibration; the simulator gets those separately.  Grey values are in
DN, the counts 0..255 of the 8-bit image at exposure 1.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

Time = Annotated[float, Meta(ge=0.0, le=1e7, description="time since the first frame (s)")]
Length = Annotated[float, Meta(ge=-0.5, le=0.5, description="(m)")]
Positive = Annotated[float, Meta(gt=0.0, le=0.5, description="(m)")]
Angle = Annotated[float, Meta(ge=-180.0, le=180.0, description="(degrees)")]
Fraction = Annotated[float, Meta(ge=0.0, le=1.0, description="share (0 to 1)")]
Shift = tuple[Length, Length, Length]
_NONE = (0.0, 0.0, 0.0)
_BOX_M, _BAR_M = (0.026, 0.036, 0.04), (0.12, 0.01, 0.01)
_LAMP = (0.4, -0.55, -0.75)


class _Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    pass


class MountMotion(_Settings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A motion of the camera on its bracket at full size; a law scales it over time.

    The camera rotates about ``Scenario.pivot_cam_m`` so that the TCP moves by ``tcp_shift_m`` along the camera's x and
    y axes (z then follows from the arc), rolls about the line pivot-TCP, and shifts.
    """

    tcp_shift_m: Annotated[
        tuple[Length, Length], Meta(description="shift of the TCP along camera x and y by turning about the pivot (m)")
    ] = (0.0, 0.0)
    roll_deg: Annotated[Angle, Meta(description="turn about the line from the pivot to the TCP (degrees)")] = 0.0
    translation_m: Annotated[Shift, Meta(description="shift of the gripper in camera axes without turning (m)")] = _NONE


class Creep(MountMotion, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="kind", tag="creep"):
    """A cable pulls: the motion grows from zero at ``start_s`` to its full size, then stays."""

    start_s: Time = 0.0
    law: Literal["linear", "exponential"] = "exponential"
    time_s: Annotated[
        float, Meta(gt=0.0, le=1e7, description="linear: time to the full motion; exponential: time constant (s)")
    ] = 4.0


class Bump(MountMotion, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="kind", tag="bump"):
    """A collision: a jump at ``at_s`` that rings down to the full motion, ``1 - ring exp(-t/decay) cos(2 pi f t)``."""

    at_s: Time = 1.0
    ring_fraction: Annotated[
        Fraction, Meta(description="first amplitude of the ringing over the whole motion (0 to 1)")
    ] = 0.3
    ring_hz: Annotated[float, Meta(gt=0.0, le=1000.0, description="frequency of the ringing (Hz)")] = 9.0
    ring_decay_s: Annotated[float, Meta(gt=0.0, le=100.0, description="time constant of the ringing (s)")] = 0.12


class Vibration(MountMotion, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="kind", tag="vibration"):
    """``sin(2 pi f (t - start))`` times the motion, from ``start_s`` until ``end_s``."""

    start_s: Time = 0.0
    end_s: Time = 1e7
    frequency_hz: Annotated[float, Meta(gt=0.0, le=1000.0, description="(Hz)")] = 13.0


class Tilt(MountMotion, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="kind", tag="tilt"):
    """Someone loosens the mount and rotates it: a smooth change within ``time_s`` (0: at once)."""

    start_s: Time = 1.0
    time_s: Annotated[float, Meta(ge=0.0, le=1e7, description="how long the change takes (s)")] = 0.5


MountScript = Creep | Bump | Vibration | Tilt


class BentFinger(_Settings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One finger rotates about its root (the centre of its rearmost points) within ``time_s``, which moves its tip."""

    finger: Annotated[str, Meta(description="name in the gripper file")]
    tip_shift_m: Annotated[Shift, Meta(description="shift of the middle of its foremost points, gripper axes (m)")]
    start_s: Time = 1.0
    time_s: Annotated[float, Meta(ge=0.0, le=1e7, description="how long the bending takes (s)")] = 0.0


class JawScript(_Settings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """True jaw opening over time, and the robot's report of it."""

    knots: Annotated[
        tuple[tuple[Time, Positive], ...],
        Meta(description="rows [time (s), opening (m)], times ascending, constant outside; none: nominal opening"),
    ] = ()
    smooth: Annotated[bool, Meta(description="between knots: half a cosine wave (true) or a straight line")] = True
    reported: Annotated[bool, Meta(description="whether the robot reports an opening at all")] = True
    reported_offset_m: Annotated[Length, Meta(description="reported minus true opening (m)")] = 0.0
    reported_noise_m: Annotated[
        float, Meta(ge=0.0, le=0.05, description="standard deviation of what is reported (m)")
    ] = 0.0


class ObjectLook(_Settings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """An object's surface.  Lines along the fingers run along gripper z, those along the tips across it."""

    pattern: Annotated[
        Literal["printed", "plain", "lines_along_fingers", "lines_along_tips", "fold"],
        Meta(description="fold: two greys that meet in a line parallel to the tips"),
    ] = "printed"
    level_dn: Annotated[
        float, Meta(ge=0.0, le=255.0, description="grey value of a face that looks at the lamp (DN)")
    ] = 150.0
    contrast: Annotated[Fraction, Meta(description="of the lines (0 to 1)")] = 0.6
    pitch_m: Annotated[Positive, Meta(description="mean distance of the lines; of the fold from the far side (m)")] = (
        0.006
    )


class GraspedObject(_Settings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A box that arrives between the fingers, is held, and leaves.

    Its far side lies ``depth_m`` beyond the TCP (+z).  The scenario's ``jaw`` has to close to its width.
    """

    size_m: Annotated[tuple[Positive, Positive, Positive], Meta(description="x across the jaws, y, z (m)")] = _BOX_M
    depth_m: Annotated[Length, Meta(description="z of its far side in the gripper frame (m)")] = 0.022
    side_m: Annotated[Length, Meta(description="y of its centre in the gripper frame (m)")] = 0.0
    distance_m: Annotated[Positive, Meta(description="how far away it lies before and after (m)")] = 0.15
    arrive_s: Annotated[tuple[Time, Time], Meta(description="start and end of its approach (s)")] = (1.0, 2.0)
    leave_s: Annotated[tuple[Time, Time], Meta(description="start and end of its retreat (s)")] = (5.0, 6.0)
    look: ObjectLook = ObjectLook()


class Prop(_Settings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Something beside, behind or in front of the fingers with borders parallel to theirs: bar, rim, plate, cable, a
    copy of the fingers, or their mirror image.  It arrives, stays and leaves.
    """

    shape: Annotated[
        Literal["box", "fingers", "mirrored_fingers"],
        Meta(
            description="fingers: copies of them; mirrored: as a mirror across the gripper's z at centre_m shows them"
        ),
    ] = "box"
    size_m: Annotated[
        tuple[Positive, Positive, Positive], Meta(description="of a box: x across the jaws, y, z (m)")
    ] = _BAR_M
    centre_m: Annotated[
        Shift, Meta(description="gripper frame: centre of a box, shift of the copies, place of the mirror (z) (m)")
    ] = (0.0, 0.0, 0.03)
    turn_deg: Annotated[tuple[Angle, Angle, Angle], Meta(description="rotation vector of a box (degrees)")] = _NONE
    look: ObjectLook = ObjectLook(pattern="plain")
    start_s: Time = 0.0
    end_s: Time = 1e7
    move_s: Annotated[float, Meta(ge=0.0, le=1e4, description="time for coming, and for going; 0: at once (s)")] = 0.0
    from_m: Annotated[Shift, Meta(description="where it comes from and goes to, from its place (m)")] = (0.0, 0.0, 0.0)
    sway_m: Annotated[Shift, Meta(description="amplitude of a slow motion about its place (m)")] = (0.0, 0.0, 0.0)
    sway_hz: Annotated[float, Meta(gt=0.0, le=100.0, description="its frequency (Hz)")] = 0.3


class Cover(_Settings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A hand or a sheet between camera and gripper: it moves in, covers the view, and moves out."""

    kind: Literal["hand", "sheet"] = "hand"
    start_s: Time = 2.0
    end_s: Time = 4.0
    move_s: Annotated[float, Meta(gt=0.0, le=1e4, description="time for moving in, and for moving out (s)")] = 0.4
    reach: Annotated[Fraction, Meta(description="share of the view that it passes over (0 to 1)")] = 1.0
    side: Literal["left", "right", "top", "bottom"] = "right"
    distance_m: Annotated[Positive, Meta(description="from the camera, along the optical axis (m)")] = 0.05


class Background(_Settings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table below the gripper with things on it; the robot moves over it, while the gripper is fixed in the image."""

    kind: Literal["plain", "chequer", "printed", "stripes", "speckle", "blobs", "discs"] = "blobs"
    distance_m: Annotated[
        float, Meta(ge=0.0, le=5.0, description="from the TCP to the table along gripper z; 0: they touch (m)")
    ] = 0.16
    level_dn: Annotated[float, Meta(ge=0.0, le=255.0, description="mean grey value of the table (DN)")] = 130.0
    contrast: Annotated[Fraction, Meta(description="of the table's pattern (0 to 1)")] = 0.6
    boxes: Annotated[
        int, Meta(ge=0, le=200, description="things that stand on the table, per square metre times 0.6")
    ] = 26
    cables: Annotated[int, Meta(ge=0, le=100, description="cables and bars that lie on the table (number)")] = 6
    motion: Literal["still", "wander", "linear", "stop_and_go"] = "wander"
    speed_m_per_s: Annotated[float, Meta(ge=0.0, le=10.0, description="typical speed over the table (m/s)")] = 0.06
    defocus_px: Annotated[
        float, Meta(ge=0.0, le=20.0, description="extra blur of the background, it lies farther away (px)")
    ] = 0.5


class FingerMark(_Settings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A lighter or darker area on the long faces of the fingers: pad, step, slot, screw, another tone.

    Its borders are parallel to the fingers' edges.  ``whole``: all faces of a finger, bevels too; only ``gain`` counts.
    """

    shape: Literal["rectangle", "disc", "whole"] = "rectangle"
    from_tip_m: Annotated[
        tuple[Length, Length], Meta(description="where it begins and ends, from the tip backwards (m)")
    ] = (0.003, 0.012)
    across: Annotated[
        tuple[float, float],
        Meta(description="where it begins and ends across the face, over its half width (-1 to 1); a disc: its centre"),
    ] = (-0.7, 0.7)
    gain: Annotated[float, Meta(ge=0.0, le=10.0, description="its brightness over the face's (no unit)")] = 0.5
    finger: Annotated[str, Meta(description="name in the gripper file; empty: all fingers")] = ""


class FingerShape(_Settings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How the true fingers differ from their model: facets that round the tip's edges, a worn tip."""

    tip_bevel_m: Annotated[float, Meta(ge=0.0, le=0.005, description="width of facets on the tip's edges (m)")] = 0.0
    wear_m: Annotated[float, Meta(ge=0.0, le=0.005, description="by which the tip is shorter (m)")] = 0.0
    worn_finger: Annotated[str, Meta(description="name in the gripper file; empty: all fingers")] = ""


class LampChange(_Settings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The lamp moves: from ``at_s`` on, within ``time_s``, the light comes from another side."""

    at_s: Time
    lamp_cam: Annotated[
        tuple[float, float, float], Meta(description="direction to the lamp then, camera axes (no unit)")
    ]
    time_s: Annotated[float, Meta(ge=0.0, le=1e7, description="how long it takes; 0: at once (s)")] = 0.0


class FingerLook(_Settings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Metal fingers: one shade per face from the lamp's direction, times a brushed texture fixed to the face."""

    level_dn: Annotated[
        float, Meta(ge=0.0, le=255.0, description="grey value of a face that looks at the lamp (DN)")
    ] = 100.0
    ambient: Annotated[Fraction, Meta(description="share of the light without direction (0 to 1)")] = 0.35
    lamp_cam: Annotated[
        tuple[float, float, float], Meta(description="direction to the lamp, camera axes (no unit)")
    ] = _LAMP
    lamp_changes: Annotated[
        tuple[LampChange, ...], Meta(description="of all bodies, in the order of their times; with ambient light only")
    ] = ()
    texture: Annotated[
        Fraction, Meta(description="strength of the brushed texture and scratches (0 to 1; 0: even faces)")
    ] = 0.12
    bevel_gain: Annotated[float, Meta(ge=0.0, le=5.0, description="brightness of bevels over that of their faces")] = (
        1.35
    )
    highlights: Annotated[
        float,
        Meta(
            ge=0.0, le=20.0, description="glossy fingers: brightness of a streak across each face over the face's shade"
        ),
    ] = 0.0
    carriers: Annotated[bool, Meta(description="draw the bodies that carry the fingers")] = True
    marks: tuple[FingerMark, ...] = ()
    shape: FingerShape = FingerShape()


class LightStep(_Settings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """From ``at_s`` on the light is ``factor`` times its previous value."""

    at_s: Time
    factor: Annotated[float, Meta(gt=0.0, le=20.0, description="(no unit)")]


class Shadow(_Settings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A soft shadow that sweeps over the whole view between ``start_s`` and ``end_s``."""

    start_s: Time = 1.0
    end_s: Time = 3.0
    depth: Annotated[Fraction, Meta(description="share of the light that it takes (0 to 1)")] = 0.5
    width: Annotated[float, Meta(gt=0.0, le=5.0, description="over the image's width (no unit)")] = 0.5
    softness: Annotated[float, Meta(gt=0.0, le=2.0, description="half width of its border over the image's width")] = (
        0.05
    )
    angle_deg: Angle = 20.0
    still_at: Annotated[
        Fraction | None, Meta(description="share of its way at which it stands still; null: it sweeps (0 to 1)")
    ] = None


class Light(_Settings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Brightness over time: steps, mains flicker, and an automatic exposure that pulls the product back to 1."""

    exposure: Annotated[float, Meta(gt=0.0, le=20.0, description="factor on all grey values (no unit)")] = 1.0
    flicker: Annotated[Fraction, Meta(description="amplitude of the lamps' flicker (0 to 1)")] = 0.0
    flicker_hz: Annotated[float, Meta(gt=0.0, le=1000.0, description="its frequency (Hz)")] = 100.0
    steps: tuple[LightStep, ...] = ()
    auto_exposure_s: Annotated[
        float, Meta(ge=0.0, le=1000.0, description="time constant of the automatic exposure; 0: none (s)")
    ] = 0.0
    shadows: tuple[Shadow, ...] = ()


class Defocus(_Settings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The lens is out of focus between ``start_s`` and ``end_s``: a Gaussian blur is added to the whole image."""

    sigma_px: Annotated[float, Meta(ge=0.0, le=10.0, description="standard deviation of the added blur (px)")] = 1.5
    start_s: Time = 0.0
    end_s: Time = 1e7
    ramp_s: Annotated[float, Meta(ge=0.0, le=1e4, description="time to reach it, and to lose it (s)")] = 0.0


class Sensor(_Settings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """From light to counts: variance of a pixel = read noise² + shot noise * grey value."""

    psf_sigma_px: Annotated[float, Meta(ge=0.3, le=1.0, description="Gaussian blur of the focused lens (px)")] = 0.6
    read_noise_dn: Annotated[float, Meta(ge=0.0, le=50.0, description="standard deviation in the dark (DN)")] = 0.8
    shot_noise_dn: Annotated[float, Meta(ge=0.0, le=5.0, description="variance per grey value (DN²/DN)")] = 0.012
    vignetting: Annotated[Fraction, Meta(description="loss of light in the image's corner (0 to 1)")] = 0.12
    exposure_time_s: Annotated[float, Meta(ge=0.0, le=1.0, description="what moves within it is smeared (s)")] = 0.004
    response: Annotated[
        Literal["linear", "srgb"],
        Meta(description="grey levels over light; srgb: of colour cameras (IEC 61966-2-1)"),
    ] = "linear"
    jpeg_quality: Annotated[int, Meta(ge=0, le=100, description="0: no compression")] = 0


class Pairs(_Settings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Image pairs before (even frame) and after (odd frame) a disturbance, each pair with a new calibration.

    The TCP shift of a pair is normal about ``tcp_shift_m``; calibrations scatter about the nominal one.  Frames come at
    ``Scenario.fps`` as always: 0.1 for ten seconds between them.
    """

    tcp_shift_m: tuple[Length, Length]
    tcp_shift_sigma_m: Annotated[float, Meta(ge=0.0, le=0.05, description="along each axis of the shift (m)")] = 2e-4


class Scenario(_Settings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A simulated sequence, except for camera, gripper, nominal calibration and seed."""

    name: str = "static"
    duration_s: Annotated[float, Meta(gt=0.0, le=1e7, description="length of the sequence (s)")] = 10.0
    fps: Annotated[float, Meta(gt=0.0, le=1000.0, description="frames a second (1/s)")] = 30.0
    start_ns: Annotated[int, Meta(ge=0, description="capture time of the first frame, Unix (ns)")] = (
        1_700_000_000_000_000_000
    )
    pivot_cam_m: Annotated[
        Shift, Meta(description="where the camera turns on its bracket, in the nominal camera frame (m)")
    ] = (0.0, 0.02, -0.006)
    mount: tuple[MountScript, ...] = ()
    bent_fingers: tuple[BentFinger, ...] = ()
    pairs: Pairs | None = None
    jaw: JawScript = JawScript()
    grasped: GraspedObject | None = None
    props: tuple[Prop, ...] = ()
    covers: tuple[Cover, ...] = ()
    background: Background = Background()
    fingers: FingerLook = FingerLook()
    light: Light = Light()
    defocus: tuple[Defocus, ...] = ()
    sensor: Sensor = Sensor()
