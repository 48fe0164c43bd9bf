"""Figures of ``tools/bench integrity`` from the lines of its scenes: misleading frames, availability, levels."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.integrity_limits import POSITIONS_M
from benchmarks.kit import at_most, share

BACK_FRAMES = 3
"""Within this many frames after the view is free the transform must be valid."""
LEVEL_OVER_ERROR = 12.0
NEES_RANGE = (4.5, 7.5)
AVAILABLE = (0.99, 0.95, 0.80)
"""Least share of valid frames where nothing is hidden, both tips are seen, and one is."""
BACK_SHARE = 0.999
VIEWS = ("nothing hidden", "both tips seen", "one tip hidden", "no tip seen")
WORST = 10
SCALES = (0.0, 4.0, 6.0, 8.0, np.inf)
"""Limits between classes of scenes by their image scale at the TCP, px/mm."""
NEVER_PROMISED = ("crash",)
NOT_PROMISED_ABSOLUTE = ("model off", "tips worn", "tips rounded")
"""Conditions that no bound promises to survive, and those of which the absolute one says nothing: a closed list."""
MOST_UNBOUNDED_SHARE, MOST_EXCESS = 2.0 / 2000.0, 1.3
"""Scenes with valid frames beyond their bound, and by how much the worst may be."""
_FOUND_SHARE = 0.25


@dataclass(frozen=True)
class Frames:
    """All frames of some scenes, an array element a frame; NaN where nothing was published or bounded.

    ``line`` is the scene's number in the list; ``asked``: availability is judged there.  ``back``: for each time that
    the view became free, the frames until the transform was valid (inf: not before the end).
    """

    line: NDArray[np.intp]
    index: NDArray[np.intp]
    view: NDArray[np.intp]
    valid: NDArray[np.bool_]
    asked: NDArray[np.bool_]
    error_m: NDArray[np.float64]
    level_m: NDArray[np.float64]
    within: NDArray[np.bool_]
    """(n, len(POSITIONS_M)): the frame would be valid with this alert limit of the position, by its bound."""
    both_m: NDArray[np.float64]
    """(n, 2): position's bound since the reference, and the absolute one."""
    beyond_absolute: NDArray[np.bool_]
    """Valid, and the transform as measured is farther from the true one than the absolute bound on its position."""
    possible: NDArray[np.bool_]
    """The published covariance alone would allow a protection level within the alert limit."""
    excess: NDArray[np.float64]
    """Error over protection level, the larger of position's and rotation's."""
    over_limit: NDArray[np.float64]
    """Error over alert limit, likewise."""
    nees: NDArray[np.float64]
    back: NDArray[np.float64]

    @property
    def lies(self) -> NDArray[np.bool_]:
        """Valid and beyond the alert limit."""
        return self.valid & (self.over_limit > 1.0)

    @property
    def unbounded(self) -> NDArray[np.bool_]:
        """Valid and beyond the protection level, or without one."""
        return self.valid & ~(self.excess <= 1.0)

    @property
    def suspect_unbounded(self) -> NDArray[np.bool_]:
        """Published with a bound, not valid, and beyond it."""
        return ~self.valid & (self.excess > 1.0)


def collect(lines: list[dict[str, Any]]) -> Frames:
    """The judged frames of scenes: all but each scene's first, which a second has to confirm."""
    parts = [_columns(number, line) for number, line in enumerate(lines)]
    columns = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    back = np.array([frames for line in lines for frames in _back(line)], dtype=float)
    return Frames(**columns, back=back)


def _columns(number: int, line: dict[str, Any]) -> dict[str, NDArray[Any]]:
    values = {key: np.array(line[key], dtype=float) for key in ("error_m", "error_rad", "level_m", "level_rad", "nees")}
    view = np.array(line["view"], dtype=np.intp)
    with np.errstate(invalid="ignore", divide="ignore"):
        excess = np.fmax(values["error_m"] / values["level_m"], values["error_rad"] / values["level_rad"])
        over_limit = np.fmax(values["error_m"] / line["limit_m"], values["error_rad"] / line["limit_rad"])
    columns = {
        "line": np.full(len(view), number, dtype=np.intp),
        "index": np.arange(len(view)),
        "view": view,
        "valid": np.array(line["valid"], dtype=bool),
        "asked": np.array(line["enough"], dtype=bool) & ~_just_freed(view),
        "error_m": values["error_m"],
        "level_m": values["level_m"],
        "within": _within(line, values["level_m"], values["level_rad"]),
        "both_m": np.array([line["reference_m"], line["absolute_m"]], dtype=float).T,
        "beyond_absolute": _beyond_absolute(line),
        "possible": np.array(line["floor_m"], dtype=float) <= line["limit_m"],
        "excess": excess,
        "over_limit": over_limit,
        "nees": values["nees"],
    }
    return {key: column[1:] for key, column in columns.items()}


