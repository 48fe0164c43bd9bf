"""``gripmon check``: is this configuration sound, and what does it expect to see?"""

from __future__ import annotations

import argparse
import json
import math
from typing import TYPE_CHECKING, Any

from gripmon.cli import (
    check_laser,
    common,
    expected,
    findings,
    margins,
    outside,
    promising,
    second_check,
    second_run,
    sweep,
)

if TYPE_CHECKING:
    from gripmon.daemon.config import Config
    from gripmon.daemon.config.checks import View

_DESCRIPTION = """\
Validate a configuration, its gripper file and its source, and say of each thing that matters whether
it is in order: OK, WARN (the monitor runs, but not all that is expected of it will come) or FAIL (it
can't do its work).

With --verbose, also what the calibration expects to see: where the fingertip corners are in the image
(px), which of them and which edges are visible, how far away the gripper is (mm), how exact one frame
will be along each axis, what the view can't separate (an unknown jaw opening and the distance), whether
its corners suffice to recalibrate, how far camera and jaws may move until too little is in view.  Of a
second camera (a configuration with a section laser): its calibration, what is known of its errors, and
what fresh spots would show.

With --laser, in place of a configuration: does a laser calibration still hold?  Which motions of
camera, plane and laser pointer fresh spots would tell, or do tell.

With --sweep: what other camera mounts and lenses would see, as a table and a picture, before
anyone drills a hole."""

