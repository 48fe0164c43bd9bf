"""``gripmon check CONFIG --sweep``: what would other camera mounts see?"""

from __future__ import annotations

import argparse
import json
import math
import os
from pathlib import Path
from typing import TYPE_CHECKING

from gripmon.cli import common, sweep_table
from gripmon.model.errors import InputError

if TYPE_CHECKING:
    from PIL.Image import Image

    from gripmon.daemon.config import Config
    from gripmon.model.camera import Camera
    from gripmon.teach.mounts import Grid

_MOST_VALUES, _MOST_MOUNTS = 100, 20000
_NEAREST_M, _FARTHEST_M = 0.005, 5.0
_DISTANCES, _TILTS_DEG = (0.6, 1.8, 9), "0:75:6"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the sweep's options to the parser of ``check``."""
    group = parser.add_argument_group(
        "sweep of camera mounts",
        "RANGE is FIRST:LAST:COUNT, or single values with commas; write --roll=-90:90:3 where it begins with a minus. "
        "What isn't given stays as in the configuration, but for distance (0.6 to 1.8 times) and tilt (0 to 75°).",
    )
    group.add_argument(
        "--sweep", action="store_true", help="try other camera mounts, and lenses; the source is left out"
    )
    group.add_argument("--distance", metavar="RANGE", help="from the camera's centre to the TCP (m)")
    group.add_argument(
        "--tilt",
        metavar="RANGE",
        help="of the optical axis against the gripper's z axis (degrees, 0 along the fingers)",
    )
    group.add_argument(
        "--side",
        metavar="RANGE",
        help="where the camera sits about the gripper's z axis (degrees; 0 at -y, 90 at +x)",
    )
    group.add_argument(
        "--roll", metavar="RANGE", help="about the optical axis: how far the picture is turned clockwise (degrees)"
    )
    lens = group.add_mutually_exclusive_group()
    lens.add_argument(
        "--focal", metavar="RANGE", help="focal length, same sensor (px); any but the calibrated one without distortion"
    )
    lens.add_argument("--fov", metavar="RANGE", help="the same by the image's width (degrees)")
    lens.add_argument(
        "--lens",
        metavar="FILE",
        action="append",
        help="a calibrated one, by gripmon calibrate intrinsics; may be repeated",
    )
    group.add_argument(
        "--at",
        metavar="U,V",
        help="where the TCP shows in the present camera's image (px; default: as now)",
    )
    group.add_argument("--jaw", metavar="MIN:MAX", help="openings at which it has to work (m; default: all)")
    group.add_argument("--picture", metavar="FILE", help="draw the sweep (.png, .jpg)")


_OPTIONS = ("distance", "tilt", "side", "roll", "focal", "fov", "lens", "at", "jaw", "picture")


def refuse_without_sweep(arguments: argparse.Namespace) -> None:
    """End the command if an option of the sweep stands alone."""
    for name in _OPTIONS:
        if getattr(arguments, name) is not None:
            raise InputError(f"--{name}: only has a meaning for a sweep; add --sweep")


def run(arguments: argparse.Namespace) -> int:
    """Try the mounts, print the table, draw the picture."""
    config = common.load(arguments.config, check_source=False)
    grid, at_px = _grid(config, arguments)
    travel_m = _travel(config, arguments.jaw)
    picture = None if arguments.picture is None else Path(arguments.picture)
    if picture is not None:
        _check_picture(picture)
    from gripmon.daemon.forecast import rig_of
    from gripmon.daemon.sweeping import as_plain, sweep
    from gripmon.teach.mount_picture import draw_sweep

    with common.progress_bar(len(grid), "mount") as step:
        swept = sweep(config, grid, at_px, travel_m, step)
    print(json.dumps(as_plain(swept), indent=2) if arguments.json else "\n".join(sweep_table.as_text(swept)))
    if picture is not None:
        drawn = draw_sweep(rig_of(config), grid, swept.present, list(swept.trials), config.jaw_opening_m)
        _write(picture, drawn)
        if not arguments.json:
            print(f"picture    {picture}")
    return common.EXIT_DONE


def _check_picture(path: Path) -> None:
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise InputError(f"--picture {path}: is no kind of picture; .png or .jpg")
    if path.is_dir() or not os.access(path.parent, os.W_OK | os.X_OK):
        raise common.not_writable(path, OSError("is a folder" if path.is_dir() else "no such place"), "--picture")


def _write(path: Path, picture: Image) -> None:
    """Whole or not at all."""
    from gripmon.model.atomic import write_atomically
    from gripmon.teach.mount_picture import encoded

    try:
        write_atomically(path, encoded(picture, path.suffix))
    except OSError as error:
        raise common.not_writable(path, error, "--picture") from None