def _within(line: dict[str, Any], level_m: NDArray[Any], level_rad: NDArray[Any]) -> NDArray[np.bool_]:
    """(n, limits) whether a frame's bounds are within other limits of the position.  A frame within its scene's own
    limits that isn't valid is doubted for another reason; of one beyond them that isn't known.
    """
    with np.errstate(invalid="ignore"):
        turned = level_rad <= line["limit_rad"]
        doubted = turned & (level_m <= line["limit_m"]) & ~np.array(line["valid"], dtype=bool)
        return (level_m[:, None] <= np.array(POSITIONS_M)) & (turned & ~doubted)[:, None]


def _beyond_absolute(line: dict[str, Any]) -> NDArray[np.bool_]:
    error_m, level_m = (np.array(line[key], dtype=float) for key in ("absolute_error_m", "absolute_m"))
    with np.errstate(invalid="ignore"):
        return np.array(line["valid"], dtype=bool) & (error_m > level_m)


def _freed(view: NDArray[np.intp]) -> list[int]:
    """Frames in which the whole gripper is seen, the first after a tip was hidden."""
    out, hidden = [], False
    for index, what in enumerate(view.tolist()):
        if what >= 2:
            hidden = True
        elif what == 0 and hidden:
            out.append(index)
            hidden = False
    return out


