"""The part of ``gripmon check`` that says what stays in view when the camera or the jaws move."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from gripmon.cli.findings import past_limit

if TYPE_CHECKING:
    from gripmon.daemon.config import Config
    from gripmon.teach.forecast import Rig

_AXES = ("x", "y", "z")


def rig_of(config: Config) -> Rig:
    """What the configuration looks with and at."""
    from gripmon.teach.forecast import Rig

    return Rig(config.camera, config.gripper, config.settings.monitor, config.taught_edges)


def in_view(config: Config) -> dict[str, Any]:
    """What is seen, how far from the border, and how far camera and jaws may move, as plain values for JSON."""
    from gripmon.teach.forecast import FEWEST_CORNERS, FEWEST_EDGES, border, see

    rig, cam_T_grip = rig_of(config), config.cam_T_grip
    sight = see(rig, cam_T_grip, config.jaw_opening_m)
    nearest = border(rig, sight)
    return {
        "corners": sight.corners,
        "edges": sight.edges,
        "corners_needed": FEWEST_CORNERS,
        "edges_needed": FEWEST_EDGES,
        "enough": sight.enough,
        "reason": sight.reason,
        "behind_another_finger": [
            name for name, behind in zip(rig.gripper.corner_ids, sight.behind, strict=True) if behind
        ],
        "border": None
        if nearest is None
        else {**nearest.by_side_px, "smallest_px": nearest.smallest_px, "corner": nearest.corner, "side": nearest.side},
        "camera_may_move": _camera_values(config, rig) if sight.enough else None,
        "limit_m": config.settings.monitor.policy.limit_m,
        "jaw_travel": _jaw_values(config, rig),
    }


def _camera_values(config: Config, rig: Rig) -> dict[str, Any]:
    """Amounts to the negative and to the positive side of each axis; None: farther than was sought."""
    from gripmon.teach.forecast import freedom
    from gripmon.teach.forecast.margins import SOUGHT_M, SOUGHT_RAD

    free = freedom(rig, config.cam_T_grip, config.jaw_opening_m)
    amounts = [[None if math.isnan(v) else v for v in pair] for pair in free.limits.tolist()]
    return {
        "shift_m": dict(zip(_AXES, amounts[:3], strict=True)),
        "turn_rad": dict(zip(_AXES, amounts[3:], strict=True)),
        "shift_reason": dict(zip(_AXES, map(list, free.reasons[:3]), strict=True)),
        "turn_reason": dict(zip(_AXES, map(list, free.reasons[3:]), strict=True)),
        "sought_m": SOUGHT_M,
        "sought_rad": SOUGHT_RAD,
    }


def _jaw_values(config: Config, rig: Rig) -> dict[str, Any] | None:
    from gripmon.teach.forecast import certainty, over_jaw

    travel = over_jaw(rig, config.cam_T_grip)
    if travel is None:
        return None
    certain = certainty(rig, config.cam_T_grip)
    policy = config.settings.monitor.policy
    bounds = [None if each is None else each.protection for each in certain.promises]
    return {
        "share": travel.share,
        "gaps": [gap._asdict() for gap in travel.gaps],
        "corners": [int(travel.corners.min()), int(travel.corners.max())],
        "edges": [int(travel.edges.min()), int(travel.edges.max())],
        "from_m": config.gripper.jaw_min_m,
        "to_m": config.gripper.jaw_max_m,
        "certainty": {
            "opening_m": certain.openings_m.tolist(),
            "worst_sigma_m": [None if math.isnan(v) else v for v in certain.sigma_m.tolist()],
            "protection_m": [None if b is None else b.position_m for b in bounds],
            "protection_rad": [None if b is None else b.rotation_rad for b in bounds],
            "alert_limit_m": policy.alert_limit_m,
            "alert_limit_rad": policy.alert_limit_rad,
        },
    }


def in_view_lines(values: dict[str, Any]) -> list[str]:
    """The same for a person: px, mm, degrees."""
    return [*_border_lines(values), *_camera_lines(values), *_jaw_lines(values["jaw_travel"])]


def _border_lines(values: dict[str, Any]) -> list[str]:
    nearest, behind = values["border"], values["behind_another_finger"]
    if nearest is None:
        return ["margin     NONE: no corner is visible"]
    sides = ", ".join(f"{side} {nearest[side]:.0f}" for side in ("left", "right", "top", "bottom"))
    where = f"{nearest['corner']}, {nearest['smallest_px']:.0f} px from the {nearest['side']} ({sides} px)"
    lines = [f"margin     nearest to the image's border is {where}"]
    return lines + ([f"           behind another finger: {', '.join(behind)}"] if behind else [])


def _camera_lines(values: dict[str, Any]) -> list[str]:
    free = values["camera_may_move"]
    if free is None:
        return [f"           NOT enough to measure: {values['reason']}"]
    shifts = ", ".join(f"{axis} {_span(free['shift_m'][axis], 1e3, free['sought_m'])}" for axis in _AXES)
    turns = ", ".join(
        f"{axis} {_span(free['turn_rad'][axis], math.degrees(1.0), free['sought_rad'])}" for axis in _AXES
    )
    lines = [
        f"           it can be measured until the camera shifts along its {shifts} mm",
        f"           or turns about its {turns}°; each alone{', at this opening' * (values['jaw_travel'] is not None)}",
    ]
    known = [
        (amount, f"{sign}{axis}", free["shift_reason"][axis][k])
        for axis in _AXES
        for k, (sign, amount) in enumerate(zip("-+", free["shift_m"][axis], strict=True))
        if amount is not None
    ]
    if known:
        amount_m, way, reason = min(known)
        lines.append(f"           the shortest way is {1e3 * amount_m:.1f} mm along {way}: then {reason}")
        if amount_m < values["limit_m"]:
            limit = f"{1e3 * values['limit_m']:g} mm (monitor.policy.limit_m)"
            lines.append(f"           LESS than the shift past which the reference is measured anew, {limit}")
    return lines


def _span(amounts: list[float | None], factor: float, sought: float) -> str:
    """None: it wasn't found as far as was sought."""
    low, high = (f"{'' if a is not None else 'beyond '}{sign}" for a, sign in zip(amounts, "-+", strict=True))
    low_amount, high_amount = (f"{factor * (sought if a is None else a):.1f}" for a in amounts)
    return f"{low}{low_amount} to {high}{high_amount}"


