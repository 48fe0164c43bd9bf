"""The results of ``tools/bench latency`` as the page docs/results/speed.md."""

from __future__ import annotations

from typing import Any

from benchmarks.latency_rows import Measured, of_plain
from benchmarks.machine import machine_lines

PROFILE = "profile"
_METHOD = """\
The daemon's own loop (`gripmon.daemon.running.run`, with a Zenoh publisher and a subscriber in another process) gets
frames of the demo's camera that the simulator rendered beforehand: boxes, cables and print move behind the gripper
while the mount creeps to and fro. Each frame is timed from its arrival until its transform has left, back to back on
one core. The trackers it is compared with alternate with it in the same run, on the same core and images: tags printed
onto both fingers (`cv2.aruco`, family 36h11, sub-pixel corners, `solvePnP`), and ViSP's model-based edge tracker
(`vpMbGenericTracker` with moving edges, the settings of its tutorial) on images without the lens's distortion, whose
removal isn't counted. For "hidden" a hand covers the whole view, for "lost" the gripper is outside it, again and
again, at 60 frames/s. "daemon" is a live camera in a process of its own, with recording; the time of its loop's thread
is processor time. "start" is `gripmon run` with a camera on the network, from the start of the process until a
subscriber has the first measured transform; "replay" is `gripmon replay`, less the time for reading and decoding files.

The slowest 1 % of "frame" share their core with the cause analysis: a lasting drift requests it in
one frame of 60, and it takes some 25 ms. In a trace of 6,000 frames, all above 3 ms came in such bursts of about six,
while `Monitor.process` alone stays below 2.7 ms. Neither a shorter switch interval between threads (0.05 ms) nor using
the result a second later changes this, and a lower priority of that thread makes it worse: on one core the operating
system's time slices decide. With a second core, as for "daemon", the 99th percentile is below twice the median.

The time to reach other processes is in [The network, measured](network.md), the cost of recording in
[Recording, measured](recording.md)."""


def as_markdown(results: dict[str, Any], options: str) -> str:
    """The page; ``options``: those that it was measured with, as they are typed."""
    parts = {name: of_plain(part) for name, part in results["parts"].items()}
    return (
        "\n\n".join(
            [
                "# Speed and memory",
                f"Written by `tools/bench latency{options} --out docs/results`.",
                "\n".join(f"- {line}" for line in machine_lines(results["machine"])),
                _METHOD,
                _table(parts),
                _missed(parts),
                "## Beside the figures",
                "\n".join(
                    f"- {name}: {note}" for name, part in parts.items() if name != PROFILE for note in part.notes
                ),
                *_profile(parts),
            ]
        )
        + "\n"
    )


def _table(parts: dict[str, Measured]) -> str:
    lines = ["| `--only` | | measured | to be reached | | beside it |", "| --- | --- | --- | --- | --- | --- |"]
    for name, part in parts.items():
        for row in part.rows:
            lines.append(f"| {name} | {row.what} | {row.figure} | {row.required} | {row.verdict} | {row.note} |")
            name = ""
    return "\n".join(lines)


def _missed(parts: dict[str, Measured]) -> str:
    missed = [
        f"{row.what} ({row.figure}, {row.required})" for part in parts.values() for row in part.rows if row.met is False
    ]
    if not missed:
        return "Nothing is missed."
    return "\n".join([f"Missed, {len(missed)}:", "", *(f"- {text}" for text in missed)])


def _profile(parts: dict[str, Measured]) -> list[str]:
    """What the time goes into."""
    if PROFILE not in parts:
        return []
    profile = parts[PROFILE]
    figures = "; ".join(f"{row.what}: {row.figure} ({row.note})" for row in profile.rows)
    text = "\n".join(profile.notes)
    return ["## What a frame's time goes into", f"{figures}.", f"```text\n{text}\n```"]
