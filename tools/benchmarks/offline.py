"""The off-line calibrations on simulated images, held against the truth.

``cam_T_grip`` from one image of the gripper on a plate (Plane Coincidence Constraint) in the paper's geometry, with a
gripper that is known, inferred, and with the camera from the same image: error of the tool centre point (TCP) against
the plate's print, and coverage of the stated covariance; what reveals a gripper that doesn't stand on the plate; and
cameras beside those that OpenCV and COLMAP make of the same images.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from benchmarks import kit, offline_intrinsics, offline_plane
from benchmarks.kit import Report, Target
from benchmarks.offline_intrinsics import Fits, Found, Photographs
from benchmarks.offline_plane import Errors, Revealed
from gripmon.model.targets import Chequerboard

ACROSS_MM, ALONG_MM = 0.02, 0.05
"""Largest error of the TCP across and along the optical axis, with a perfect plate."""
COVERAGE = (0.92, 0.98)
"""Part of the trials in which the truth is in the stated region of 95 %."""
_FULL, _QUICK = (100, 40, 10, 12), (10, 4, 2, 8)
"""Images of each kind of plate; of each that reveals a gap; sets of images for a camera, and images of a set."""
_NO_CLAIM = "single"
"""Its covariance is for principal points that aren't in the middle; in these trials all are."""
_WAY = {"known": "gripper known", "inferred": "gripper inferred", "single": "known, camera from the same image"}


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--quick", action="store_true", help="a tenth of the trials")
    what = f"images of each kind of plate (default {_FULL[0]})"
    parser.add_argument("--trials", type=kit.count, metavar="N", help=what)
    parser.add_argument("--seed", type=kit.count, default=1, metavar="N", help="first seed (default 1)")
    parser.add_argument(
        "--photographs", nargs=2, metavar=("FOLDER", "COLUMNSxROWS"), help="also of a chequerboard with so many corners"
    )


def run(arguments: argparse.Namespace, report: Report) -> None:
    cv2.setNumThreads(1)
    board = None if arguments.photographs is None else _board(*arguments.photographs)
    sizes = _QUICK if arguments.quick else _FULL
    trials, off, sets, images = (arguments.trials or sizes[0], *sizes[1:])
    report.say(f"first seed {arguments.seed}")
    errors: list[Errors] = []
    with kit.bar("trial", 2 * trials + 4 * off + sets) as bar:
        for print_m in (0.0, offline_plane.PRINT_M):
            errors += offline_plane.trials(trials, arguments.seed, print_m, bar.update)
        _say_errors(errors, report)
        revealed = offline_plane.revealed(off, arguments.seed, bar.update)
        _say_revealed(revealed, report)
        fits, found = offline_intrinsics.compare(sets, images, arguments.seed, bar.update)
        _say_cameras(fits, found, report)
    photographs = offline_intrinsics.on_photographs(*board) if board else []
    if photographs:
        _say_photographs(photographs, report)
    report.values |= {
        "plane": errors, "apart": revealed, "cameras": fits, "found": found, "photographs": photographs,
    }  # fmt: skip
    report.reach(targets(errors))


def _board(folder: str, size: str) -> tuple[Path, Chequerboard]:
    counts = size.split("x")
    if len(counts) != 2 or not all(count.isdigit() and int(count) > 1 for count in counts):
        raise kit.Refused(f"--photographs: {size!r} isn't a board; numbers of inner corners, as 9x6")
    if not Path(folder).is_dir():
        raise kit.Refused(f"--photographs: {folder} is no folder")
    return Path(folder), Chequerboard(int(counts[0]), int(counts[1]), 0.01)


def targets(errors: list[Errors]) -> Iterator[Target]:
    """Of each kind of plate and way: the largest errors with a perfect plate, and the coverage."""
    for row in errors:
        name = f"{row.plate} plate, {_WAY[row.way]}"
        if row.way == _NO_CLAIM:
            continue
        if not row.error:
            yield Target(f"{name}: a result", "none at all", False)
            continue
        if row.plate == "perfect":
            worst = row.position_mm.max(axis=0)
            for axis, value, limit in zip("xyz", worst, (ACROSS_MM, ACROSS_MM, ALONG_MM), strict=True):
                yield Target(f"{name}: largest error in {axis} at most {limit:g} mm", f"{value:.4f} mm", value <= limit)
        covered = round(row.coverage, 3)
        what = f"{name}: the truth is in the region of 95 % in 92 to 98 %"
        yield Target(what, f"{100 * covered:.0f} %", COVERAGE[0] <= covered <= COVERAGE[1])


