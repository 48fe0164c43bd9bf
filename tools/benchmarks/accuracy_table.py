"""The results of ``tools/bench accuracy`` as a table for people."""

from __future__ import annotations

from typing import Any

_NAME = 34


def as_text(results: dict[str, Any]) -> str:
    """The whole report."""
    machine = results["machine"]
    packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items())
    lines = [
        f"gripmon {machine['commit']}, {machine['date']}, seed {results['plan']['seed']}",
        f"{machine['cpu']}, {machine['cpus']} cores, {machine['system']}",
        f"Python {machine['python']}, {packages}",
        f"{results['plan']['jobs']} rows at the same time, one thread each",
        f"load average {machine['load_before']} before, {machine['load_after']} after",
        "",
        "error of the TCP in camera axes, µm; rot: of the rotation, millidegrees; given: a new transform; wrong: valid",
        "and off by over 0.2 mm; NEES: of valid frames, 6 where the covariance is true; gate: NEES below 22.46",
        _header(),
    ]
    for name, row in results["rows"].items():
        lines += _row(name, row)
    return "\n".join(lines)


def _header() -> str:
    columns = ["mean x / y / z", "95 %", "max", "rot"]
    text = "".join(c.rjust(w) for c, w in zip(columns, (18, 18, 20, 7), strict=True))
    more = "".join(c.rjust(w) for c, w in zip(
        ["given%", "valid%", "wrong%", "NEES", "gate%", "ms", "99%ms", "limit"], (8, 8, 8, 8, 7, 7, 8, 17), strict=True
    ))  # fmt: skip
    return "".ljust(_NAME) + text + more + "  verdict"


def _row(name: str, row: dict[str, Any]) -> list[str]:
    if row["skipped"]:
        return [f"{name.ljust(_NAME)}  skipped: {row['skipped']}"]
    lines = []
    for way, f in row["ours"].items():
        limit = " / ".join(f"{v:g}" for v in row["limit_um"]) if row["limit_um"] else "-"
        label = name if way == "edges" else "  by corners"
        cells = [
            triple(f["mean_um"]).rjust(18), triple(f["p95_um"]).rjust(18), triple(f["max_um"]).rjust(20),
            number(f["rotation_mdeg"], 1).rjust(7), percent(f["measured"]).rjust(8), percent(f["valid"]).rjust(8),
            percent(f["wrong"]).rjust(8), number(f["nees"], 1).rjust(8), percent(f["in_gate"]).rjust(7),
            number(f["median_ms"], 2).rjust(7), number(f["p99_ms"], 2).rjust(8), limit.rjust(17),
        ]  # fmt: skip
        lines.append(label.ljust(_NAME) + "".join(cells) + f"  {f['verdict']}")
        if f["smoothed_um"] is not None:
            lines.append("    smoothed, after 1 s".ljust(_NAME) + triple(f["smoothed_um"]).rjust(18))
    return lines


def triple(values: list[float] | None) -> str:
    """Three lengths, two digits each."""
    return "-" if values is None else " / ".join(short(v) for v in values)


def short(value: float) -> str:
    return f"{value:.2f}" if value < 1.0 else f"{value:.1f}" if value < 10.0 else f"{value:.0f}"


def number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def percent(value: float) -> str:
    return "-" if value != value else f"{100.0 * value:.1f}"
