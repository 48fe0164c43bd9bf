"""A calibration target as a page to print: PDF in true size, with a bar to check against a ruler.

Written without a PDF library: rectangles, discs and two lines of text take forty lines, and their positions must be
exact to micrometres.  "PDF Reference", sixth edition, 1.7, Adobe 2006 (ISO 32000-1).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from gripmon import __version__
from gripmon.calibrate.markers import dictionary_of
from gripmon.model.errors import InputError
from gripmon.model.targets import Charuco, CircleGrid, Target, TargetError, name_of

_PAPERS_MM = {
    "a5": (148.0, 210.0), "a4": (210.0, 297.0), "a3": (297.0, 420.0), "a2": (420.0, 594.0), "a1": (594.0, 841.0),
    "a0": (841.0, 1189.0), "letter": (215.9, 279.4), "legal": (215.9, 355.6), "tabloid": (279.4, 431.8),
}  # fmt: skip
"""ISO 216 and ANSI/ASME Y14.1."""
_MARGIN_MM = 7.0
"""Common printers leave 3 to 6.4 mm white at each border."""
_FOOT_MM = 16.0
"""Space below the pattern, for the bar and the text."""
_DESCENT_MM = 1.0
"""Descent of 8-point letters below their baseline."""
_BAR_MM = (200.0, 150.0, 100.0, 50.0)
_POINTS_PER_MM = 72.0 / 25.4
_ROUND = 4.0 / 3.0 * (np.sqrt(2.0) - 1.0)
"""Bezier handles of a quarter circle, in radii; they deviate from the circle by at most 0.03 % of the radius."""


@dataclass(frozen=True, slots=True)
class PrintedTarget:
    """``pdf``: the file; ``paper_mm``: paper size in its orientation; ``bar_mm``: nominal length of the printed bar."""

    pdf: bytes
    paper_mm: tuple[float, float]
    bar_mm: float


def paper_size(text: str) -> tuple[float, float]:
    """Width and height (mm) of a paper by its name, or of "WIDTHxHEIGHT" in mm.  Raises
    :class:`~gripmon.model.errors.InputError`.
    """
    if text.lower() in _PAPERS_MM:
        return _PAPERS_MM[text.lower()]
    right = f"{', '.join(_PAPERS_MM)} or WIDTHxHEIGHT in mm, e.g. 300x200"
    found = re.fullmatch(r"(\d+(?:\.\d*)?)x(\d+(?:\.\d*)?)", text)
    if found is None:
        raise InputError(f"'{text}' isn't a paper size; {right}", "paper")
    width, height = float(found[1]), float(found[2])
    if not (min(width, height) >= 50.0 and max(width, height) <= 5000.0):
        raise InputError(f"{text} mm isn't a paper size, which has 50 to 5000 mm a side; {right}", "paper")
    return width, height


def print_target(target: Target, paper: str = "a4") -> PrintedTarget:
    """A page with the target in its middle, in portrait or landscape, whichever fits.

    Raises :class:`~gripmon.model.errors.InputError` for an unknown or too small paper, and
    :class:`~gripmon.model.targets.TargetError` for an unknown dictionary.
    """
    sheet = paper_size(paper)
    width, height = size_mm(target)
    fits = [
        turned
        for turned in (sheet, sheet[::-1])
        if width + 2 * _MARGIN_MM <= turned[0] and height + 2 * _MARGIN_MM + _FOOT_MM <= turned[1]
    ]
    if not fits:
        needs = f"{width + 2 * _MARGIN_MM:.0f} x {height + 2 * _MARGIN_MM + _FOOT_MM:.0f} mm with margins and bar"
        wrong = f"{paper}: {sheet[0]:g} x {sheet[1]:g} mm is too small for {name_of(target)}, which needs {needs}"
        raise InputError(f"{wrong}; a larger paper, or a target with fewer or smaller points", "paper")
    paper_mm = fits[0]
    left, top = (paper_mm[0] - width) / 2, _MARGIN_MM + (paper_mm[1] - height - 2 * _MARGIN_MM - _FOOT_MM) / 2
    bar_mm = next((b for b in _BAR_MM if b <= paper_mm[0] - 2 * _MARGIN_MM), 20.0)
    marks = [_Page(paper_mm).shape(points, left, top) for points in _shapes(target)]
    foot = _foot(target, paper_mm, bar_mm)
    return PrintedTarget(_pdf(paper_mm, "\n".join([*marks, *foot])), paper_mm, bar_mm)


def size_mm(target: Target) -> tuple[float, float]:
    """Width and height of the printed pattern (mm)."""
    if isinstance(target, CircleGrid):
        step, disc = 1e3 * target.step_m, 1e3 * target.diameter_m
        right, below = target.last
        return right * step + disc, below * step + disc
    more = 0 if isinstance(target, Charuco) else 1
    return (target.columns + more) * 1e3 * target.square_m, (target.rows + more) * 1e3 * target.square_m


_Shape = tuple[str, Sequence[float]]
"""("disc", (x, y, radius)) or ("box", (x, y, width, height)), mm from the pattern's upper left corner, y down."""


