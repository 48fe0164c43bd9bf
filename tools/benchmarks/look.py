"""``tools/bench look``: the same frames through the monitor without and with the gripper's look as a measurement."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np

from benchmarks import options
from benchmarks.accuracy_runs import Row, judge
from benchmarks.conditions import CONDITIONS
from benchmarks.look_motions import HEAD as MOTIONS_HEAD
from benchmarks.look_motions import MOTIONS, motion_row
from benchmarks.rendered import all_row_names, sequences
from benchmarks.scenes import Sequence, Shot, make_scene
from gripmon.judge.drift import DriftSettings
from gripmon.model.geometry import to_record
from gripmon.model.records import Array, ReferenceRecord
from gripmon.monitor import Monitor, MonitorSettings
from gripmon.monitor.settings import LookSettings

FRAMES = 150
"""Of a simulated scene: five seconds, of which the look is learnt in the first."""

_HEAD = (
    "| sequence | frames | scatter without | with | mean error without | with | NEES | valid | misleading | ms |\n"
    "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"
)


def add_parser(commands: Any) -> None:
    """Add the benchmark to ``tools/bench``."""
    parser = options.add_command(
        commands, "look", run, "the gripper's look as a measurement, beside the edges alone", __doc__ or "", seed=True
    )
    parser.add_argument("--only", nargs="+", metavar="NAME", help="these rows: conditions, rendered sequences, motions")
    parser.add_argument("--scenes", type=int, default=2, metavar="N", help="simulated scenes of a condition")
    parser.add_argument(
        "--motions", action="store_true", help="instead: frames until small motions of the mount are noticed"
    )
    parser.add_argument("--frames", type=int, default=FRAMES, metavar="N", help="of a simulated scene")


def run(arguments: argparse.Namespace) -> int:
    """Prints a table; TCP errors in micrometres, x / y / z of the camera."""
    if arguments.motions:
        print(MOTIONS_HEAD)
        for motion in MOTIONS:
            if not arguments.only or motion.name in arguments.only:
                print(motion_row(motion, arguments.seed, arguments.scenes, _monitors), flush=True)
        return 0
    print(_HEAD)
    for name, sequence in _rows(arguments):
        print(f"look: {name}", file=sys.stderr)
        print(compared(name, sequence), flush=True)
    return 0


def _rows(arguments: argparse.Namespace) -> Iterator[tuple[str, Sequence]]:
    wanted = arguments.only
    for row in all_row_names():
        if (row in wanted) if wanted else (row.endswith("true jaw") and "clean" not in row and "series2" not in row):
            yield from ((row, sequence) for sequence in sequences(row))
    for condition in CONDITIONS:
        if condition.name in wanted if wanted else condition.name not in ("clean", "standing", "hand"):
            for number in range(arguments.scenes):
                yield (
                    f"{condition.name}, {number}",
                    make_scene(condition, arguments.seed, number, arguments.frames),
                )


def compared(name: str, sequence: Sequence) -> str:
    """A line of the table: frames from the first that differs, valid both ways; why not, if there are none."""
    both = _Both(sequence)
    for index, shot in enumerate(sequence.shots()):
        both.add(index, shot)
    without, with_look = both.rows
    same = [np.array_equal(a.error, b.error, equal_nan=True) for a, b in zip(without, with_look, strict=True)]
    if all(same):
        return f"| {name} | 0 | the look was never used |"
    after = range(same.index(False), len(same))
    use = [i for i in after if without[i].valid and with_look[i].valid]
    if not use:
        counts = " → ".join(str(sum(row.valid for row in rows)) for rows in both.rows)
        return f"| {name} | 0 | no frame is valid both ways ({counts}) |"
    errors = [1e6 * np.array([rows[i].error[:3] for i in use]) for rows in both.rows]
    cells = [
        name,
        str(len(use)),
        *(_three(e.std(axis=0)) for e in errors),
        *(_three(np.abs(e).mean(axis=0)) for e in errors),
        " → ".join(f"{np.mean([rows[i].nees for i in use]):.1f}" for rows in both.rows),
        " → ".join(str(sum(row.valid for row in rows)) for rows in both.rows),
        " → ".join(str(count) for count in both.misleading),
        " → ".join(f"{np.median([row.time_ms for row in rows]):.1f}" for rows in both.rows),
    ]
    return f"| {' | '.join(cells)} |"


def _monitors(sequence: Sequence) -> list[Monitor]:
    """One without the look, one with it."""
    covariance = tuple(sequence.start_covariance.ravel().tolist())
    reference = ReferenceRecord("start", 0, 0, "configuration", to_record(sequence.start_cam_T_grip), covariance)
    settings = MonitorSettings(drift=DriftSettings(frames_per_s=sequence.fps))
    if sequence.jaw_sigma_m is not None:
        settings = msgspec.structs.replace(settings, jaw_sigma_m=sequence.jaw_sigma_m)
    each = [msgspec.structs.replace(settings, look=LookSettings(enabled=enabled)) for enabled in (False, True)]
    return [Monitor(sequence.camera, sequence.gripper, one, reference, sequence.taught) for one in each]


class _Both:
    """Two monitors on one sequence, frame by frame."""

    def __init__(self, sequence: Sequence) -> None:
        self._monitors = _monitors(sequence)
        self.rows: tuple[list[Row], list[Row]] = ([], [])
        self.misleading = [0, 0]

    def add(self, index: int, shot: Shot) -> None:
        for k, monitor in enumerate(self._monitors):
            start_ns = time.thread_time_ns()
            record = monitor.process(shot.frame)
            time_ms = 1e-6 * (time.thread_time_ns() - start_ns)
            monitor.learn()
            row = judge(record, shot, 0, index, time_ms)
            self.rows[k].append(row)
            self.misleading[k] += row.misleading


def _three(values: Array) -> str:
    return " / ".join(f"{value:.1f}" for value in values)
