"""``tools/bench offline``: the off-line calibrations on simulated images, held against the truth.

``cam_T_grip`` from one image of the gripper on a plate (Plane Coincidence Constraint) in the paper's geometry, with a
gripper that is known, inferred, and with the camera from the same image; a gripper that doesn't stand on the plate;
and cameras beside those that other libraries make of the same images.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.options import add_command, count, deliver

if TYPE_CHECKING:
    from benchmarks.offline_intrinsics import Fits, Found, Photographs
    from benchmarks.offline_plane import Errors, Revealed
    from gripmon.model.targets import Chequerboard

_DESCRIPTION = """\
Calibrations on simulated images: error of the tool centre point (TCP) by the plane coincidence constraint against the
plate's print, coverage of the stated covariance, what reveals a gripper that doesn't stand on the plate, and cameras
beside OpenCV's and COLMAP's from the same images.  Exit code 1 if a target is missed."""

ACROSS_MM, ALONG_MM = 0.02, 0.05
"""Largest error of the TCP across and along the optical axis, with a perfect plate."""
COVERAGE = (0.92, 0.98)
"""Part of the trials in which the truth is in the stated region of 95 %."""
_TRIALS, _REVEALED, _SETS, _IMAGES = 100, 40, 10, 12
_QUICK = (10, 4, 2, 8)
_NO_CLAIM = "single"
"""Its covariance is for principal points that aren't in the middle; in these trials all are."""


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = add_command(
        commands,
        "offline",
        run,
        "off-line calibrations against the truth",
        _DESCRIPTION,
        quick="a tenth of the trials",
        as_json="also write the figures",
        markdown=True,
    )
    parser.add_argument("--trials", type=count, metavar="N", help=f"images of each kind of plate (default: {_TRIALS})")
    parser.add_argument("--seed", type=count, default=1, help="first seed (default: 1)")
    parser.add_argument(
        "--photographs", nargs=2, metavar=("FOLDER", "COLUMNSxROWS"), help="also of a chequerboard with so many corners"
    )
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="draw the errors and what reveals a gap")


def run(arguments: argparse.Namespace) -> int:
    """Handle ``tools/bench offline``."""
    import cv2
    from tqdm import tqdm

    cv2.setNumThreads(1)
    try:
        board = _photographs(arguments.photographs)
    except ValueError as error:
        print(f"tools/bench offline: {error}", file=sys.stderr)
        return 2
    from benchmarks import offline_intrinsics, offline_plane

    sizes = _QUICK if arguments.quick else (_TRIALS, _REVEALED, _SETS, _IMAGES)
    trials, off, sets, images = (arguments.trials or sizes[0], *sizes[1:])
    with tqdm(total=2 * trials + 4 * off + sets, unit="trial", file=sys.stderr, disable=None) as bar:
        errors: list[Errors] = []
        for print_m in (0.0, offline_plane.PRINT_M):
            errors += offline_plane.trials(trials, arguments.seed, print_m, bar.update)
        revealed = offline_plane.revealed(off, arguments.seed, bar.update)
        fits, found = offline_intrinsics.compare(sets, images, arguments.seed, bar.update)
        photographs = offline_intrinsics.on_photographs(*board) if board else []
    faults = missed(errors)
    text = report(errors, revealed, fits, found, photographs, arguments.seed, faults)
    deliver(arguments, "offline", text, figures(errors, revealed, fits, found, photographs))
    if arguments.picture is not None:
        from benchmarks import offline_plots

        offline_plots.draw(errors, revealed, arguments.picture)
    return 1 if faults else 0


def _photographs(given: list[str] | None) -> tuple[Path, Chequerboard] | None:
    """A folder and its board.  Raises ValueError for words that are none."""
    from gripmon.model.targets import Chequerboard

    if given is None:
        return None
    counts = given[1].split("x")
    if len(counts) != 2 or not all(count.isdigit() and int(count) > 1 for count in counts):
        raise ValueError(f"--photographs: {given[1]!r} isn't a board; numbers of inner corners, as 9x6")
    if not Path(given[0]).is_dir():
        raise ValueError(f"--photographs: {given[0]} is no folder")
    return Path(given[0]), Chequerboard(int(counts[0]), int(counts[1]), 0.01)


def missed(errors: list[Errors]) -> list[str]:
    """What was to be reached and isn't, in words."""
    import numpy as np

    out = []
    for row in errors:
        if row.way == _NO_CLAIM:
            continue
        name = f"{row.plate} plate, {_WAY[row.way]}"
        if not row.error:
            out.append(f"{name}: no result at all")
            continue
        if row.plate == "perfect":
            worst = row.position_mm.max(axis=0)
            for axis, value, limit in zip("xyz", worst, (ACROSS_MM, ACROSS_MM, ALONG_MM), strict=True):
                if not value <= limit:
                    out.append(f"{name}: largest error in {axis} {value:.4f} mm; at most {limit:g}")
        covered = np.round(row.coverage, 3)
        if not COVERAGE[0] <= covered <= COVERAGE[1]:
            out.append(f"{name}: the truth is in the region of 95 % in {100 * covered:.0f} %; 92 to 98 %")
    return out


_WAY = {"known": "gripper known", "inferred": "gripper inferred", "single": "known, camera from the same image"}


def report(
    errors: list[Errors], revealed: list[Revealed], fits: list[Fits], found: list[Found],
    photographs: list[Photographs], seed: int, faults: list[str],
) -> str:  # fmt: skip
    """All tables, and what is missed."""
    parts = [
        f"first seed {seed}",
        _errors_table(errors),
        _revealed_table(revealed),
        _fits_table(fits),
        _found_table(found),
        *([_photographs_table(photographs)] if photographs else []),
        "\n".join(f"MISSED: {fault}" for fault in faults) or "every target is reached",
    ]
    return "\n\n".join(parts)


