"""What ``check`` says, and ``run`` and ``replay`` warn of, when a view can't keep the alert limits."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gripmon.daemon.config import Config
    from gripmon.teach.forecast import Promise


def promise_of(config: Config) -> Promise | None:
    """What a frame at the configured pose and opening may promise; None where too little is in view to measure it."""
    from gripmon.cli.margins import rig_of
    from gripmon.teach.forecast import foresee_frame, promise, see

    rig, cam_T_grip, opening_m = rig_of(config), config.cam_T_grip, config.jaw_opening_m
    if not see(rig, cam_T_grip, opening_m).enough:
        return None
    return promise(foresee_frame(rig, cam_T_grip, opening_m).protection, config.settings.monitor.policy)


def values(config: Config) -> dict[str, Any]:
    """The same as plain values for JSON: metres, radians."""
    found, policy = promise_of(config), config.settings.monitor.policy
    return {
        "protection": None
        if found is None
        else {
            "position_m": found.protection.position_m,
            "rotation_rad": found.protection.rotation_rad,
            "risk": found.protection.risk,
        },
        "alert_limit_m": policy.alert_limit_m,
        "alert_limit_rad": policy.alert_limit_rad,
        "reachable": found is not None and found.reachable,
        "needed": None if found is None or found.reachable else found.needed,
        "promise": "nothing: too little is in view" if found is None else found.text(),
    }


def warning(config: Config) -> str | None:
    """What to say at the start when no transform of the configured view can be valid; None otherwise."""
    found = promise_of(config)
    if found is None or found.reachable:
        return None
    return f"{config.path}: no transform of this view can be valid: valid needs {found.needed} (monitor.policy)"
