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
subscriber has the first measured transform; "memory" is that process's above one that has only imported the
libraries; "replay" is `gripmon replay`, less the time for reading and decoding files.

The slowest 1 % of "frame" share their core with the cause analysis: a lasting drift requests it in
one frame of 60, and it takes some 25 ms. In a trace of 6,000 frames, all above 3 ms came in such bursts of about six,
while `Monitor.process` alone stays below 2.7 ms. Neither a shorter switch interval between threads (0.05 ms) nor using
the result a second later changes this, and a lower priority of that thread makes it worse: on one core the operating
system's time slices decide. With a second core, as for "daemon", the 99th percentile is below twice the median.

The time to reach other processes is in [The network, measured](network.md), the cost of recording in
[Recording, measured](recording.md)."""


_START = """\
## Start and memory

Measured on 2026-11-29 beside other work (load average 5 to 9 on two cores, so that only processor time and memory tell
something) by `tools/bench latency --only start memory`, before and after machine code was loaded without the bitcode
that only later callers need, `scipy.linalg`, `http` and a collection of garbage were left out of the start:

| | before | after |
| --- | --- | --- |
| start of `gripmon run` to its first transform, processor time | 1.27 s | 0.88 to 1.03 s |
| of it loading machine code | 0.52 s | 0.28 s |
| memory of `gripmon run`, resident | 305 MB | 270 MB |
| `import numba, cv2, scipy, zenoh` alone, resident | 118 MB | 118 MB |
| above that, resident (at most 100 MB are aimed at) | 186 MB | 151 MB |
| above that, shared pages by share | 123 MB | 90 MB |

The 270 MB are 72 MB of LLVM's own library (numba's import alone reads half of it, loading code the rest), 100 MB of
data, 17 MB of memory that Zenoh shares with its peers, and other libraries. Pages of libraries are given back when
memory is short. From the fourth second to the twentieth it grows by 1 MB. The recording is a process of its own."""


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
                _START,
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
