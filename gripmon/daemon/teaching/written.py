"""The configuration that teaching writes: complete, with a comment at every key, from the settings' own descriptions.

Written line by line: a YAML library that keeps comments (ruamel.yaml) would be one more dependency, and can't write
defaults as commented-out lines.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import NormalDist

import msgspec

from gripmon import __version__
from gripmon.daemon.config import Config, Settings, load_config
from gripmon.daemon.config.yaml_file import lines_of
from gripmon.daemon.teaching.inputs import Inputs
from gripmon.io.sources import FolderSettings, SourceError
from gripmon.io.sources.files import opening_beside
from gripmon.model.atomic import write_atomically
from gripmon.model.errors import InputError
from gripmon.model.gripper import SIZE_UNKNOWN, Gripper
from gripmon.model.records import ReferenceRecord, ValidBy
from gripmon.model.yaml_text import yaml_value
from gripmon.monitor import MonitorSettings
from gripmon.teach.corner_pose import CornerPose
from gripmon.teach.messages import SaveOrder
from gripmon.teach.session import Evaluation

_UNITS = """\
# Lengths in metres, angles in radians, times in seconds, image coordinates in pixels (the first one's centre: 0, 0)."""
_JAW_SOURCES = "the opening below; zenoh: the robot puts it on gripmon/<robot>/<camera_name>/jaw; or frames"
_DEFAULT_SECTIONS = ("monitor", "publish", "ros2", "recording", "metrics", "daemon", "state")


def config_text(
    inputs: Inputs, order: SaveOrder, found: Evaluation, taught: str | None, folder: Callable[[Path], str]
) -> str:
    """The whole file; ``folder`` makes a path relative to it; ``taught``: name of the taught model (None: none)."""
    source = inputs.source
    assert source is not None and found.reference is not None
    parts = [
        f"# Written by: {inputs.command} (gripmon {__version__})",
        _UNITS,
        f"robot: {yaml_value(order.robot)}  # name of the robot in the Zenoh keys gripmon/<robot>/<camera_name>/…",
        f"camera_name: {yaml_value(order.camera_name)}  # name of the camera in the Zenoh keys",
        "",
        *_camera(inputs, folder),
        "",
        f"gripper: {yaml_value(folder(inputs.gripper_path))}  # path of the gripper file, relative to this file",
    ]
    if taught is not None:
        parts.append(f"taught: {yaml_value(taught)}  # what its edges really look like; relative to this file")
    if "reference" in inputs.calibrations:
        there = yaml_value(folder(inputs.calibrations["reference"]))
        parts += ["", f"reference: {there}  # file of gripmon calibrate plane, relative to this file; or a section"]
    else:
        parts += ["", _reference(found.reference, found.pose)]
    parts += ["", "source:"]
    if isinstance(source, FolderSettings):
        place = yaml_value(folder(Path(source.path)))
        parts += ["  kind: folder  # images in a folder", f"  path: {place}  # relative to this file"]
    else:
        parts.append(lines_of(source, 2))
    if inputs.setup.gripper.has_jaw:
        parts += ["", _jaw(inputs, found.snapped.jaw_opening_m, order.put.jaw_opening_m is not None)]
    parts += ["", _defaults(inputs.setup.settings, inputs.setup.gripper)]
    return "\n".join(parts) + "\n"


def _camera(inputs: Inputs, folder: Callable[[Path], str]) -> list[str]:
    if "camera" in inputs.calibrations:
        there = yaml_value(folder(inputs.calibrations["camera"]))
        return [f"camera: {there}  # file of gripmon calibrate intrinsics, relative to this file; or a section"]
    return ["camera:", lines_of(inputs.setup.camera.settings, 2)]


def with_taught(path: Path, taught: str) -> str:
    """A configuration's text with an additional line that names the taught model."""
    text = path.read_text(encoding="utf-8-sig")
    return (
        f"{text.rstrip()}\n\ntaught: {yaml_value(taught)}  # what the edges really look like; relative to this file\n"
    )


def name_taught(config: Config, taught: Path) -> Config:
    """Add the line that names a taught model to a configuration, unless there is one; returns the new configuration.

    Raises :class:`~gripmon.model.errors.InputError` where it can't be written.
    """
    if config.taught_path is None:
        name = Path(os.path.relpath(taught.resolve(), config.directory.resolve())).as_posix()
        try:
            write_atomically(config.path, with_taught(config.path, name).encode())
        except OSError as error:
            raise InputError(f"{config.path}: can't be written ({error.strerror or error}); a file") from None
    return load_config(config.path, check_source=False)