def _jaw_lines(jaw: dict[str, Any] | None) -> list[str]:
    if jaw is None:
        return []
    low_mm, high_mm = 1e3 * jaw["from_m"], 1e3 * jaw["to_m"]
    corners, edges = (f"{low} to {high}" if low < high else str(low) for low, high in (jaw["corners"], jaw["edges"]))
    travel = f"{_percent(jaw['share'])} of {low_mm:g} to {high_mm:g} mm"
    gaps = [
        f"           NOT from {1e3 * gap['from_m']:.2f} to {1e3 * gap['to_m']:.2f} mm: {gap['reason']}"
        for gap in jaw["gaps"]
    ]
    seen = f"jaw travel enough is visible in {travel}; corners {corners}, edges {edges}"
    return [seen, *gaps, *_certainty_lines(jaw["certainty"])]


def _certainty_lines(values: dict[str, Any]) -> list[str]:
    known = [(s, m) for m, s in zip(values["opening_m"], values["worst_sigma_m"], strict=True) if s is not None]
    if not known:
        return []
    least_m, at_m = max(known)
    lines = [f"           the TCP is least certain at {1e3 * at_m:.1f} mm of opening: to {1e3 * least_m:.3f} mm"]
    if (past := past_limit(values)) is not None:
        worst_m, worst_rad = (max(v for v in values[k] if v is not None) for k in ("protection_m", "protection_rad"))
        worst = f"{1e3 * worst_m:.2g} mm, {math.degrees(worst_rad):.2g} degrees"
        lines.append(
            f"           no transform is valid {past}: bounds of up to {worst} (monitor.policy.alert_limit_m, _rad)"
        )
    return lines


def _percent(share: float) -> str:
    """All or nothing only where it is."""
    rounded = f"{100.0 * share:.1f}"
    if (rounded == "100.0" and share < 1.0) or (rounded == "0.0" and share > 0.0):
        return f"{'over 99.9' if share > 0.5 else 'under 0.1'} %"
    return f"{rounded.removesuffix('.0')} %"
