"""``tools/bench series``: the self-viewing paper's two series of twenty image pairs, its tables beside ours.

A pair is what it is in the paper: a reference calibration, a disturbance of the camera, an estimate from the image
after it, and the comparison of the tool centre point (TCP) in the camera frame with what it really is.  But

- in place of the paper's off-line calibration (plane coincidence constraint, PCC) stands the true pose of the first
  image; in place of the second such calibration, which the estimate is held against, that of the second image.  The
  printed figures contain the errors of both calibrations, ours don't;
- the camera's intrinsics and the jaw opening, the same in both images, are the true ones.

As in the paper, the corners that were *measured* in the first image serve as the model: each is projected back onto
the plane that the reference calibration gives it (equation 8, from its known height in the gripper frame), and the
update starts from these points, so that what shifts a corner in both images alike cancels.  Weights of equation (17)
and of the recalibration come from the covariances of both measurements.  The edges are sampled at every pixel; all
other settings are the monitor's defaults.  A pair in which a variant doesn't find enough
corners in both images counts as missed.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from typing import Any

from benchmarks import options

_DESCRIPTION = """\
Runs the two series of image pairs of the self-viewing paper (gripmon simulate series1, series2; and the rendered one
beside the checkout, if it is there): mean and largest error of the TCP for updates with 3, 4, 5 and all corners, for
recalibrations with 4 and 5, and for all edge points, in the paper's layout, beside its printed figures."""

Six = tuple[float, float, float, float, float, float]

PRINTED: dict[str, dict[str, Six]] = {
    "series1": {
        "3P-U": (0.23, 0.08, 0.38, 0.29, 0.09, 0.54),
        "4P-U": (0.02, 0.00, 0.04, 0.03, 0.01, 0.07),
        "5P-U": (0.02, 0.01, 0.05, 0.04, 0.02, 0.09),
        "4P-R": (0.07, 0.01, 0.15, 0.10, 0.01, 0.29),
        "5P-R": (0.07, 0.01, 0.17, 0.09, 0.02, 0.29),
    },
    "series2": {
        "3P-U": (0.22, 0.08, 0.54, 0.26, 0.09, 0.64),
        "4P-U": (0.02, 0.01, 0.21, 0.03, 0.02, 0.27),
        "5P-U": (0.02, 0.01, 0.24, 0.04, 0.02, 0.31),
        "4P-R": (0.09, 0.02, 0.07, 0.13, 0.03, 0.13),
        "5P-R": (0.09, 0.02, 0.09, 0.10, 0.03, 0.17),
    },
}
"""The paper's tables: mean error in camera x, y, z, then the largest, mm."""

VARIANTS = ("3P-U", "4P-U", "5P-U", "all-U", "4P-R", "5P-R", "edges")
"""The paper's variants, all corners, and all edge points at once instead of corners."""

REQUIRED = "4P-U"
"""The variant whose cells must be at most a quarter of the printed ones …"""
REQUIRED_SHARE = 0.25
ZERO_PRINTED_MM = 0.003
"""… and below this where 0.00 is printed."""


@dataclass(frozen=True, slots=True)
class Row:
    """One line of a table: errors of the TCP over the pairs that were ``estimated`` out of ``pairs``, mm; means in
    camera x, y, z, then maxima; None where no pair was.  ``printed_mm``: the paper's line, if it has one.
    ``limit_mm``: what is required of each cell.
    """

    series: str
    scene: str
    variant: str
    error_mm: Six | None
    printed_mm: Six | None
    limit_mm: Six | None
    estimated: int
    pairs: int

    @property
    def met(self) -> bool | None:
        """Whether every cell keeps its limit, over all pairs; None without limits."""
        if self.limit_mm is None:
            return None
        if self.error_mm is None or self.estimated < self.pairs:
            return False
        return all(e <= limit for e, limit in zip(self.error_mm, self.limit_mm, strict=True))


def limits_mm(printed_mm: Six) -> Six:
    """What is required of a line of which the paper prints this."""
    x, y, z, X, Y, Z = (REQUIRED_SHARE * p if p > 0.0 else ZERO_PRINTED_MM for p in printed_mm)
    return x, y, z, X, Y, Z


def tables(seed: int = 1, progress: Callable[[], object] = lambda: None) -> list[Row]:
    """All lines of all tables; ``progress`` is called after each pair."""
    from benchmarks import pairs

    rows = []
    for series in pairs.all_series(seed):
        errors_mm = pairs.measure(series, VARIANTS, progress)
        rows += [_row(series.name, series.scene, v, errors_mm[v], len(series)) for v in VARIANTS]
    return rows