_EXAMPLES = """\
  gripmon check configs/live_camera.yaml
  gripmon check configs/demo.yaml --verbose
  gripmon check configs/demo.yaml --json | python3 -m json.tool
  gripmon check configs/folder.yaml --sweep --distance 0.08:0.2:7 --tilt 10:60:6 --picture sweep.png
  gripmon check configs/folder.yaml --sweep --fov 40,60,80 --roll 0,90 --at 384,288
  gripmon check --laser laser.yaml
  gripmon check --laser laser.yaml fresh_spots.csv --arm-noise 0.0002:0.0004

exit codes: 0 sound, perhaps with warnings; 2 a fault in the configuration, in a file of Zenoh's that it
names, or a package that it needs is missing (one line says file, key, what is wrong, what would be
right); 3 a line says FAIL, such as a camera that can't be reached now; or something has moved since a
laser calibration, or its spots don't tell"""


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = common.add_command(
        commands, "check", run, "validate a configuration and show what it expects to see", _DESCRIPTION, _EXAMPLES
    )
    parser.add_argument(
        "config", nargs="*", metavar="CONFIG", help="configuration file (YAML); with --laser: tables of fresh spots"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object instead of text; metres, radians, px")
    parser.add_argument("--verbose", action="store_true", help="what the calibration expects to see, in numbers")
    sweep.add_options(parser)
    check_laser.add_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon check``."""
    if arguments.laser is not None:
        if arguments.sweep:
            raise common.CommandFailedError("--sweep: not with --laser; one of them", common.EXIT_USAGE)
        sweep.refuse_without_sweep(arguments)
        return check_laser.run(arguments)
    check_laser.refuse_without_laser(arguments)
    if len(arguments.config) != 1:
        raise common.CommandFailedError(
            f"check: {len(arguments.config)} configurations; one, or --laser LASER.yaml", common.EXIT_USAGE
        )
    arguments.config = arguments.config[0]
    if arguments.sweep:
        return sweep.run(arguments)
    sweep.refuse_without_sweep(arguments)
    second = second_run.load(arguments.config)
    if second is not None:
        return second_check.run(second, as_json=arguments.json, verbose=arguments.verbose)
    config = common.load(arguments.config)
    report = {**expectation(config), "zenoh": outside.zenoh_values(config), "source": outside.source_report(config)}
    found = findings.of_wrist(report)
    if arguments.json:
        print(json.dumps({"findings": findings.plain(found), **report}, indent=2))
    else:
        lines = findings.lines(report["config"], found)
        print("\n".join([*lines, "", *_details(report)] if arguments.verbose else lines))
    return findings.exit_code(found)


def expectation(config: Config) -> dict[str, Any]:
    """What the calibration expects to see, as plain values for JSON: metres, radians, px."""
    settings, gripper, view = config.settings, config.gripper, config.view()
    return {
        "config": str(config.path),
        "robot": settings.robot,
        "camera_name": settings.camera_name,
        "camera": _camera_values(config),
        "gripper": {
            "file": str(config.gripper_path),
            "name": gripper.name,
            "corners": len(gripper.corner_ids),
            "edges": len(gripper.edge_ids),
            "faces": len(gripper.faces),
            "notes": list(gripper.notes),
            "jaw_m": [gripper.jaw_min_m, gripper.jaw_max_m] if gripper.has_jaw else None,
        },
        "reference": _reference_values(config),
        "taught": _taught_values(config),
        "jaw": {
            "source": settings.jaw.source,
            "opening_m": config.jaw_opening_m,
            "nominal": settings.jaw.opening_m is None,
        },
        "corners": _corner_values(gripper.corner_ids, view),
        "edges": [
            {"id": name, "visible": bool(seen)} for name, seen in zip(gripper.edge_ids, view.edges_visible, strict=True)
        ],
        "accuracy": expected.accuracy(config),
        **promising.values(config),
        "in_view": margins.in_view(config),
        **outside.values(config),
    }


def _camera_values(config: Config) -> dict[str, Any]:
    camera = config.camera
    return {
        "model": type(config.settings.camera).__struct_config__.tag,
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "fx_px": camera.fx_px,
        "fy_px": camera.fy_px,
        "field_of_view_rad": [
            2.0 * math.atan(0.5 * camera.width_px / camera.fx_px),
            2.0 * math.atan(0.5 * camera.height_px / camera.fy_px),
        ],
    }


def _reference_values(config: Config) -> dict[str, Any]:
    import numpy as np

    from gripmon.model.geometry import invert, rotation_angle
    from gripmon.teach.forecast import Mount

    reference, cam_T_grip = config.reference, config.cam_T_grip
    return {
        "id": reference.reference_id,
        "translation_m": list(reference.cam_T_grip.translation_m),
        "rotation_xyzw": list(reference.cam_T_grip.rotation_xyzw),
        "distance_m": float(np.linalg.norm(cam_T_grip[:3, 3])),
        "turn_rad": rotation_angle(cam_T_grip[:3, :3]),
        "metres_per_px": float(cam_T_grip[2, 3]) / config.camera.fx_px,
        "tilt_rad": Mount.of(cam_T_grip).tilt_rad,
        "camera_ahead_m": float(invert(cam_T_grip)[2, 3]),
        "sound_as_wxyz": _sound_as_wxyz(config),
    }


def _sound_as_wxyz(config: Config) -> bool:
    """Whether the reference's quaternion, read in the order w, x, y, z, puts the camera behind the fingertips and in
    view of them.
    """
    from gripmon.model.geometry import invert, make_transform, rotation_from_xyzw
    from gripmon.teach.forecast import see

    w, x, y, z = config.reference.cam_T_grip.rotation_xyzw
    cam_T_grip = make_transform(rotation_from_xyzw((x, y, z, w)), config.cam_T_grip[:3, 3])
    behind = float(invert(cam_T_grip)[2, 3]) < 0.0
    return behind and see(margins.rig_of(config), cam_T_grip, config.jaw_opening_m).enough


def _taught_values(config: Config) -> dict[str, Any] | None:
    """What was taught; the largest offset is that of the edge that lies farthest from the sharp model."""
    taught = config.taught
    if taught is None:
        return None
    farthest = max(taught.edges, key=lambda name: max(map(abs, taught.edges[name].offset_m)))
    offset_m = max(taught.edges[farthest].offset_m, key=abs)
    return {
        "file": str(config.taught_path),
        "time": taught.provenance.time,
        "images": len(taught.provenance.images),
        "edges": list(taught.edges),
        "largest": {
            "edge": farthest,
            "offset_m": offset_m,
            "offset_px": offset_m * config.camera.fx_px / float(config.cam_T_grip[2, 3]),
        },
    }


def _corner_values(names: tuple[str, ...], view: View) -> list[dict[str, Any]]:
    import numpy as np

    return [
        {
            "id": name,
            "uv_px": uv.round(2).tolist() if np.isfinite(uv).all() else None,
            "distance_m": round(float(np.linalg.norm(point)), 6),
            "visible": bool(visible),
            "reason": None if visible else "outside" if not inside else "self_hidden",
        }
        for name, uv, point, visible, inside in zip(
            names, view.corners_px, view.corners_cam_m, view.visible, view.in_image, strict=True
        )
    ]


def _details(report: dict[str, Any]) -> list[str]:
    edges = [edge["id"] for edge in report["edges"] if edge["visible"]]
    seen = sum(corner["visible"] for corner in report["corners"])
    sections = {
        "camera": _camera_line(report["camera"]),
        "gripper": _gripper_line(report["gripper"], report["jaw"]),
        "reference": _reference_line(report["reference"]),
        "taught": _taught_line(report["taught"], edges),
        "edges": f"{len(edges)} of {len(report['edges'])} visible: {', '.join(edges)}",
        "corners": f"{seen} of {len(report['corners'])} visible:",
    }
    lines = [f"{name:<10} {text}" for name, text in sections.items()]
    if not report["gripper"]["faces"]:
        # Before the corners, whose list follows.
        lines.insert(-1, " " * 11 + "the gripper file has no faces: what the finger itself hides isn't known")
    lines[2:2] = [" " * 11 + note for note in report["gripper"]["notes"]]
    width = max(len(corner["id"]) for corner in report["corners"])
    lines += [_corner_line(corner, width) for corner in report["corners"]]
    lines += expected.accuracy_lines(report["accuracy"])
    lines.append(f"promise    {report['promise']}")
    lines += margins.in_view_lines(report["in_view"])
    return lines + outside.lines(report)


def _camera_line(camera: dict[str, Any]) -> str:
    across, down = (math.degrees(angle) for angle in camera["field_of_view_rad"])
    size = f"{camera['width_px']} x {camera['height_px']} px, f = {camera['fx_px']:g}, {camera['fy_px']:g} px"
    return f"{size}, lens {camera['model']}, sees about {across:.0f}° x {down:.0f}°"


def _gripper_line(gripper: dict[str, Any], jaw: dict[str, Any]) -> str:
    name = f"{gripper['name']} ({gripper['file']})"
    if gripper["jaw_m"] is None:
        return f"{name}: no jaw"
    low_mm, high_mm = (1e3 * v for v in gripper["jaw_m"])
    opening = f"{1e3 * jaw['opening_m']:.1f} mm"
    if jaw["source"] == "fixed":
        return f"{name}: jaw {low_mm:g} to {high_mm:g} mm, fixed at {opening}{', the nominal one' * jaw['nominal']}"
    return f"{name}: jaw {low_mm:g} to {high_mm:g} mm, opening from {jaw['source']}; the following at {opening}"


def _reference_line(reference: dict[str, Any]) -> str:
    x, y, z = (1e3 * v for v in reference["translation_m"])
    place = f"{reference['id']}: TCP at ({x:.1f}, {y:.1f}, {z:.1f}) mm in the camera frame"
    turn = f"{math.degrees(reference['turn_rad']):.1f}° between camera and gripper"
    return f"{place}, {turn}, 1 px is {1e3 * reference['metres_per_px']:.3f} mm at the TCP"


def _taught_line(taught: dict[str, Any] | None, visible: list[str]) -> str:
    if taught is None:
        return "nothing; `gripmon teach` takes out what bevels, rounded edges and shading shift the edges by"
    largest, images = taught["largest"], "1 image" if taught["images"] == 1 else f"{taught['images']} images"
    count = f"{len(taught['edges'])} edges from {images} ({taught['file']}, {taught['time']})"
    farthest = f"farthest off {largest['edge']}, {1e6 * largest['offset_m']:+.0f} µm ({largest['offset_px']:+.2f} px)"
    missing = [name for name in visible if name not in taught["edges"]]
    return f"{count}; {farthest}" + (f"; visible, but not taught: {', '.join(missing)}" if missing else "")


def _corner_line(corner: dict[str, Any], width: int) -> str:
    reason = {None: "", "outside": "outside of the image", "self_hidden": "hidden by its own finger"}[corner["reason"]]
    place = "       —       " if corner["uv_px"] is None else "({:6.1f}, {:6.1f})".format(*corner["uv_px"])
    return f"           {corner['id']:<{width}} {place} px  {1e3 * corner['distance_m']:6.1f} mm  {reason}".rstrip()