def _say_errors(errors: list[Errors], report: Report) -> None:
    lines = []
    for row in errors:
        cells = [f"{row.plate}, {_WAY[row.way]}", *[""] * 6]
        if row.error:
            size = row.position_mm
            claimed = 1e3 * np.mean(row.claimed_m, axis=0)
            columns = (size.mean(axis=0), np.quantile(size, 0.95, axis=0), size.max(axis=0), claimed)
            cells[1:5] = [" ".join(f"{v:.4f}" for v in values) for values in columns]
            cells[5:] = [f"{np.mean(row.nees) / 6.0:.2f}", f"{100 * row.coverage:.0f} %"]
        lines.append([*cells, f"{len(row.error)}/{len(row.error) + len(row.refused)}"])
    head = ("plate, way", "mean", "95 %", "largest", "stated sigma", "NEES/6", "coverage", "results")
    report.say(
        "TCP error from one image, camera x, y, z (mm); coverage: of the stated region of 95 %", kit.table(head, lines)
    )
    refused = [f"no result: {reason}" for row in errors for reason in row.refused]
    if refused:
        report.say("\n".join(refused))


def _say_revealed(revealed: list[Revealed], report: Report) -> None:
    lines = []
    for row in revealed:
        if not row.count:
            lines.append([row.what, f"{row.noise_dn:g}", "no result"])
            continue
        apart = np.array(row.apart) * [np.degrees(1.0), np.degrees(1.0), 1e3]
        spread = zip(apart.mean(axis=0), apart.std(axis=0), strict=True)
        tilt_x, tilt_y, gap = (f"{mean:+.3f} ± {sigma:.3f}" for mean, sigma in spread)
        shares = (row.by_residuals / row.count, row.by_apart / row.count, np.mean(row.power), np.mean(row.corner_power))
        cells = (f"{100 * share:.0f} %" for share in shares)
        off = f"{np.mean(row.shift_mm):.4f}"
        lines.append([row.what, f"{row.noise_dn:g}", *cells, f"{tilt_x} {tilt_y}", gap, off])
    head = (
        "", "noise, DN", "residuals", "tilt/gap", "power", "corners", "tilt found x, y (degrees)", "gap found (mm)",
        "TCP off by (mm)",
    )  # fmt: skip
    report.say(
        "a gripper that doesn't stand on the plate: fraction of images in which it is detected (p below 0.001); power: "
        "of the best test, by all edges and by the corners alone",
        kit.table(head, lines),
    )


def _say_cameras(fits: list[Fits], found: list[Found], report: Report) -> None:
    lines = []
    for row in fits:
        if not row.error:
            lines.append([row.who, "no result"])
            continue
        mapping = np.array(row.mapping_px)
        nees = f"{np.mean(row.nees):.2f}" if row.nees else "-"
        errors = (f"{v:.3f}" for v in kit.rms(row.error, axis=0))
        mapped = [f"{kit.rms(mapping):.4f}", f"{mapping.max():.4f}"]
        lines.append([row.who, *errors, *mapped, nees, f"{np.mean(row.seconds):.2f}", row.failed])
    head = ("", "fx", "fy", "cx", "cy", "mapping", "largest", "NEES/n", "seconds", "failed")
    report.say(
        "a camera from the same images: root mean square errors (px); mapping: over the image, the best turn allowed",
        kit.table(head, lines),
    )
    lines = []
    for each in found:
        rms = np.sqrt(each.error_px2) if each.error_px2 else np.full(1, np.nan)
        corners = [f"{np.sqrt(np.mean(rms**2)):.4f}", f"{np.quantile(rms, 0.9):.4f}"]
        ms = f"{1e3 * each.seconds / max(each.images, 1):.0f}"
        lines.append([each.who, f"{each.found} of {each.images}", *corners, ms])
    report.say(
        "plates found in the same images; root mean square of a corner's error, each axis, and of the worst tenth",
        kit.table(("", "found", "px", "worst tenth, px", "ms an image"), lines),
    )


def _say_photographs(photographs: list[Photographs], report: Report) -> None:
    lines = [[p.who, f"{p.found} of {p.images}", f"{p.residual_px:.4f}", p.common] for p in photographs]
    report.say(
        "photographs: what a lens leaves of the corners (root mean square, each axis) where everybody finds them",
        kit.table(("", "found", "px", "in"), lines),
    )