def _row(series: str, scene: str, variant: str, errors_mm: list[tuple[float, float, float]], pairs: int) -> Row:
    error_mm: Six | None = None
    if errors_mm:
        means = [sum(abs(e[k]) for e in errors_mm) / len(errors_mm) for k in range(3)]
        largest = [max(abs(e[k]) for e in errors_mm) for k in range(3)]
        error_mm = (means[0], means[1], means[2], largest[0], largest[1], largest[2])
    printed_mm = PRINTED[series].get(variant)
    limit_mm = limits_mm(printed_mm) if printed_mm is not None and variant == REQUIRED else None
    return Row(series, scene, variant, error_mm, printed_mm, limit_mm, len(errors_mm), pairs)


def markdown(rows: Iterable[Row]) -> str:
    """The tables for people, in the paper's layout: ours, and the printed figure in parentheses; mm."""
    parts: list[str] = []
    titled: tuple[str, str] | None = None
    for row in rows:
        if titled != (row.series, row.scene):
            titled = (row.series, row.scene)
            parts += [*([""] if parts else []), f"**{_TITLES[row.series]}; {row.scene}**", "", *_HEAD]
        parts.append(_line(row))
    return "\n".join(parts)


_TITLES = {
    "series1": "Series 1, TCP moves along camera x by 1.5 ± 0.3 mm",
    "series2": "Series 2, TCP moves along camera y by 4.5 ± 0.2 mm",
}
_HEAD = (
    "| ours (printed), mm | mean x | mean y | mean z | max x | max y | max z | pairs |",
    "| --- | --- | --- | --- | --- | --- | --- | --- |",
)


def _line(row: Row) -> str:
    cells = ["—"] * 6 if row.error_mm is None else [f"{e:.4f}" for e in row.error_mm]
    if row.limit_mm is not None and row.error_mm is not None:
        over = [e > limit for e, limit in zip(row.error_mm, row.limit_mm, strict=True)]
        cells = [f"**{cell}**" if too_large else cell for cell, too_large in zip(cells, over, strict=True)]
    if row.printed_mm is not None:
        cells = [f"{cell} ({p:.2f})" for cell, p in zip(cells, row.printed_mm, strict=True)]
    return f"| {row.variant} | {' | '.join(cells)} | {row.estimated} of {row.pairs} |"


def verdicts(rows: Iterable[Row]) -> list[str]:
    """One sentence for each line of which something is required."""
    out = []
    for row in rows:
        if row.met is None or row.limit_mm is None:
            continue
        name = f"{row.series}, {row.scene}, {row.variant}"
        if row.met:
            out.append(f"{name}: every cell at most a quarter of the printed one")
        elif row.estimated < row.pairs:
            out.append(f"{name}: NOT MET, {row.pairs - row.estimated} of {row.pairs} pairs without an estimate")
        else:
            assert row.error_mm is not None
            cells = zip(_CELLS, row.error_mm, row.limit_mm, strict=True)
            over = ", ".join(f"{cell} {e:.4f} > {limit:.4f} mm" for cell, e, limit in cells if e > limit)
            out.append(f"{name}: NOT MET: {over}")
    return out


_CELLS = ("mean x", "mean y", "mean z", "max x", "max y", "max z")


def add_parser(commands: Any) -> None:
    """Add the benchmark to ``tools/bench``."""
    options.add_command(
        commands,
        "series",
        run,
        "the self-viewing paper's two series of image pairs, its tables beside ours",
        _DESCRIPTION,
        seed=True,
        as_json="write all lines, mm",
    )


def run(arguments: argparse.Namespace) -> int:
    """Handle ``tools/bench series``."""
    from tqdm import tqdm

    from benchmarks import machine

    about = machine.description()
    with tqdm(desc="pairs", unit="pair", file=sys.stderr, disable=None) as bar:
        rows = tables(arguments.seed, bar.update)
    print(f"gripmon {about['commit']}, {about['date']}, {about['cpu']}; seed {arguments.seed}\n")
    text = "\n".join((markdown(rows), "", *verdicts(rows)))
    lines = [{**asdict(row), "met": row.met} for row in rows]
    options.deliver(arguments, "series", text, {"machine": about, "rows": lines})
    return 0
