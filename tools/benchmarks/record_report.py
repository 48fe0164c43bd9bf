"""The results of ``tools/bench record`` as tables, and what was to be reached."""

from __future__ import annotations

from typing import Any

from benchmarks.machine import machine_lines

MEDIAN, TAIL, HOUR_S, LOSS_S, FLAT_MIB = 1.10, 1.25, 60.0, 2.0, 1.0
_CONDITIONS = {"off": "off", "on": "on", "stalled": "on, disk stalled"}

Verdict = tuple[str, str, bool]


def as_text(results: dict[str, Any]) -> str:
    """The whole report."""
    lines = machine_lines(results["machine"])
    for part, rows in _PARTS.items():
        if part in results:
            lines += ["", *rows(results[part])]
    lines += ["", "to be reached"]
    lines += [f"  {what:74s} {value:>10s}  {'met' if met else 'NOT MET'}" for what, value, met in verdicts(results)]
    return "\n".join(lines)


def verdicts(results: dict[str, Any]) -> list[Verdict]:
    """What is to be reached, what was, and whether; of the parts that were measured."""
    lines: list[Verdict] = []
    for size, measured in results.get("loop", {}).items():
        lines += [
            (
                f"{size}: {what}, {_CONDITIONS[condition]}: {label} at most {limit:.2f} of off",
                f"{ratio:.2f}",
                ratio <= limit,
            )
            for what, times in (("until published", "published_us"), ("whole loop", "loop_us"))
            for condition in ("on", "stalled")
            for figure, label, limit in (("median", "median", MEDIAN), ("p99", "99 %", TAIL))
            for ratio in (measured[condition][times][figure] / measured["off"][times][figure],)
        ]
    for name, done in results.get("hour", {}).get("read", {}).items():
        text = _seconds(done["took_s"]) if done["code"] == 0 else f"code {done['code']}"
        met = done["code"] == 0 and done["took_s"] < HOUR_S
        lines.append((f"gripmon {name} of an hour within {HOUR_S:g} s", text, met))
    if "killed" in results:
        tries = results["killed"]["tries"]
        worst_s = max(each["loss_s"] for each in tries)
        opened = sum(each["opened"] for each in tries)
        lines.append((f"kill -9 loses at most {LOSS_S:g} s", f"{worst_s:.2f} s", worst_s <= LOSS_S))
        lines.append(("every file opens after it", f"{opened} of {len(tries)}", opened == len(tries)))
    if "memory" in results:
        for who, title in (("daemon_mib", "daemon's side"), ("process_mib", "recording process")):
            rate = results["memory"]["slopes"][who]["mib_per_hour"]
            text = f"memory flat, {title}: at most {FLAT_MIB:g} MiB an hour"
            lines.append((text, f"{rate:+.3f}", rate <= FLAT_MIB))
    return lines


def _loop(sizes: dict[str, Any]) -> list[str]:
    lines = ["recording and the loop, at 60 frames/s, in turns: ms, median / 99 % (longest)"]
    for size, measured in sizes.items():
        lines.append(f"  {size}; stalled: {measured['how']}")
        lines.append(f"    {'':18s} {'until published':>30s} {'whole loop':>30s}   frames, not recorded")
        for condition, title in _CONDITIONS.items():
            row = measured[condition]
            lines.append(
                f"    {title:18s} {_times(row['published_us']):>30s} {_times(row['loop_us']):>30s}"
                f"   {row['frames']}, {measured['dropped'][condition]}"
            )
        for condition in ("on", "stalled"):
            ratios = [_ratio(measured[condition][k], measured["off"][k]) for k in ("published_us", "loop_us")]
            lines.append(f"    {_CONDITIONS[condition] + ' / off':18s} {ratios[0]:>30s} {ratios[1]:>30s}")
    return lines


def _bytes(sizes: dict[str, Any]) -> list[str]:
    lines = ["on the disk, extrapolated to an hour at 60 frames/s; nothing happens"]
    for size, policies in sizes.items():
        seconds = next(iter(policies.values()))["frames"] / 60.0
        lines.append(
            f"  {size}, from {seconds:.0f} s each: {'GB an hour':>26s} {'kB a frame':>12s} {'50 GB last':>12s}"
        )
        for name, row in policies.items():
            gigabytes, hours = 1e-9 * row["bytes_per_hour"], 50e9 / row["bytes_per_hour"]
            lasts = f"{hours:.0f} h" if hours < 72.0 else f"{hours / 24.0:.0f} days"
            missing = f"   ({row['images_dropped']} images dropped)" if row["images_dropped"] else ""
            lines.append(
                f"    {name:38s} {gigabytes:11.2f} {1e-3 * row['bytes_per_frame']:12.2f} {lasts:>12s}{missing}"
            )
    return lines


def _hour(hour: dict[str, Any]) -> list[str]:
    written = hour["written"]
    lines = ["an hour of recording, default policy"]
    lines.append(
        f"  {written['frames']:,} frames, {written['images']:,} images, {written['alerts']} alerts; {written['files']} "
        f"files, {1e-9 * written['bytes']:.2f} GB (written in {written['written_s']:.0f} s)"
    )
    for name, done in hour["read"].items():
        code = "" if done["code"] == 0 else f"   exit code {done['code']}: {done['said']}"
        lines.append(f"  gripmon {name:10s} {_seconds(done['took_s']):>10s}, {_seconds(done['cpu_s'])} of a core{code}")
    return lines


def _killed(killed: dict[str, Any]) -> list[str]:
    losses = sorted(each["loss_s"] for each in killed["tries"])
    opened = sum(each["opened"] for each in killed["tries"])
    first_s, last_s = killed["span_s"]
    middle_s = losses[len(losses) // 2]
    return [
        f"kill -9 of daemon and recording process, {len(losses)} times, {first_s:g} to {last_s:g} s after the start",
        f"  last frame delivered - last frame in the file: median {middle_s:.2f} s, longest {losses[-1]:.2f} s",
        f"  opened by rerun's own reader: {opened} of {len(losses)}",
    ]


def _memory(memory: dict[str, Any]) -> list[str]:
    lines = [
        f"memory over {memory['frames']:,} frames, {memory['hours']:g} h at 60/s, in {memory['took_s']:.0f} s",
        f"  {memory['written']:,} written, {memory['dropped']} dropped; files: {memory['files']}",
        f"  {'hours':>8s} {'daemon side':>14s} {'recording process':>20s}   MiB",
    ]
    looks = memory["looks"]
    lines += [
        f"  {look['hours']:8.2f} {look['daemon_mib']:14.1f} {look['process_mib']:20.1f}"
        for look in looks[:: max(len(looks) // 12, 1)]
    ]
    for who, title in (("daemon_mib", "daemon's side"), ("process_mib", "recording process")):
        found = memory["slopes"][who]
        lines.append(f"  {title}: {found['mib_per_hour']:+.3f} ± {found['sigma_mib_per_hour']:.3f} MiB an hour")
    return lines


def _times(values_us: dict[str, float]) -> str:
    return f"{1e-3 * values_us['median']:.3f} / {1e-3 * values_us['p99']:.3f} ({1e-3 * values_us['max']:.1f})"


def _ratio(values_us: dict[str, float], others_us: dict[str, float]) -> str:
    return " / ".join(f"{values_us[figure] / others_us[figure]:.2f}" for figure in ("median", "p99"))


def _seconds(value: float) -> str:
    return f"{value:.1f} s"


_PARTS = {"loop": _loop, "bytes": _bytes, "hour": _hour, "killed": _killed, "memory": _memory}
