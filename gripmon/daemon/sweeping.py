"""What other camera mounts and lenses would see of a configuration's gripper."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec

from gripmon.daemon.config import Config
from gripmon.daemon.config.calibrated import read_camera
from gripmon.daemon.forecast import rig_once_taught
from gripmon.model.camera import Camera, make_camera
from gripmon.model.errors import InputError
from gripmon.model.progress import Progress, quiet
from gripmon.teach.mounts import Mount, Trial, towards, try_mount, with_focal

_MOST_MOUNTS, _MOST_VALUES = 20000, 100
_BOUNDS = {
    "distance": (0.005, 5.0, "m"), "tilt": (0.0, 180.0, "degrees"), "side": (-360.0, 360.0, "degrees"),
    "roll": (-360.0, 360.0, "degrees"), "focal": (1.0, 1e6, "px"), "fov": (1.0, 170.0, "degrees"),
}  # fmt: skip
_DISTANCES, _TILTS_DEG = (0.6, 1.8, 9), (0.0, 75.0, 6)  # first, last, count: multiples of the present distance, degrees


class Sweep(msgspec.Struct, frozen=True):
    """The evaluated mounts, the best first, and the present one, in metres, radians and px; ``tcp_at_px``: position of
    the TCP in the present camera's image, in others correspondingly.
    """

    config: str
    tcp_at_px: tuple[float, float]
    jaw_opening_m: float | None
    warn_m: float
    limit_m: float
    alert_limit_m: float
    alert_limit_rad: float
    present: Trial
    mounts: tuple[Trial, ...]


def sweep(
    config: Config,
    ranges: Mapping[str, Sequence[float]],
    lenses: Sequence[Path] = (),
    at_px: tuple[float, float] | None = None,
    travel_m: tuple[float, float] | None = None,
    progress: Progress = quiet,
) -> Sweep:
    """Evaluate all combinations of ``ranges``: ``distance`` (m), ``tilt``, ``side``, ``roll`` (degrees), see
    :class:`Mount`, and ``focal`` (px) or ``fov`` (degrees over the image's width), or instead of these ``lenses``,
    files of calibrated cameras.  Missing ranges keep the present value, except distance and tilt, which have defaults.
    ``at_px``: position of the TCP in the present camera's image (None: as now); ``travel_m``: the openings that count
    (None: all).

    Raises :class:`InputError` for other ranges, values out of bounds, impossible lenses, a position outside the image,
    openings outside the jaw's travel, and too many mounts.
    """
    for name, values in ranges.items():
        if name not in _BOUNDS:
            raise InputError(f"{name}: isn't an axis of a sweep; {', '.join(_BOUNDS)}", "ranges")
        if wrong := _wrong_with(name, values):
            raise InputError(f"{wrong}; {_in_words(name)}", name)
    _check_travel(config, travel_m)
    present, rig, opening_m = Mount.of(config.cam_T_grip), rig_once_taught(config), config.jaw_opening_m
    cameras = [_calibrated(path) for path in lenses] or _cameras(config.camera, ranges)
    place = _place(config, at_px)
    try:
        directions = [towards(camera, _same_place(place, config.camera, camera)) for camera in cameras]
    except ValueError as error:
        raise InputError(str(error), "at_px") from None
    rigs = [(rig._replace(camera=camera), direction) for camera, direction in zip(cameras, directions, strict=True)]
    distances_m = ranges.get("distance") or [present.distance_m * factor for factor in _spaced(*_DISTANCES)]
    tilts_rad = map(math.radians, ranges.get("tilt") or _spaced(*_TILTS_DEG))
    sides_rad = [math.radians(v) for v in ranges["side"]] if "side" in ranges else [present.side_rad]
    rolls_rad = [math.radians(v) for v in ranges["roll"]] if "roll" in ranges else [present.roll_rad]
    grid = [Mount(*axes) for axes in itertools.product(distances_m, tilts_rad, sides_rad, rolls_rad)]
    if (count := len(grid) * len(rigs)) > _MOST_MOUNTS:
        raise InputError(f"{count} mounts; at most {_MOST_MOUNTS}, with fewer values on an axis", "sweep")
    trials = []
    with progress(count, "mount") as step:
        for (other, direction), mount in itertools.product(rigs, grid):
            trials.append(try_mount(other, mount, mount.pose(direction), opening_m, travel_m))
            step()
    policy = config.settings.monitor.policy
    return Sweep(
        config=str(config.path),
        tcp_at_px=place,
        jaw_opening_m=opening_m,
        warn_m=policy.warn_m,
        limit_m=policy.limit_m,
        alert_limit_m=policy.alert_limit_m,
        alert_limit_rad=policy.alert_limit_rad,
        present=try_mount(rig, present, config.cam_T_grip, opening_m, travel_m),
        mounts=tuple(sorted(trials, key=lambda trial: trial.rank)),
    )


def _check_travel(config: Config, travel_m: tuple[float, float] | None) -> None:
    gripper = config.gripper
    if travel_m is None:
        return
    if not gripper.jaw_max_m > gripper.jaw_min_m:
        raise InputError("the gripper's jaw doesn't move; leave it out", "jaw")
    if not gripper.jaw_min_m <= travel_m[0] < travel_m[1] <= gripper.jaw_max_m:
        right = f"MIN:MAX in metres, within {gripper.jaw_min_m:g}:{gripper.jaw_max_m:g}"
        raise InputError(f"{travel_m[0]:g}:{travel_m[1]:g}: is not in the jaw's travel; {right}", "jaw")


def values_in(name: str, text: str) -> tuple[float, ...]:
    """The values, ascending, of a range for :func:`sweep` as a person types it: FIRST:LAST:COUNT, or single ones
    with commas.  Raises :class:`InputError` for another text, and values out of bounds.
    """
    right = f"FIRST:LAST:COUNT or values with commas, {_in_words(name)}"
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
        raise InputError(f"{text}: isn't a range; {right}", name) from None
    if wrong := _wrong_with(name, values):
        raise InputError(f"{text}: {wrong}; {right}", name)
    return tuple(sorted(set(values)))


def _in_words(name: str) -> str:
    lowest, highest, unit = _BOUNDS[name]
    return f"{lowest:g} to {highest:g} {unit}, at most {_MOST_VALUES}"


def _wrong_with(name: str, values: Sequence[float]) -> str:
    lowest, highest, unit = _BOUNDS[name]
    wrong = [value for value in values if not lowest <= value <= highest]
    if wrong:
        return f"{wrong[0]:g} {unit} is out of bounds"
    return f"has {len(values)} values" if len(values) > _MOST_VALUES else ""


def _spaced(first: float, last: float, count: int) -> list[float]:
    return [first + (last - first) * k / (count - 1) for k in range(count)]


def _cameras(camera: Camera, ranges: Mapping[str, Sequence[float]]) -> list[Camera]:
    name = "focal" if "focal" in ranges else "fov"
    focals_px = ranges.get(name, ())
    if name == "fov":
        focals_px = [0.5 * camera.width_px / math.tan(0.5 * math.radians(angle)) for angle in focals_px]
    try:
        return [with_focal(camera, focal_px) for focal_px in focals_px] or [camera]
    except ValueError as error:
        raise InputError(str(error), name) from None


def _calibrated(path: Path) -> Camera:
    try:
        return make_camera(read_camera(path).camera)
    except ValueError as error:
        raise InputError(str(error), "lens") from None


def _same_place(at_px: tuple[float, float], camera: Camera, other: Camera) -> tuple[float, float]:
    """The corresponding point in another camera's image, which may have another size."""
    (u, v), across, down = at_px, other.width_px / camera.width_px, other.height_px / camera.height_px
    return (u + 0.5) * across - 0.5, (v + 0.5) * down - 0.5


def _place(config: Config, at_px: tuple[float, float] | None) -> tuple[float, float]:
    """The position of the TCP in the image: as now, or as given."""
    camera = config.camera
    where = "lies at" if at_px is not None else "the TCP is now at"
    u, v = at_px if at_px is not None else camera.project(config.cam_T_grip[None, :3, 3])[0].tolist()
    if not (0.0 <= u <= camera.width_px - 1.0 and 0.0 <= v <= camera.height_px - 1.0):
        right = f"two numbers inside {camera.width_px} x {camera.height_px} px"
        raise InputError(f"{where} ({u:.1f}, {v:.1f}) px, outside of the image; {right}", "at_px")
    return u, v
