"""A calibration target as a page to print: PDF in true size, with a bar to check against a ruler.

fpdf2 rounds to a hundredth of a point: what is drawn lies within 2 micrometres of where it is said to be.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from fpdf import FPDF, ViewerPreferences

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
    page = FPDF(unit="mm", format=paper_mm)
    page.viewer_preferences = ViewerPreferences(print_scaling="None")
    page.add_page()
    for shape in _shapes(target):
        _draw(page, shape, left, top)
    _draw_foot(page, target, paper_mm[1], bar_mm)
    return PrintedTarget(bytes(page.output()), paper_mm, bar_mm)


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


def _draw(page: FPDF, shape: _Shape, left_mm: float, top_mm: float) -> None:
    kind, (x, y, *size) = shape
    if kind == "disc":
        page.circle(x + left_mm, y + top_mm, size[0], style="F")
    else:
        page.rect(x + left_mm, y + top_mm, size[0], size[1], style="F")


def _draw_foot(page: FPDF, target: Target, paper_high_mm: float, bar_mm: float) -> None:
    """A bar with a tick at each centimetre, its nominal length, and the target as commands take it."""
    left, low = _MARGIN_MM, paper_high_mm - _MARGIN_MM - _DESCENT_MM
    page.rect(left, low - 8.0, bar_mm, 0.3, style="F")
    last = round(bar_mm / 10.0)
    for tick in range(last + 1):
        high = 3.0 if tick in (0, last) else 1.5
        # The ticks' outer borders are the ends: a ruler is held against them.
        x = min(max(10.0 * tick - 0.15, 0.0), bar_mm - 0.3)
        page.rect(left + x, low - 7.7 - high, 0.3, high, style="F")
    page.set_font("helvetica", size=8)
    text = f"{bar_mm:g} mm from end to end: measure it; print at 100 %, without fitting to the page"
    page.text(left, low - 4.0, text)
    page.text(left, low, f"{name_of(target)}   gripmon {__version__}")