def _just_freed(view: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Frames that :data:`BACK_FRAMES` is about: they don't count as unavailable, too."""
    out = np.zeros(len(view), dtype=bool)
    for index in _freed(view):
        out[index : index + BACK_FRAMES - 1] = True
    return out


def _back(line: dict[str, Any]) -> list[float]:
    """Frames from the first with a free view to the first valid one, both counted; only where that may be asked for."""
    view, out = np.array(line["view"], dtype=np.intp), []
    for index in _freed(view):
        valid, enough = line["valid"][index:], line["enough"][index:]
        if len(valid) < BACK_FRAMES or not all(enough[:BACK_FRAMES]):
            continue
        out.append(float(valid.index(True) + 1) if True in valid else np.inf)
    return out


def first_valid(line: dict[str, Any]) -> float:
    """Frames from a scene's first to the first valid one, both counted; inf: never."""
    return float(line["valid"].index(True) + 1) if True in line["valid"] else np.inf


@dataclass(frozen=True)
class Knock:
    """Frames from the first that shows the mount's jump, counted as 1: until an alert says so, until the gripper is
    measured within a quarter of the jump of where it is, and from then until it is valid; inf: not before the end.
    """

    said: float
    found: float
    valid: float


def knock_of(line: dict[str, Any]) -> Knock | None:
    """None for a scene without a jump, or of which the jump lies before its first frame or beyond its last."""
    if line["knock"] is None or not 0 < line["knock"][0] < len(line["valid"]):
        return None
    at, size_m = line["knock"]
    said = next((index - at + 1.0 for index in line["moved_alerts"] if index >= at), np.inf)
    errors = zip(line["error_m"][at:], line["nees"][at:], strict=True)
    there = [nees is not None and error_m <= _FOUND_SHARE * size_m for error_m, nees in errors]
    if True not in there:
        return Knock(said, np.inf, np.inf)
    found = there.index(True)
    valid = line["valid"][at + found :]
    return Knock(said, found + 1.0, valid.index(True) + 1.0 if True in valid else np.inf)


def promised(line: dict[str, Any]) -> bool:
    """Whether a scene's condition is in the promise of the bound that its frames are valid by."""
    name = line["condition"].rpartition(": ")[2]
    return name not in NEVER_PROMISED and not (line["valid_by"] == "absolute" and name in NOT_PROMISED_ABSOLUTE)


def figures(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """Everything that the table shows of some scenes."""
    frames = collect(lines)
    count, lies, unbounded = len(frames.view), int(frames.lies.sum()), int(frames.unbounded.sum())
    good = frames.valid & np.isfinite(frames.level_m)
    error, level = (float(np.median(x[good])) if good.any() else None for x in (frames.error_m, frames.level_m))
    firsts = np.array([first_valid(line) for line in lines])
    own = [line for line in lines if promised(line)]
    kept = np.array([promised(line) for line in lines])[frames.line]
    excess = frames.excess[frames.valid & np.isfinite(frames.excess)]
    kept_excess = frames.excess[frames.valid & kept & np.isfinite(frames.excess)]
    knocks = [knock for line in lines if (knock := knock_of(line)) is not None]
    nees = frames.nees[frames.valid & np.isfinite(frames.nees)]
    return {
        "scenes": len(lines),
        "frames": count,
        "lies": lies,
        "lies_at_most": at_most(lies, count),
        "unbounded": unbounded,
        "unbounded_at_most": at_most(unbounded, count),
        "suspect_unbounded": int(frames.suspect_unbounded.sum()),
        "lies_scenes": _scenes(frames, frames.lies),
        "unbounded_scenes": _scenes(frames, frames.unbounded),
        "worst_excess": float(excess.max()) if len(excess) else None,
        "promised": {
            "scenes": len(own),
            "frames": int(kept.sum()),
            "lies": int((frames.lies & kept).sum()),
            "unbounded": int((frames.unbounded & kept).sum()),
            "unbounded_scenes": _scenes(frames, frames.unbounded & kept),
            "unbounded_scenes_at_most": at_most(_scenes(frames, frames.unbounded & kept), len(own)),
            "worst_excess": float(kept_excess.max()) if len(kept_excess) else None,
        },
        "beyond_absolute": [int(frames.beyond_absolute.sum()), _scenes(frames, frames.beyond_absolute)],
        "valid_share": float(frames.valid.mean()),
        "asked_share": share(frames.valid[frames.asked]),
        "within": [share(frames.within[frames.asked, k]) for k in range(len(POSITIONS_M))],
        "median_both_m": [_median(frames.both_m[frames.valid, k]) for k in range(2)],
        "first_valid": float(np.median(firsts)),
        "never_valid": int(np.isinf(firsts).sum()),
        "knocks": len(knocks),
        "knock_said": _median(np.array([knock.said for knock in knocks])),
        "knock_found": _median(np.array([knock.found for knock in knocks])),
        "knock_valid": _median(np.array([knock.valid for knock in knocks])),
        "misleading_scenes": len(set(frames.line[frames.lies | frames.unbounded].tolist())),
        "available": [share(frames.valid[frames.asked & (frames.view == view)]) for view in range(4)],
        "possible": [share(frames.possible[frames.asked & (frames.view == view)]) for view in range(4)],
        "asked": [int((frames.asked & (frames.view == view)).sum()) for view in range(4)],
        "median_error_m": error,
        "median_level_m": level,
        "level_over_error": level / error if error and level else None,
        "nees": float(nees.mean()) if len(nees) else None,
        "median_nees": float(np.median(nees)) if len(nees) else None,
        "freed": len(frames.back),
        "back": share(frames.back <= BACK_FRAMES),
        "latest_back": float(frames.back.max()) if len(frames.back) else None,
        "false_alerts": sum(len(line["false_alerts"]) for line in lines),
        "alert_scenes": sum(bool(line["false_alerts"]) for line in lines),
        "seconds": float(sum(line["seconds"] for line in lines)),
    }


def _scenes(frames: Frames, which: NDArray[np.bool_]) -> int:
    """In how many scenes there are such frames."""
    return len(set(frames.line[which].tolist()))


def _median(values: NDArray[np.float64]) -> float | None:
    """Without NaN; None of nothing."""
    there = values[~np.isnan(values)]
    return float(np.median(there)) if len(there) else None


def by_condition(lines: list[dict[str, Any]]) -> list[tuple[str, list[dict[str, Any]]]]:
    """Scenes of each condition, and all of them."""
    names = dict.fromkeys(line["condition"] for line in lines)
    return [*((name, [line for line in lines if line["condition"] == name]) for name in names), ("all", lines)]


def summary(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """Figures of each condition, of all, and by scale; the worst frames."""
    *own, (_, every) = by_condition(lines)
    rows = {name: figures(of) for name, of in own}
    return {"rows": rows, "total": figures(every), "scales": by_scale(lines), "worst": worst(lines)}


def by_scale(lines: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Figures of scenes by how large the fingertips are in the image, and by what is known of the jaw opening."""
    out = []
    for exact in (True, False):
        for low, high in pairwise(SCALES):
            own = [one for one in lines if one["jaw_exact"] is exact and low <= _px_per_mm(one) < high]
            if own:
                out.append({"low": low, "high": high, "jaw_exact": exact, **figures(own)})
    return out


def _px_per_mm(line: dict[str, Any]) -> float:
    return 1e-3 * float(line["focal_px"]) / float(line["depth_m"])


def worst(lines: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The worst frames, one of each scene: by how far a valid one misled, then by the errors of the bounded ones."""
    found = []
    frames = collect(lines)
    badness = np.where(frames.valid, np.fmax(frames.over_limit, frames.excess), 1e-3 * frames.excess)
    for number, line in enumerate(lines):
        own = np.flatnonzero((frames.line == number) & np.isfinite(badness))
        if not len(own):
            continue
        at = int(own[np.argmax(badness[own])])
        found.append(
            {
                "badness": float(badness[at]),
                "condition": line["condition"],
                "seed": line["seed"],
                "scene": line["scene"],
                "frame": int(frames.index[at]),
                "valid": bool(frames.valid[at]),
                "error_m": float(frames.error_m[at]),
                "level_m": None if np.isnan(frames.level_m[at]) else float(frames.level_m[at]),
                "error_rad": line["error_rad"][int(frames.index[at])],
                "level_rad": line["level_rad"][int(frames.index[at])],
                "view": VIEWS[int(frames.view[at])],
                "why": line["why"][int(frames.index[at])],
                "misleading": int((frames.lies | frames.unbounded)[own].sum()),
            }
        )
    return sorted(found, key=lambda item: -item["badness"])[:WORST]


def targets(total: dict[str, Any]) -> list[tuple[str, str, bool | None]]:
    """Each target, what was reached, and whether it is met (None: nothing to judge it by)."""

    def reached(value: float | None) -> str:
        return "–" if value is None else f"{100.0 * value:.2f} %"

    kept = total["promised"]
    out: list[tuple[str, str, bool | None]] = [
        ("no valid frame beyond the alert limit", str(kept["lies"]), kept["lies"] == 0),
        (
            f"valid beyond its protection level in at most {1e3 * MOST_UNBOUNDED_SHARE:g} of 1000 scenes",
            f"{kept['unbounded_scenes']} of {kept['scenes']}, {kept['unbounded']} frames",
            kept["unbounded_scenes"] <= MOST_UNBOUNDED_SHARE * kept["scenes"],
        ),
        (
            f"no valid frame beyond {MOST_EXCESS:g} times its protection level",
            "–" if kept["worst_excess"] is None else f"{kept['worst_excess']:.2f}",
            None if kept["worst_excess"] is None else kept["worst_excess"] <= MOST_EXCESS,
        ),
    ]
    for view, least in enumerate(AVAILABLE):
        available = total["available"][view]
        met = None if available is None else available >= least
        out.append((f"valid where {VIEWS[view]}: at least {100.0 * least:g} %", reached(available), met))
    ratio, nees, back = total["level_over_error"], total["nees"], total["back"]
    out += [
        (
            f"median protection level at most {LEVEL_OVER_ERROR:g} x the median error",
            "–" if ratio is None else f"{ratio:.1f}",
            None if ratio is None else ratio <= LEVEL_OVER_ERROR,
        ),
        (
            f"valid again within {BACK_FRAMES} frames: at least {100.0 * BACK_SHARE:g} %",
            f"{reached(back)} of {total['freed']}",
            None if back is None else back >= BACK_SHARE,
        ),
        (
            "mean NEES of valid frames 6 ± 25 %",
            "–" if nees is None else f"{nees:.1f}",
            None if nees is None else NEES_RANGE[0] <= nees <= NEES_RANGE[1],
        ),
        ("no alert that names a wrong cause", str(total["false_alerts"]), total["false_alerts"] == 0),
    ]
    return out