def _reference(reference: ReferenceRecord, measured_here: CornerPose | None) -> str:
    transform, covariance = reference.cam_T_grip, list(reference.covariance)
    meaning = "  # maps gripper coordinates to camera coordinates: x right, y down, z forward"
    lines = ["reference:"]
    if measured_here is not None:
        seen = f"{len(measured_here.corners)} corners of" if measured_here.corners else "the edges in"
        lines.append(f"  # measured from {seen} one image; a plate (gripmon calibrate plane) is more accurate")
    lines += [
        f"  id: {yaml_value(reference.reference_id)}  # name of this calibration in messages",
        f"  cam_T_grip:{meaning}",
        f"    translation_m: {yaml_value(list(transform.translation_m))}  # the TCP in the camera frame: x, y, z (m)",
        f"    rotation_xyzw: {yaml_value(list(transform.rotation_xyzw))}  # unit quaternion x, y, z, w (no unit)",
        "  covariance:  # of its error, 6x6 row by row: TCP's position (m²), then rotation (rad²), camera axes",
        "    [",
        *(f"      {', '.join(yaml_value(v) for v in covariance[6 * row : 6 * row + 6])}," for row in range(6)),
        "    ]",
    ]
    if reference.with_gripper:
        lines.append("  with_gripper: true  # made of the images of the gripper file: an error of both counts once")
    return "\n".join(lines)


_FROM_ELSEWHERE = {
    "frames": "the opening comes with each image (timestamps.csv)",
    "zenoh": "the robot puts it on gripmon/<robot>/<camera_name>/jaw",
}


def _jaw(inputs: Inputs, opening_m: float | None, known: bool) -> str:
    if inputs.jaw_source in _FROM_ELSEWHERE:
        return f"jaw:\n  source: {inputs.jaw_source}  # {_FROM_ELSEWHERE[inputs.jaw_source]}"
    openings = [picture.jaw_opening_m for picture in inputs.pictures]
    if inputs.jaw_source is None and openings and None not in openings and _in_table(inputs):
        return f"jaw:\n  source: frames  # {_FROM_ELSEWHERE['frames']}"
    lines = [
        "jaw:",
        f"  source: fixed  # {_JAW_SOURCES}",
    ]
    if opening_m is not None:
        how = "as given" if known else "as measured in the image; the robot's own value is better"
        lines.append(f"  opening_m: {yaml_value(round(opening_m, 7))}  # jaw opening, {how} (m)")
    return "\n".join(lines)


def _in_table(inputs: Inputs) -> bool:
    """Whether the images' own table has their openings; an opening given for all of them is fixed."""
    try:
        return all(p.path is not None and opening_beside(Path(p.path)) == p.jaw_opening_m for p in inputs.pictures)
    except SourceError:
        return False


def _defaults(monitor: MonitorSettings, gripper: Gripper) -> str:
    """The defaults, commented out but for the response of the camera as it was found, and for what a transform of a
    gripper of unknown size or tilt is valid by: its motion since the reference.
    """
    model, policy = gripper.model, monitor.policy
    tilt_rad = NormalDist().inv_cdf(1.0 - policy.integrity_risk / 4.0) * model.tilt_sigma_rad  # its part of a bound
    absolute = model.scale_sigma < SIZE_UNKNOWN and tilt_rad < policy.alert_limit_rad
    if not absolute:
        policy = msgspec.structs.replace(policy, valid_by=ValidBy.REFERENCE)
        monitor = msgspec.structs.replace(monitor, policy=policy)
    lines = [
        "# Everything below holds as it stands; to change a value, take away the # before it and before what it is in."
    ]
    for field in msgspec.structs.fields(Settings):
        if field.name in _DEFAULT_SECTIONS:
            value = monitor if field.name == "monitor" else field.default
            section = [f"# {field.name}:", *lines_of(value, 2, off=True).splitlines()]
            if value is monitor:
                section = _on(section, "corners", "edges", "response")
                section = section if absolute else _on(section, "policy", "valid_by")
            lines += section
    return "\n".join(lines)


def _on(section: Sequence[str], *keys: str) -> list[str]:
    """A section that is commented out with the key at this path taken back in."""
    out, level = list(section), 0
    for number, line in enumerate(section):
        if line.removeprefix("# ").startswith(f"{'  ' * level}{('monitor', *keys)[level]}:"):
            out[number], level = line.removeprefix("# "), level + 1
            if level > len(keys):
                break
    return out
