"""``gripmon correct``: the best transform for every instant of recordings, knowing all of them."""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import common

if TYPE_CHECKING:
    from gripmon.analyse.smoother import Correction
    from gripmon.record.read import Collection, Recording

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

_SUFFIXES = (".jsonl", ".parquet", ".rrd")


@dataclass(frozen=True)
class CorrectedRun:
    """One run of a monitor, and what became of it; ``wanted_ns`` are the instants to write instead of its frames."""

    recording: Recording
    correction: Correction
    wanted_ns: Any = None


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
    suffix = out.suffix.lower()
    if suffix not in _SUFFIXES:
        raise common.CommandFailedError(
            f"--out {out}: its suffix says nothing; one of {', '.join(_SUFFIXES)}", common.EXIT_USAGE
        )
    if suffix == ".rrd" and arguments.stamps is not None:
        raise common.CommandFailedError(
            "--stamps: a track has its frames' times; .jsonl or .parquet", common.EXIT_USAGE
        )
    paths = [Path(text) for text in arguments.recordings]
    for path in paths:
        if not path.exists():
            raise common.CommandFailedError(
                f"{path}: there is no such file; a recording (.rrd), a folder of them, or estimates.jsonl",
                common.EXIT_USAGE,
            )
        if path.is_file() and out.exists() and path.samefile(out):
            raise common.CommandFailedError(f"--out {out}: is a recording to correct; another file", common.EXIT_USAGE)
    wanted_ns = None if arguments.stamps is None else _stamps(Path(arguments.stamps))
    common.make_directory(out.parent)
    if out.is_dir():
        raise common.CommandFailedError(f"--out {out}: is a folder; a file", common.EXIT_USAGE)
    from gripmon.record.read import open_recordings

    found = open_recordings(paths)
    if not found.recordings:
        files = any(path.suffix.lower() in (".rrd", ".jsonl") for path in paths)
        raise common.CommandFailedError(
            f"correct: {'; '.join(found.faults)}", common.EXIT_FAILED if files else common.EXIT_USAGE
        )
    for fault in found.faults:
        print(f"correct: {fault}", file=sys.stderr)
    _check_targets(out, _targets(out, len(found.recordings)))
    runs = _corrected(found, wanted_ns)
    targets = _targets(out, len(runs))
    _write(targets, runs, _inputs(found))
    for each in runs:
        print(_summary(each))
    for target in targets:
        print(f"written: {target}")
    return common.EXIT_DONE


def _targets(out: Path, runs: int) -> list[Path]:
    """The files that are written: one, but a track for each run where there are several."""
    if out.suffix.lower() != ".rrd" or runs < 2:
        return [out]
    return [out.with_name(f"{out.stem}-{number}{out.suffix}") for number in range(1, runs + 1)]


def _check_targets(out: Path, targets: list[Path]) -> None:
    """End the command before any work where it would replace a file that nobody named."""
    for target in targets:
        if target != out and target.exists():
            raise common.CommandFailedError(
                f"--out {out}: each of {len(targets)} runs gets a file of its own, and {target} is there already; "
                "another name",
                common.EXIT_USAGE,
            )


def _corrected(found: Collection, wanted_ns: Any) -> list[CorrectedRun]:
    """Each run by itself: between two anything may have happened."""
    from gripmon.analyse.smoother import STAGES

    runs: list[CorrectedRun] = []
    with common.progress_bar(STAGES * len(found.recordings), "stage") as step:
        for recording in found.recordings:
            for fault in recording.faults:
                print(f"correct: {fault}", file=sys.stderr)
            try:
                correction = correct_table(recording.frames, step)
            except ValueError as error:
                print(f"correct: {_name(recording)}: {error}; left out", file=sys.stderr)
                continue
            for fault in correction.faults:
                print(f"correct: {_name(recording)}: {fault}", file=sys.stderr)
            runs.append(CorrectedRun(recording, correction))
    if not runs:
        raise common.CommandFailedError("nothing was measured in the recordings; one with frames that were measured")
    return runs if wanted_ns is None else _distributed(runs, wanted_ns)


def correct_table(frames: Any, step: Any) -> Correction:
    """Correct the frames of a table (:class:`gripmon.record.read.FrameTable`)."""
    import numpy as np

    from gripmon.analyse.smoother import correct
    from gripmon.model.records import Origin

    count = len(frames)
    held = frames.ORIGINS.index(Origin.HELD.value)
    measured = np.isfinite(frames.cam_T_grip).all(axis=1) & (frames.source != held) & ~frames.refused
    poses = np.full((count, 4, 4), np.nan)
    if measured.any():
        from scipy.spatial.transform import Rotation

        length = np.linalg.norm(frames.cam_T_grip[:, 3:], axis=1)
        measured &= length > 0.0
        good = frames.cam_T_grip[measured]
        poses[measured] = np.eye(4)
        poses[measured, :3, :3] = Rotation.from_quat(good[:, 3:]).as_matrix()
        poses[measured, :3, 3] = good[:, :3]
    return correct(frames.stamp_ns, poses, frames.covariance, measured, step)


