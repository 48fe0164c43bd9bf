"""``gripmon correct``: the best transform for every instant of recordings, knowing all of them."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import common
from gripmon.model.errors import InputError

if TYPE_CHECKING:
    from gripmon.analyse.api import CorrectedRun

_DESCRIPTION = """\
Estimate cam_T_grip for every frame of a recording once more, from all frames before and after it:
for data that was recorded with a stale calibration.  A step stays a step, and is placed in the
frame in which it happened.  FILE's suffix says what is written:

  .jsonl    one line about the recordings and the change points, then one line a frame
  .parquet  the same as a table, units in the columns' names
  .rrd      a track of transforms that a viewer lays over the recording (open both); several runs
            get a file each, FILE-1.rrd and on

Covariances say what is left: also what frames claim and averaging can't take away."""

_EXAMPLES = """\
  gripmon correct recordings/arm1-0001.rrd --out corrected.jsonl
  gripmon correct recordings/ --out corrected.parquet
  gripmon correct estimates.jsonl --out corrected.jsonl --stamps shots.csv

exit codes: 0 done; 2 wrong usage; 3 nothing measured in the recordings; 130 interrupted"""


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = common.add_command(
        commands,
        "correct",
        run,
        "the best transform for every instant, knowing the whole recording",
        _DESCRIPTION,
        _EXAMPLES,
    )
    parser.add_argument(
        "recordings",
        metavar="RECORDING",
        nargs="+",
        help="recordings (.rrd), folders of them with all below, or estimates.jsonl",
    )
    parser.add_argument("--out", required=True, metavar="FILE", help="FILE.jsonl, FILE.parquet or FILE.rrd")
    parser.add_argument(
        "--stamps",
        metavar="FILE.csv",
        help="give the transform at these capture times instead of the frames': a column stamp_ns (Unix ns)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon correct``."""
    out = Path(arguments.out)
    if out.suffix.lower() == ".rrd" and arguments.stamps is not None:
        raise InputError("--stamps: a track has its frames' times; .jsonl or .parquet")
    common.make_directory(out.parent)
    if out.is_dir():
        raise InputError(f"--out {out}: is a folder; a file")
    from gripmon.analyse.api import correct

    done = correct(arguments.recordings, out, stamps=arguments.stamps, progress=common.progress_bar)
    for fault in done.faults:
        print(f"correct: {fault}", file=sys.stderr)
    for each in done.runs:
        print(_summary(each))
    for path in done.written:
        print(f"written: {path}")
    return common.EXIT_DONE


def _summary(each: CorrectedRun) -> str:
    import numpy as np

    correction = each.correction
    sigma_um = 1e6 * float(np.median(np.sqrt(np.einsum("nii->ni", correction.covariance)[:, :3].sum(axis=1))))
    count = len(correction.change_points)
    points = f"{count} change point{'s' * (count != 1)}"
    text = f"{each.name}: {len(correction.stamp_ns)} frames, {points}, TCP to {sigma_um:.1f} µm (1σ)"
    for point in correction.change_points:
        size_mm = 1e3 * float(np.linalg.norm(point.size[:3]))
        turn_deg = np.degrees(float(np.linalg.norm(point.size[3:])))
        spread_ms = 1e-6 * (point.latest_ns - point.earliest_ns)
        seq = int(each.recording.frames.seq[point.index])
        text += f"\n  frame {seq} ({point.stamp_ns} ns, within {spread_ms:.0f} ms): {size_mm:.3f} mm, {turn_deg:.3f}°"
    return text
