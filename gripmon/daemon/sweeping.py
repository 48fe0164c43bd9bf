"""What other camera mounts and lenses would see of a configuration's gripper."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gripmon.daemon.config import Config
from gripmon.daemon.forecast import rig_of
from gripmon.model.camera import Camera
from gripmon.model.geometry import to_record
from gripmon.model.records import Array
from gripmon.teach.mounts import Grid, Measurable, Mount, Trial, field_of_view_rad, tried, try_mount


@dataclass(frozen=True)
class Sweep:
    """The mounts of a grid as they were tried, and the present one; ``at_px``: where the TCP shows in all of them."""

    config: Config
    grid: Grid
    at_px: tuple[float, float]
    present: Trial
    trials: tuple[Trial, ...]

    @property
    def ranked(self) -> list[Trial]:
        """The best first."""
        return sorted(self.trials, key=lambda trial: trial.rank)


def sweep(
    config: Config,
    grid: Grid,
    at_px: tuple[float, float],
    travel_m: tuple[float, float] | None = None,
    step: Callable[[], None] = lambda: None,
) -> Sweep:
    """Try every mount of the grid, at the openings of ``travel_m`` (None: all); ``step`` is called after each."""
    opening_m, trials = config.jaw_opening_m, []
    mount, cam_T_grip = Mount.of(config.cam_T_grip), config.cam_T_grip
    present = try_mount(rig_of(config), mount, -1, cam_T_grip, opening_m, travel_m)
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


def _measurable_values(found: Measurable) -> dict[str, Any]:
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
