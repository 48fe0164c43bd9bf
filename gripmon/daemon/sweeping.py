"""What other camera mounts and lenses would see of a configuration's gripper."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gripmon.daemon.config import Config
from gripmon.daemon.config.calibrated import read_camera
from gripmon.daemon.forecast import rig_once_taught
from gripmon.model.camera import Camera, make_camera
from gripmon.model.errors import InputError
from gripmon.model.geometry import to_record
from gripmon.model.records import Array
from gripmon.teach.mounts import (
    Grid,
    MeasurableMount,
    Mount,
    Trial,
    field_of_view_rad,
    towards,
    tried,
    try_mount,
    with_focal,
)

_MOST_MOUNTS, _MOST_VALUES = 20000, 100
_BOUNDS = {
    "distance": (0.005, 5.0, "m"), "tilt": (0.0, 180.0, "degrees"), "side": (-360.0, 360.0, "degrees"),
    "roll": (-360.0, 360.0, "degrees"), "focal": (1.0, 1e6, "px"), "fov": (1.0, 170.0, "degrees"),
}  # fmt: skip
_DISTANCES, _TILTS_DEG = (0.6, 1.8, 9), (0.0, 75.0, 6)  # first, last, count: multiples of the present distance, degrees


@dataclass(frozen=True)
class Sweep:
    """The evaluated mounts of a grid, and the present one; ``at_px``: position of the TCP in all images."""

    config: Config
    grid: Grid
    at_px: tuple[float, float]
    present: Trial
    trials: tuple[Trial, ...]

    @property
    def ranked(self) -> list[Trial]:
        """The best first."""
        return sorted(self.trials, key=lambda trial: trial.rank)


def make_grid(
    config: Config,
    ranges: Mapping[str, Sequence[float]],
    lenses: Sequence[Path] = (),
    at_px: tuple[float, float] | None = None,
) -> tuple[Grid, tuple[float, float]]:
    """All combinations of ``ranges``: ``distance`` (m), ``tilt``, ``side``, ``roll`` (degrees), see :class:`Mount`, and
    ``focal`` (px) or ``fov`` (degrees over the image's width), or instead of these ``lenses``, files of calibrated
    cameras.  Missing ranges keep the present value, except distance and tilt, which have default ranges.  ``at_px``:
    position of the TCP in the present camera's image (None: as now), which is also returned.

    Raises :class:`InputError` for other ranges, values out of bounds, impossible lenses, a position outside the image,
    and too many mounts.
    """
    for name, values in ranges.items():
        if name not in _BOUNDS:
            raise InputError(f"{name}: isn't an axis of a sweep; {', '.join(_BOUNDS)}", "ranges")
        if wrong := _wrong_with(name, values):
            raise InputError(f"{wrong}; {_in_words(name)}", name)
    present, rig = Mount.of(config.cam_T_grip), rig_once_taught(config)
    distances_m = ranges.get("distance") or [present.distance_m * factor for factor in _spaced(*_DISTANCES)]
    turns = {"tilt": ranges.get("tilt") or _spaced(*_TILTS_DEG)}
    turns |= {name: ranges[name] for name in ("side", "roll") if name in ranges}
    rad = {name: tuple(math.radians(value) for value in values) for name, values in turns.items()}
    cameras = [_calibrated(path) for path in lenses] or _cameras(config.camera, ranges)
    place = _place(config, at_px)
    try:
        directions = tuple(towards(camera, _same_place(place, config.camera, camera)) for camera in cameras)
    except ValueError as error:
        raise InputError(str(error), "at_px") from None
    grid = Grid(
        tuple(distances_m),
        rad["tilt"],
        rad.get("side", (present.side_rad,)),
        rad.get("roll", (present.roll_rad,)),
        tuple(rig._replace(camera=camera) for camera in cameras),
        directions,
    )
    if len(grid) > _MOST_MOUNTS:
        raise InputError(f"{len(grid)} mounts; at most {_MOST_MOUNTS}, with fewer values on an axis", "sweep")
    return grid, place


def values_in(name: str, text: str) -> tuple[float, ...]:
    """The values, ascending, of a range for :func:`make_grid` as a person types it: FIRST:LAST:COUNT, or single ones
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


def sweep(
    config: Config,
    grid: Grid,
    at_px: tuple[float, float],
    travel_m: tuple[float, float] | None = None,
    step: Callable[[], None] = lambda: None,
) -> Sweep:
    """Evaluate every mount of the grid at the openings ``travel_m`` (None: all); ``step`` is called after each.  Raises
    :class:`InputError` for openings outside the jaw's travel.
    """
    gripper = config.gripper
    if travel_m is not None:
        if not gripper.jaw_max_m > gripper.jaw_min_m:
            raise InputError("the gripper's jaw doesn't move; leave it out", "jaw")
        if not gripper.jaw_min_m <= travel_m[0] < travel_m[1] <= gripper.jaw_max_m:
            right = f"MIN:MAX in metres, within {gripper.jaw_min_m:g}:{gripper.jaw_max_m:g}"
            raise InputError(f"{travel_m[0]:g}:{travel_m[1]:g}: is not in the jaw's travel; {right}", "jaw")
    opening_m, trials = config.jaw_opening_m, []
    mount, cam_T_grip = Mount.of(config.cam_T_grip), config.cam_T_grip
    present = try_mount(rig_once_taught(config), mount, -1, cam_T_grip, opening_m, travel_m)
    for trial in tried(grid, opening_m, travel_m):
        trials.append(trial)
        step()
    return Sweep(config, grid, at_px, present, tuple(trials))


def as_plain(swept: Sweep) -> dict[str, Any]:
    """As plain values for JSON: metres, radians, px."""
    config = swept.config
    return {
        "config": str(config.path),
        "tcp_at_px": list(swept.at_px),
        "jaw_opening_m": config.jaw_opening_m,
        "warn_m": config.settings.monitor.policy.warn_m,
        "limit_m": config.settings.monitor.policy.limit_m,
        "alert_limit_m": config.settings.monitor.policy.alert_limit_m,
        "alert_limit_rad": config.settings.monitor.policy.alert_limit_rad,
        "present": _trial_values(config.camera, swept.present),
        "mounts": [_trial_values(swept.grid.rigs[trial.lens].camera, trial) for trial in swept.ranked],
    }


def _trial_values(camera: Camera, trial: Trial) -> dict[str, Any]:
    transform, found = to_record(trial.cam_T_grip), trial.measurable
    angle = field_of_view_rad(camera)
    return {
        **trial.mount._asdict(),
        "image_px": [camera.width_px, camera.height_px],
        "focal_px": camera.fx_px,
        "field_of_view_rad": None if math.isnan(angle) else angle,
        "cam_T_grip": {
            "translation_m": list(transform.translation_m),
            "rotation_xyzw": list(transform.rotation_xyzw),
        },
        "works": trial.works,
        "reasons": [fault.text for fault in trial.faults],
        "corners": trial.sight.corners,
        "edges": trial.sight.edges,
        "jaw": {
            "opening_m": trial.openings_m.tolist(),
            "corners": trial.corners.tolist(),
            "edges": trial.edges.tolist(),
            "share": trial.share,
        },
        **(dict.fromkeys(_OF_MEASURABLE) if found is None else _measurable_values(found)),
    }


_OF_MEASURABLE = (
    "sigma", "weakest", "worst_sigma_m", "worst_at_m", "protection", "smallest", "delay_frames", "margin_px", "shift_m"
)  # fmt: skip


def _measurable_values(found: MeasurableMount) -> dict[str, Any]:
    bound = found.promise.protection
    return {
        "sigma": _pose_values(found.frame.sigma),
        "weakest": _pose_values(found.frame.weakest),
        "worst_sigma_m": found.worst_sigma_m,
        "worst_at_m": found.worst_at_m,
        "protection": {"position_m": bound.position_m, "rotation_rad": bound.rotation_rad, "risk": bound.risk},
        "smallest": _pose_values(found.smallest),
        "delay_frames": found.delay_frames,
        "margin_px": found.margin_px,
        # JSON has no infinity.
        "shift_m": None if math.isinf(found.shift_m) else found.shift_m,
    }


def _pose_values(vector: Array) -> dict[str, list[float]]:
    return {"tcp_m": vector[:3].tolist(), "rotation_rad": vector[3:].tolist()}
