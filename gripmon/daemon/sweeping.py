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
from gripmon.teach.accuracy import weakest_direction
from gripmon.teach.mounts import Grid, Mount, Trial, field_of_view_rad, tried, try_mount


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
    transform, covariance = to_record(trial.cam_T_grip), trial.covariance
    sigma = weakest = None
    if covariance is not None and trial.lever_m is not None:
        sigma = [math.sqrt(v) for v in covariance.diagonal().tolist()]
        weakest = weakest_direction(covariance, trial.lever_m).tolist()
    smallest = None if trial.smallest is None else trial.smallest.tolist()
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
        "reasons": list(trial.reasons),
        "corners": trial.sight.corners,
        "edges": trial.sight.edges,
        "jaw": {
            "opening_m": trial.openings_m.tolist(),
            "corners": trial.corners.tolist(),
            "edges": trial.edges.tolist(),
            "share": trial.share,
        },
        "sigma": None if sigma is None else {"tcp_m": sigma[:3], "rotation_rad": sigma[3:]},
        "weakest": None if weakest is None else {"tcp_m": weakest[:3], "rotation_rad": weakest[3:]},
        "worst_sigma_m": trial.worst_sigma_m,
        "worst_at_m": trial.worst_at_m,
        "protection": None
        if trial.promise is None
        else {
            "position_m": trial.promise.protection.position_m,
            "rotation_rad": trial.promise.protection.rotation_rad,
            "risk": trial.promise.protection.risk,
        },
        "smallest": None if smallest is None else {"tcp_m": smallest[:3], "rotation_rad": smallest[3:]},
        "delay_frames": trial.delay_frames,
        "margin_px": trial.margin_px,
        # JSON knows no infinity.
        "shift_m": None if trial.shift_m is None or math.isinf(trial.shift_m) else trial.shift_m,
    }
