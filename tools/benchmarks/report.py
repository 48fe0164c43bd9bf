"""The results of ``tools/bench latency`` as a table for people."""

from __future__ import annotations

from typing import Any

_FASTER, _TAIL, _LARGER, _RECORDING, _FLAT_MIB = 20.0, 3.0, 1.3, 1.25, 2.0
_LABEL, _COLUMN = 58, 16


def as_text(results: dict[str, Any]) -> str:
    """The whole report."""
    sizes = list(results["latency"])
    lines = [*machine_lines(results["machine"]), "", _row("", *(size.replace("x", " x ") for size in sizes))]
    lines += _latency([results["latency"][size] for size in sizes])
    lines += ["", "share of each stage, of the mean (a run of its own, with stop watches in it)"]
    lines += _stages([results["stages"][size] for size in sizes])
    lines += ["", "recording, at 60 frames/s, on and off in turns: handed over -> published"]
    lines += _recording([results["recording"][size] for size in sizes])
    lines += ["", "memory of the process, frames and all"]
    lines += _memory(results["memory"])
    lines += ["", "targets", *_targets(results, sizes)]
    return "\n".join(lines)


def machine_lines(machine: dict[str, Any]) -> list[str]:
    packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items())
    return [
        f"gripmon {machine['commit']}, {machine['date']}",
        f"{machine['cpu']}, {machine['cpus']} cores, {machine['system']}",
        f"load average {machine['load_before']} before, {machine['load_after']} after (1 belongs to this benchmark)",
        f"Python {machine['python']}, {packages}; one thread each",
    ]


def _latency(values: list[dict[str, Any]]) -> list[str]:
    def ours(key: str, figure: str) -> list[str]:
        return [_ms(v[key][figure]) for v in values]

    return [
        "frame handed over -> transform published, back to back on one core",
        _row("  median", *ours("published_us", "median")),
        _row("  99th percentile", *ours("published_us", "p99")),
        _row("  longest", *ours("published_us", "max")),
        _row("  frames a second on one core, whole loop", *(f"{v['frames_per_s_one_core']:.0f} /s" for v in values)),
        "the same at 60 frames/s, on any core",
        _row("  median", *ours("paced_published_us", "median")),
        _row("  99th percentile", *ours("paced_published_us", "p99")),
        _row("  until another process has it, median", *ours("paced_received_us", "median")),
        _row("  until another process has it, 99th percentile", *ours("paced_received_us", "p99")),
        "instead: two AprilTags 36h11, sub-pixel corners, solvePnP, whole image (not published)",
        _row("  median", *ours("tags_us", "median")),
        _row("  99th percentile", *ours("tags_us", "p99")),
        _row("  both tags found", *("{} of {}".format(*v["tags_found"]) for v in values)),
        _row("  error of the TCP, median", *(f"{1e3 * v['tags_tcp_error_m']:.3f} mm" for v in values)),
        _row("times faster than tags, at the median", *(f"{v['times_faster']:.1f}" for v in values)),
    ]  # fmt: skip


def _stages(values: list[dict[str, float]]) -> list[str]:
    totals = [sum(v.values()) for v in values]
    rows = []
    for stage in values[0]:
        times = [v[stage] for v in values]
        shares = [f"{t:.0f} µs {100.0 * t / total:3.0f} %" for t, total in zip(times, totals, strict=True)]
        rows.append(_row(f"  {stage}", *shares))
    return [*rows, _row("  together", *(f"{total:.0f} µs 100 %" for total in totals))]


def _recording(values: list[dict[str, Any]]) -> list[str]:
    def ratio(figure: str) -> list[str]:
        return [f"{v['on_us'][figure] / v['off_us'][figure]:.2f}" for v in values]

    rows = [
        _row(f"  {name}, {label}", *(_ms(v[key][figure]) for v in values))
        for figure, label in (("median", "median"), ("p99", "99th percentile"))
        for key, name in (("off_us", "off"), ("on_us", "on"))
    ]
    busy = [100.0 * (v["loop_on_us"]["median"] / v["loop_off_us"]["median"] - 1.0) for v in values]
    return [
        *rows,
        _row("  on / off, median", *ratio("median")),
        _row("  on / off, 99th percentile", *ratio("p99")),
        _row("  until the loop wants the next frame, median", *(f"{more:+.0f} %" for more in busy)),
        _row("  frames dropped; written", *(f"{v['dropped']}; {1e-6 * v['written_bytes']:.1f} MB" for v in values)),
    ]


def _memory(memory: dict[str, Any]) -> list[str]:
    return [
        _row(f"  {size.replace('x', ' x ')}, after {int(frames):,} frames", f"{rss / 2**20:.1f} MiB")
        for size, values in memory.items()
        for frames, rss in values["rss_bytes"].items()
    ]


def _targets(results: dict[str, Any], sizes: list[str]) -> list[str]:
    latency, recording = results["latency"], results["recording"]
    medians = {size: latency[size]["published_us"]["median"] for size in sizes}
    lines = []
    for size in sizes:
        faster, tail = latency[size]["times_faster"], latency[size]["published_us"]["p99"] / medians[size]
        lines.append(_target(f"{size}: at least {_FASTER:.0f} times faster than tags", faster, _FASTER, more=True))
        lines.append(_target(f"{size}: 99th percentile at most {_TAIL:g} times the median", tail, _TAIL))
        for figure, label in (("median", "median"), ("p99", "99th percentile")):
            ratio = recording[size]["on_us"][figure] / recording[size]["off_us"][figure]
            lines.append(_target(f"{size}: recording adds at most 25 %, {label}", ratio, _RECORDING))
    if len(sizes) > 1:
        larger = medians[sizes[1]] / medians[sizes[0]]
        lines.append(_target(f"{sizes[1]} at most {_LARGER:g} times {sizes[0]}", larger, _LARGER))
    for size, values in results["memory"].items():
        rss = list(values["rss_bytes"].values())
        lines.append(_target(f"{size}: memory flat, within 2 MiB", (rss[-1] - rss[0]) / 2**20, _FLAT_MIB))
    return lines


def _target(text: str, value: float, limit: float, *, more: bool = False) -> str:
    met = value >= limit if more else value <= limit
    return _row(f"  {text}", f"{value:.2f}") + ("   met" if met else "   NOT MET")


def _row(label: str, *values: str) -> str:
    return label.ljust(_LABEL) + "".join(value.rjust(_COLUMN) for value in values)


def _ms(microseconds: float) -> str:
    return f"{1e-3 * microseconds:.3f} ms"