def _shapes(target: Target) -> Iterator[_Shape]:
    if isinstance(target, CircleGrid):
        step, radius = 1e3 * target.step_m, 5e2 * target.diameter_m
        for x, y in target.places:
            yield "disc", (radius + step * x, radius + step * y, radius)
        return
    if isinstance(target, Charuco):
        yield from _marked_squares(target)
        return
    side = 1e3 * target.square_m
    for row, column in np.ndindex(target.rows + 1, target.columns + 1):
        if (row + column) % 2 == 0:
            yield "box", (side * column, side * row, side, side)


def _marked_squares(target: Charuco) -> Iterator[_Shape]:
    """Boxes of OpenCV's board: the markers' dark cells, and the squares without a marker."""
    dictionary = dictionary_of(target.dictionary)
    cells = dictionary.markerSize + 2
    if target.columns * target.rows // 2 > len(dictionary.bytesList):
        count = len(dictionary.bytesList)
        raise TargetError(f"{name_of(target)} needs more marks than the dictionary's {count}; a larger dictionary")
    board = cv2.aruco.CharucoBoard((target.columns, target.rows), target.square_m, target.marker_m, dictionary)
    side, cell = 1e3 * target.square_m, 1e3 * target.marker_m / cells
    light = set()
    for number, corners in zip(np.ravel(board.getIds()).tolist(), board.getObjPoints(), strict=True):
        x, y = (1e3 * np.asarray(corners, float)[0, :2]).tolist()
        light.add((int(y // side), int(x // side)))
        bits = np.asarray(cv2.aruco.generateImageMarker(dictionary, number, cells, borderBits=1))
        for row, column in np.argwhere(bits == 0).tolist():
            yield "box", (x + cell * column, y + cell * row, cell, cell)
    for row, column in np.ndindex(target.rows, target.columns):
        if (row, column) not in light:
            yield "box", (side * column, side * row, side, side)


@dataclass(frozen=True, slots=True)
class _Page:
    """Coordinates in PDF: points from the lower left corner, y up."""

    paper_mm: tuple[float, float]

    def at(self, x_mm: float, y_mm: float) -> str:
        return f"{_POINTS_PER_MM * x_mm:.5f} {_POINTS_PER_MM * (self.paper_mm[1] - y_mm):.5f}"

    def shape(self, shape: _Shape, left_mm: float, top_mm: float) -> str:
        kind, (x, y, *size) = shape
        x, y = x + left_mm, y + top_mm
        if kind == "box":
            wide, high = (_POINTS_PER_MM * side for side in size)
            return f"{self.at(x, y + size[1])} {wide:.5f} {high:.5f} re f"
        r, h = size[0], size[0] * _ROUND
        quarters = [((r, h), (h, r), (0, r)), ((-h, r), (-r, h), (-r, 0)), ((-r, -h), (-h, -r), (0, -r)), ((h, -r), (r, -h), (r, 0))]  # fmt: skip  # noqa: E501
        curves = [f"{' '.join(self.at(x + a, y + b) for a, b in quarter)} c" for quarter in quarters]
        return f"{self.at(x + r, y)} m {' '.join(curves)} f"

    def text(self, x_mm: float, y_mm: float, text: str) -> str:
        return f"BT /F1 8 Tf {self.at(x_mm, y_mm)} Td ({text}) Tj ET"


def _foot(target: Target, paper_mm: tuple[float, float], bar_mm: float) -> list[str]:
    """A bar with a tick at each centimetre, its nominal length, and the target as commands take it."""
    page, left, low = _Page(paper_mm), _MARGIN_MM, paper_mm[1] - _MARGIN_MM - _DESCENT_MM
    lines = [page.shape(("box", (0.0, 0.0, bar_mm, 0.3)), left, low - 8.0)]
    for tick in range(round(bar_mm / 10.0) + 1):
        high = 3.0 if tick in (0, round(bar_mm / 10.0)) else 1.5
        # The ticks' outer borders are the ends: a ruler is held against them.
        x = min(max(10.0 * tick - 0.15, 0.0), bar_mm - 0.3)
        lines.append(page.shape(("box", (x, 0.3 - high, 0.3, high)), left, low - 8.0))
    text = f"{bar_mm:g} mm from end to end: measure it; print at 100 %, without fitting to the page"
    return [
        *lines,
        page.text(left, low - 4.0, text),
        page.text(left, low, f"{name_of(target)}   gripmon {__version__}"),
    ]


def _pdf(paper_mm: tuple[float, float], content: str) -> bytes:
    """A file with one page."""
    box = " ".join(f"{_POINTS_PER_MM * side:.5f}" for side in paper_mm)
    stream = content.encode("ascii")
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {box}] /Contents 4 0 R "
        "/Resources << /Font << /F1 5 0 R >> >> >>".encode(),
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(stream), stream),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    out, places = b"%PDF-1.4\n", []
    for number, each in enumerate(objects, 1):
        places.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (number, each)
    table = b"".join(b"%010d 00000 n \n" % place for place in places)
    size = len(objects) + 1
    head = b"xref\n0 %d\n0000000000 65535 f \n%s" % (size, table)
    return out + head + b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (size, len(out))