def _grid(config: Config, arguments: argparse.Namespace) -> tuple[Grid, tuple[float, float]]:
    from gripmon.daemon.forecast import rig_of
    from gripmon.teach.mounts import Grid, Mount, towards

    present, rig = Mount.of(config.cam_T_grip), rig_of(config)
    low, high, count = _DISTANCES
    default = f"{low * present.distance_m}:{high * present.distance_m}:{count}"
    distances_m = _values("--distance", _or(arguments.distance, default), _NEAREST_M, _FARTHEST_M, "m")
    tilts = _values("--tilt", _or(arguments.tilt, _TILTS_DEG), 0.0, 180.0, "degrees")
    sides_rad = _turns("--side", arguments.side, present.side_rad)
    rolls_rad = _turns("--roll", arguments.roll, present.roll_rad)
    cameras = _cameras(config.camera, arguments)
    at_px = _spot(config, arguments.at)
    try:
        directions = tuple(towards(camera, _same_place(at_px, config.camera, camera)) for camera in cameras)
    except ValueError as error:
        raise InputError(f"--at: {error}") from None
    grid = Grid(
        distances_m,
        tuple(math.radians(v) for v in tilts),
        sides_rad,
        rolls_rad,
        tuple(rig._replace(camera=camera) for camera in cameras),
        directions,
    )
    if len(grid) > _MOST_MOUNTS:
        raise InputError(f"--sweep: {len(grid)} mounts; at most {_MOST_MOUNTS}, with fewer values on an axis")
    return grid, at_px


def _travel(config: Config, text: str | None) -> tuple[float, float] | None:
    """The part of the jaw's travel that counts; a fault ends the command with exit code 2."""
    gripper = config.gripper
    if text is None:
        return None
    right = f"MIN:MAX in metres, within {gripper.jaw_min_m:g}:{gripper.jaw_max_m:g}"
    if not gripper.jaw_max_m > gripper.jaw_min_m:
        raise InputError("--jaw: the gripper's jaw doesn't move; leave it out")
    try:
        low_m, high_m = (float(part) for part in text.split(":"))
    except ValueError:
        raise InputError(f"--jaw {text}: is no range; {right}") from None
    if not gripper.jaw_min_m <= low_m < high_m <= gripper.jaw_max_m:
        raise InputError(f"--jaw {text}: is not in the jaw's travel; {right}")
    return low_m, high_m


def _or(text: str | None, default: str) -> str:
    return default if text is None else text


def _turns(option: str, text: str | None, present_rad: float) -> tuple[float, ...]:
    if text is None:
        return (present_rad,)
    return tuple(math.radians(v) for v in _values(option, text, -360.0, 360.0, "degrees"))


def _cameras(camera: Camera, arguments: argparse.Namespace) -> list[Camera]:
    from gripmon.teach.mounts import with_focal

    if arguments.lens is not None:
        return [_calibrated(Path(name)) for name in arguments.lens]
    option, text = ("--focal", arguments.focal) if arguments.fov is None else ("--fov", arguments.fov)
    if text is None:
        return [camera]
    if option == "--fov":
        angles = _values(option, text, 1.0, 170.0, "degrees")
        focals_px = [0.5 * camera.width_px / math.tan(0.5 * math.radians(angle)) for angle in angles]
    else:
        focals_px = list(_values(option, text, 1.0, 1e6, "px"))
    try:
        return [with_focal(camera, focal_px) for focal_px in focals_px]
    except ValueError as error:
        raise InputError(f"{option} {text}: {error}") from None


def _calibrated(path: Path) -> Camera:
    """The camera in a file; a fault ends the command with exit code 2."""
    from gripmon.daemon.config import ConfigError
    from gripmon.daemon.config.calibrated import read_camera
    from gripmon.model.camera import make_camera

    try:
        return make_camera(read_camera(path).camera)
    except (ConfigError, ValueError) as error:
        raise InputError(f"--lens {error}") from None


def _same_place(at_px: tuple[float, float], camera: Camera, other: Camera) -> tuple[float, float]:
    """A point of one camera's image in that of another one, which may have more pixels, or fewer."""
    (u, v), across, down = at_px, other.width_px / camera.width_px, other.height_px / camera.height_px
    return (u + 0.5) * across - 0.5, (v + 0.5) * down - 0.5


def _spot(config: Config, text: str | None) -> tuple[float, float]:
    """Where the TCP is to show: as now, or as said."""
    camera = config.camera
    right = f"two numbers inside {camera.width_px} x {camera.height_px} px, such as --at {camera.width_px // 2},"
    right += f"{camera.height_px // 2}"
    if text is None:
        (u, v), where = camera.project(config.cam_T_grip[None, :3, 3])[0].tolist(), "the TCP shows now at"
    else:
        try:
            u, v = (float(part) for part in text.split(","))
        except ValueError:
            raise InputError(f"--at {text}: is no point of the image; {right}") from None
        where = "lies at"
    if not (0.0 <= u <= camera.width_px - 1.0 and 0.0 <= v <= camera.height_px - 1.0):
        raise InputError(f"--at: {where} ({u:.1f}, {v:.1f}) px, outside of the image; {right}")
    return u, v


def _values(option: str, text: str, lowest: float, highest: float, unit: str) -> tuple[float, ...]:
    """The values of a RANGE; a fault ends the command with exit code 2."""
    right = f"FIRST:LAST:COUNT or values with commas, {lowest:g} to {highest:g} {unit}, at most {_MOST_VALUES}"
    try:
        if ":" in text:
            first, last, number = text.split(":")
            low, high, count = float(first), float(last), int(number)
            if not 1 <= count <= _MOST_VALUES or (count == 1 and low != high):
                raise ValueError
            values = [low + (high - low) * k / max(count - 1, 1) for k in range(count)]
        else:
            values = [float(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"{option} {text}: is no range; {right}") from None
    wrong = [v for v in values if not lowest <= v <= highest]
    if wrong or len(values) > _MOST_VALUES:
        what = f"{wrong[0]:g} {unit} is out of bounds" if wrong else f"has {len(values)} values"
        raise InputError(f"{option} {text}: {what}; {right}")
    return tuple(sorted(set(values)))
