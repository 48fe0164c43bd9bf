"""The results of ``tools/bench accuracy`` as text for a terminal; what the report shares with it."""

from __future__ import annotations

from typing import Any

_NAME = 32
_COLUMNS = (
    ("mean x / y / z", 19), ("95 %", 19), ("max", 21), ("rot", 8), ("given", 8), ("valid", 8), ("misleading", 11),
    ("NEES", 8), ("gate", 8), ("ms", 8), ("99 %", 8), ("peer", 8), ("times", 8), ("limit", 18),
)  # fmt: skip
LEGEND = (
    "mean, 95 %, max: error of the TCP in camera x / y / z, µm; rot: mean error of the rotation, millidegrees",
    "given: frames with a new transform, %; valid: verdict valid, %",
    "misleading: valid, yet farther off than the alert limit of 1 mm, or than its own bound, %",
    "NEES: squared normalised error of valid frames, 6 if the covariance is true; gate: share below 22.46 (99.9 %), %",
    "ms, 99 %: median and 99th percentile of the processor time that a frame takes, one thread",
    "peer: mean error over that of the best markerless peer, worst axis, at most 0.33",
    "times: median time of the ArUco detector on the same frames over ours, at least 15",
    "limit: mean error to reach; the verdict tells by which factor the worst axis misses it, and other faults",
)


def as_text(results: dict[str, Any]) -> str:
    """The whole table."""
    lines = [*about(results), "", *LEGEND, "", "".ljust(_NAME) + "".join(t.rjust(w) for t, w in _COLUMNS) + "  verdict"]
    for name, row in results["rows"].items():
        lines += _row(name, row)
    lines += ["", *summary(results)]
    if results.get("series"):
        lines += ["", results["series"]["markdown"], "", *results["series"]["verdicts"]]
    return "\n".join(lines)


def about(results: dict[str, Any]) -> list[str]:
    """Where, when, on what and how it ran."""
    machine, plan = results["machine"], results["plan"]
    packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items())
    return [
        f"gripmon at commit {machine['commit']}, {machine['date']}, seed {plan['seed']}",
        f"{machine['cpu']}, {machine['cpus']} cores, {machine['system']}",
        f"Python {machine['python']}, {packages}",
        f"{plan['jobs']} rows at the same time, one thread each",
        f"load average {machine['load_before']} before, {machine['load_after']} after; it makes times longer",
    ]


def _row(name: str, row: dict[str, Any]) -> list[str]:
    if row["skipped"]:
        return [f"{name.ljust(_NAME)}  skipped: {row['skipped']}"]
    lines = []
    for way, f in row["ours"].items():
        label = name if way == "edges" else f"  by {way}"
        lines.append(_line(label, cells(f, row["limit_um"])) + f"  {f['verdict']}")
        if f["smoothed_um"] is not None:
            lines.append(_line("  smoothed, after 1 s", [triple(f["smoothed_um"])]) + f"  {f['smoothed_verdict']}")
    for peer, f in row["peers"].items():
        lines.append(_line(f"  {peer}", cells(f, None)))
    for peer, why in row["missing_peers"].items():
        lines.append(f"  {peer}: {why}")
    return lines


def _line(label: str, texts: list[str]) -> str:
    widths = [width for _, width in _COLUMNS]
    return (label.ljust(_NAME) + "".join(t.rjust(w) for t, w in zip(texts, widths, strict=False))).rstrip()


def cells(f: dict[str, Any], limit_um: list[float] | None) -> list[str]:
    """The texts of a line's columns; a dash where an estimator has no such figure."""
    return [
        triple(f["mean_um"]),
        triple(f["p95_um"]),
        triple(f["max_um"]),
        number(f.get("rotation_mdeg"), 1),
        percent(f["measured"]),
        percent(f.get("valid")),
        percent(f.get("misleading")),
        number(f.get("nees"), 1),
        percent(f.get("in_gate")),
        number(f["median_ms"], 2),
        number(f["p99_ms"], 2),
        number(f.get("of_best_peer"), 2),
        number(f.get("times_faster"), 1),
        "" if limit_um is None else " / ".join(f"{v:g}" for v in limit_um),
    ]


def summary(results: dict[str, Any]) -> list[str]:
    """The summary of all rows together, and of repeatability."""
    lines = []
    for way, f in results["together"].items():
        lines.append(
            f"all simulated conditions, by {way}: NEES mean {number(f['nees'], 2)} (4.5 to 7.5 to be reached), "
            f"{percent(f['in_gate'])} % inside the 99.9 % gate (99 %), over {f['sure']} valid frames; "
            f"rows that meet their limit: {f['met']} of {f['limited']}"
        )
    for row in results["rows"].values():
        for way, f in row.get("repeatability", {}).items():
            lines.append(
                f"repeatability by {way}: spread {triple(f['spread_um'])} µm, Cramér-Rao bound "
                f"{triple(f['bound_um'])} µm (jaw unknown: {triple(f['bound_jaw_unknown_um'])}), "
                f"ratio {triple(f['ratio'])} (at most 2)"
            )
    return lines


def triple(values: list[float] | None) -> str:
    """Three lengths."""
    return "-" if values is None else " / ".join(short(v) for v in values)


def short(value: float) -> str:
    return f"{value:.2f}" if value < 1.0 else f"{value:.1f}" if value < 10.0 else f"{value:.0f}"


def number(value: float | None, digits: int) -> str:
    return "-" if value is None or value != value else f"{value:.{digits}f}"


def percent(value: float | None) -> str:
    return "-" if value is None or value != value else f"{100.0 * value:.1f}"