def _distributed(runs: list[CorrectedRun], wanted_ns: Any) -> list[CorrectedRun]:
    """Each instant to the runs that it lies in; those in none are counted."""
    import numpy as np

    out, known = [], np.zeros(len(wanted_ns), bool)
    for each in runs:
        stamps = each.correction.stamp_ns
        if (np.diff(stamps) < 0).any():
            print(f"correct: {_name(each.recording)}: time runs backwards: no instants of it", file=sys.stderr)
            continue
        inside = (wanted_ns >= stamps[0]) & (wanted_ns <= stamps[-1])
        known |= inside
        out.append(CorrectedRun(each.recording, each.correction, wanted_ns[inside]))
    if not known.any():
        raise common.CommandFailedError("--stamps: none of the capture times lies in the recordings")
    if not known.all():
        print(f"correct: {(~known).sum()} of {len(known)} capture times lie in no recording", file=sys.stderr)
    return out


def _stamps(path: Path) -> Any:
    """The column ``stamp_ns`` of a CSV file; a fault ends the command with exit code 2."""
    import csv

    import numpy as np

    def wrong(what: str) -> common.CommandFailedError:
        return common.CommandFailedError(f"--stamps {path}: {what}", common.EXIT_USAGE)

    stamps = []
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = csv.DictReader(file)
            if "stamp_ns" not in (rows.fieldnames or ()):
                raise wrong("has no column stamp_ns; a first line with the columns' names, capture times in Unix ns")
            for number, row in enumerate(rows, 2):
                text = (row["stamp_ns"] or "").strip()
                try:
                    stamps.append(int(text))
                    np.int64(stamps[-1])
                except (ValueError, OverflowError):
                    raise wrong(f"line {number}: '{text}' is no capture time; a whole number, Unix ns") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise wrong(f"can't be read ({getattr(error, 'strerror', None) or error})") from None
    if not stamps:
        raise wrong("holds no capture times")
    return np.array(stamps, np.int64)


def _inputs(found: Collection) -> list[tuple[str, str]]:
    """Names and SHA-256 of all files that were used."""
    files = sorted({path for recording in found.recordings for path in recording.files})
    out = []
    for path in files:
        with path.open("rb") as file:
            out.append((path.name, hashlib.file_digest(file, "sha256").hexdigest()))
    return out


def _write(targets: list[Path], runs: list[CorrectedRun], inputs: list[tuple[str, str]]) -> None:
    """Each file whole or not at all: what was there before stays until then."""
    from gripmon.cli import corrected

    for number, target in enumerate(targets):
        part = target.with_name(f".{target.name}.part")
        try:
            if target.suffix.lower() == ".jsonl":
                corrected.write_jsonl(part, runs, inputs)
            elif target.suffix.lower() == ".parquet":
                corrected.write_parquet(part, runs, inputs)
            else:
                from gripmon.record.write.track import write_track

                recording, about = runs[number].recording, corrected.provenance(runs, inputs)
                write_track(part, recording.recording_id, recording.frames, runs[number].correction, about)
            part.replace(target)
        except OSError as error:
            raise common.CommandFailedError(f"--out {target}: writing failed ({error.strerror or error})") from None
        finally:
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)


def _name(recording: Recording) -> str:
    return ", ".join(path.name for path in recording.files[:3]) + (", …" if len(recording.files) > 3 else "")


def _summary(each: CorrectedRun) -> str:
    import numpy as np

    correction = each.correction
    sigma_um = 1e6 * float(np.median(np.sqrt(np.einsum("nii->ni", correction.covariance)[:, :3].sum(axis=1))))
    count = len(correction.change_points)
    points = f"{count} change point{'s' * (count != 1)}"
    text = f"{_name(each.recording)}: {len(correction.stamp_ns)} frames, {points}, TCP to {sigma_um:.1f} µm (1σ)"
    for point in correction.change_points:
        size_mm = 1e3 * float(np.linalg.norm(point.size[:3]))
        turn_deg = np.degrees(float(np.linalg.norm(point.size[3:])))
        spread_ms = 1e-6 * (point.latest_ns - point.earliest_ns)
        seq = int(each.recording.frames.seq[point.index])
        text += f"\n  frame {seq} ({point.stamp_ns} ns, within {spread_ms:.0f} ms): {size_mm:.3f} mm, {turn_deg:.3f}°"
    return text