def _errors_table(errors: list[Errors]) -> str:
    import numpy as np

    lines = [
        "TCP error from one image, camera x, y, z (mm); coverage: of the stated region of 95 %",
        (
            f"{'plate':<17} {'way':<34} {'mean':>20} {'95 %':>20} {'largest':>20} {'stated sigma':>20} {'NEES/6':>6} "
            f"{'coverage':>8} {'results':>8}"
        ),
    ]
    for row in errors:
        total = len(row.error) + len(row.refused)
        cells = [f"{row.plate:<17} {_WAY[row.way]:<34}"]
        if row.error:
            size = row.position_mm
            claimed = 1e3 * np.mean(row.claimed_m, axis=0)
            columns = (size.mean(axis=0), np.quantile(size, 0.95, axis=0), size.max(axis=0), claimed)
            cells += [" ".join(f"{v:6.4f}" for v in values) for values in columns]
            cells.append(f"{np.mean(row.nees) / 6.0:6.2f} {100 * row.coverage:6.0f} %")
        lines.append(" ".join([*cells, f"{len(row.error):>4}/{total}"]))
    lines += [f"no result: {reason}" for row in errors for reason in row.refused]
    return "\n".join(lines)


def _revealed_table(revealed: list[Revealed]) -> str:
    import numpy as np

    lines = [
        (
            "a gripper that doesn't stand on the plate: fraction of images in which it is detected (p below "
            "0.001); power: of the best test, by all edges and by the corners alone"
        ),
        (
            f"{'':<30} {'noise, DN':>9} {'residuals':>10} {'tilt/gap':>9} {'power':>6} {'corners':>8} "
            f"{'tilt found x, y (degrees)':>28} "
            f"{'gap found (mm)':>17} {'TCP off by (mm)':>16}"
        ),
    ]
    for row in revealed:
        if not row.count:
            lines.append(f"{row.what:<30} {row.noise_dn:>9g} no result")
            continue
        apart = np.array(row.apart) * [np.degrees(1.0), np.degrees(1.0), 1e3]
        mean, scatter = apart.mean(axis=0), apart.std(axis=0)
        tilts = " ".join(f"{m:+.3f} ± {s:.3f}" for m, s in zip(mean[:2], scatter[:2], strict=True))
        lines.append(
            f"{row.what:<30} {row.noise_dn:>9g} {100 * row.by_residuals / row.count:>8.0f} % "
            f"{100 * row.by_apart / row.count:>7.0f} % {100 * np.mean(row.power):>4.0f} % "
            f"{100 * np.mean(row.corner_power):>6.0f} % {tilts:>28} {mean[2]:>+8.3f} ± {scatter[2]:.3f} "
            f"{np.mean(row.shift_mm):>16.4f}"
        )
    return "\n".join(lines)


def _fits_table(fits: list[Fits]) -> str:
    import numpy as np

    lines = [
        "a camera from the same images: root mean square errors (px); mapping: over the image, the best turn allowed",
        (
            f"{'':<22} {'fx':>7} {'fy':>7} {'cx':>7} {'cy':>7} {'mapping':>8} {'largest':>8} {'NEES/n':>7} "
            f"{'seconds':>8} {'failed':>6}"
        ),
    ]
    for row in fits:
        if not row.error:
            lines.append(f"{row.who:<22} no result")
            continue
        rms = np.sqrt(np.mean(np.square(row.error), axis=0))
        mapping = np.array(row.mapping_px)
        nees = f"{np.mean(row.nees):7.2f}" if row.nees else f"{'-':>7}"
        lines.append(
            f"{row.who:<22} {' '.join(f'{v:7.3f}' for v in rms)} {np.sqrt(np.mean(mapping**2)):8.4f} "
            f"{mapping.max():8.4f} {nees} {np.mean(row.seconds):8.2f} {row.failed:>6}"
        )
    return "\n".join(lines)


def _found_table(found: list[Found]) -> str:
    import numpy as np

    lines = ["plates found in the same images; root mean square of a corner's error, each axis, and of the worst tenth"]
    for row in found:
        each = 1e3 * row.seconds / max(row.images, 1)
        rms = np.sqrt(row.error_px2) if row.error_px2 else np.full(1, np.nan)
        lines.append(
            f"{row.who:<24} {row.found:>4} of {row.images}, {np.sqrt(np.mean(rms**2)):.4f} px, "
            f"{np.quantile(rms, 0.9):.4f} px, {each:.0f} ms an image"
        )
    return "\n".join(lines)


def _photographs_table(photographs: list[Photographs]) -> str:
    lines = ["photographs: what a lens leaves of the corners (root mean square, each axis) where everybody finds them"]
    lines += [
        f"{row.who:<24} {row.found:>4} of {row.images}, {row.residual_px:.4f} px in {row.common}" for row in photographs
    ]
    return "\n".join(lines)


def figures(
    errors: list[Errors], revealed: list[Revealed], fits: list[Fits], found: list[Found],
    photographs: list[Photographs],
) -> dict[str, Any]:  # fmt: skip
    """Everything, as JSON takes it."""
    return {
        "plane": [_plain(row) for row in errors],
        "apart": [_plain(row) for row in revealed],
        "cameras": [_plain(row) for row in fits],
        "found": [_plain(row) for row in found],
        "photographs": [_plain(row) for row in photographs],
    }


def _plain(row: Any) -> dict[str, Any]:
    from dataclasses import fields

    def plain(value: Any) -> Any:
        if isinstance(value, list):
            return [v.tolist() if hasattr(v, "tolist") else v for v in value]
        return value

    return {field.name: plain(getattr(row, field.name)) for field in fields(row)}
