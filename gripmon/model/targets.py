"""Flat calibration targets, as described on a command line or in a file."""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
from msgspec import Meta

from gripmon.model.errors import InputError

_Count = Annotated[int, Meta(ge=2, le=200)]
_Length = Annotated[float, Meta(gt=0.0, le=2.0)]
FEWEST = {"chequerboard": 9, "charuco": 6, "circles": 9, "acircles": 9}
"""Minimum number of points in a view."""
_WIDEST = 2.0
"""Largest square, m: a larger number was meant in millimetres."""
_AS_WRITTEN = 1e-5
"""Relative; lengths are written to six digits."""


class TargetError(InputError):
    """An impossible target; ``str()`` is one line: what is wrong; what would be right."""

    argument = "target"


class OtherSizeError(TargetError):
    """A target has the pattern of a known one in another size, which may be meant.

    ``fault`` says so without a remedy.  ``confirmed_by`` is how the caller's user confirms that it is really another
    target; :meth:`worded` says it in the caller's own terms.
    """

    def __init__(self, fault: str, confirmed_by: str = "other_target=True") -> None:
        super().__init__(f"{fault}; that one, or {confirmed_by} if it is really another target")
        self.fault = fault

    def worded(self, confirmed_by: str) -> OtherSizeError:
        """The same error with another way to confirm it, e.g. an option."""
        return OtherSizeError(self.fault, confirmed_by)


class Chequerboard(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="chequerboard"):
    """Squares in two colours; ``columns`` and ``rows`` count the *inner* corners, as OpenCV and ROS do."""

    columns: _Count
    rows: _Count
    square_m: _Length

    @property
    def last(self) -> tuple[int, int]:
        """Steps to the outermost corners along x and along y."""
        return self.columns - 1, self.rows - 1

    @property
    def step_m(self) -> float:
        """Length of these steps."""
        return self.square_m


class Charuco(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="charuco"):
    """A chequerboard with ArUco markers in white squares; ``columns`` and ``rows`` count *squares*, as OpenCV does."""

    columns: _Count
    rows: _Count
    square_m: _Length
    marker_m: _Length
    dictionary: str = "DICT_4X4_250"

    @property
    def last(self) -> tuple[int, int]:
        """Steps between the outermost inner corners along x and along y."""
        return self.columns - 2, self.rows - 2

    @property
    def step_m(self) -> float:
        """Length of these steps."""
        return self.square_m


class CircleGrid(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="circles"):
    """Discs on a square lattice, such as the self-viewing method's 8 x 8; dark on light or light on dark."""

    columns: _Count
    rows: _Count
    spacing_m: _Length
    diameter_m: _Length

    @property
    def places(self) -> list[tuple[int, int]]:
        """Steps along x and y of every disc from the first, row by row."""
        return [(column, row) for row in range(self.rows) for column in range(self.columns)]

    @property
    def last(self) -> tuple[int, int]:
        """Steps to the outermost discs along x and along y."""
        return self.columns - 1, self.rows - 1

    @property
    def step_m(self) -> float:
        """Length of these steps."""
        return self.spacing_m


class StaggeredCircles(CircleGrid, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="acircles"):
    """OpenCV's asymmetric circles: discs ``spacing_m`` apart in rows half as far apart, every second one shifted by
    half of it.  They are a square lattice, too, turned by 45 degrees.
    """

    @property
    def places(self) -> list[tuple[int, int]]:
        """Steps along x and y of every disc from the first, row by row."""
        return [(2 * column + row % 2, row) for row in range(self.rows) for column in range(self.columns)]

    @property
    def last(self) -> tuple[int, int]:
        """Steps to the outermost discs along x and along y."""
        return 2 * self.columns - 1, self.rows - 1

    @property
    def step_m(self) -> float:
        """Length of these steps: OpenCV's square size."""
        return 0.5 * self.spacing_m


Target = Chequerboard | Charuco | CircleGrid | StaggeredCircles
_FORMS: dict[str, str] = {
    "chequerboard": "chequerboard:COLUMNSxROWS:SQUARE (inner corners, m), e.g. chequerboard:9x6:0.025",
    "charuco": "charuco:COLUMNSxROWS:SQUARE:MARKER[:DICTIONARY] (squares, m), e.g. charuco:8x6:0.03:0.022:DICT_4X4_250",
    "circles": "circles:COLUMNSxROWS:SPACING:DIAMETER (discs, m), e.g. circles:8x8:0.008:0.004",
    "acircles": "acircles:COLUMNSxROWS:SPACING:DIAMETER (staggered; in a row, m), e.g. acircles:4x11:0.04:0.015",
}


def parse_target(text: str) -> Target:
    """Parse a target from a command line.  Raises :class:`TargetError`."""
    kind, *parts = text.split(":")
    kind = "chequerboard" if kind == "checkerboard" else kind
    if kind not in _FORMS:
        raise TargetError(f"'{kind}' is not a target; {' or '.join(_FORMS.values())}")
    right = _FORMS[kind]
    lengths = {"chequerboard": (2, 2), "charuco": (3, 4)}.get(kind, (3, 3))
    if not lengths[0] <= len(parts) <= lengths[1]:
        raise TargetError(f"'{text}' has {len(parts)} part{'s' * (len(parts) != 1)} after its kind; {right}")
    try:
        columns, rows = (int(n) for n in parts[0].lower().split("x"))
        numbers = [float(p) for p in parts[1 : 2 if kind == "chequerboard" else 3]]
    except ValueError:
        raise TargetError(f"'{text}' can't be read; {right}") from None
    keys: dict[str, tuple[str, ...]] = {"chequerboard": ("square_m",), "charuco": ("square_m", "marker_m")}
    names = keys.get(kind, ("spacing_m", "diameter_m"))
    fields = {"kind": kind, "columns": columns, "rows": rows, **dict(zip(names, numbers, strict=True))}
    if len(parts) == 4:
        fields["dictionary"] = parts[3]
    return checked(fields, text, right)


def checked(fields: dict[str, object], text: str, right: str) -> Target:
    """Build a target from its fields.  Raises :class:`TargetError`."""
    if max((v for k, v in fields.items() if k.endswith("_m") and isinstance(v, float)), default=0.0) > _WIDEST:
        raise TargetError(
            f"'{text}': {fields.get('square_m', fields.get('spacing_m'))} m between its points (millimetres?); {right}"
        )
    try:
        target: Target = msgspec.convert(fields, Target)
    except msgspec.ValidationError as error:
        raise TargetError(f"'{text}': {error}; {right}") from None
    pairs = {"chequerboard": ("", ""), "charuco": ("marker_m", "square_m")}
    inner, outer = pairs.get(str(fields["kind"]), ("diameter_m", "spacing_m"))
    if inner and not getattr(target, inner) < getattr(target, outer):
        raise TargetError(f"'{text}': {inner} is not below {outer}; {right}")
    if isinstance(target, StaggeredCircles) and not target.diameter_m < math.sqrt(0.5) * target.spacing_m:
        raise TargetError(f"'{text}': discs would touch those of the next row, {target.step_m:g} m away; {right}")
    columns, rows = (
        (target.columns, target.rows) if fields["kind"] != "charuco" else (target.columns - 1, target.rows - 1)
    )
    if min(columns, rows) < (2 if fields["kind"] == "charuco" else 3) or columns * rows < FEWEST[str(fields["kind"])]:
        raise TargetError(
            f"'{text}' has {columns} x {rows} points, too few to tell it from anything else; at least 3 x 3; {right}"
        )
    return target


def name_of(target: Target) -> str:
    """The target in the form that :func:`parse_target` reads."""
    size = f"{target.columns}x{target.rows}"
    if isinstance(target, Chequerboard):
        return f"chequerboard:{size}:{target.square_m:g}"
    if isinstance(target, CircleGrid):
        kind = target.__struct_config__.tag
        return f"{kind}:{size}:{target.spacing_m:g}:{target.diameter_m:g}"
    return f"charuco:{size}:{target.square_m:g}:{target.marker_m:g}:{target.dictionary}"


def refuse_squares(target: Target) -> None:
    """:class:`TargetError` for a pattern of squares, before which a gripper that isn't known can't be found: their
    edges look like the outlines of fingers that stand on them.
    """
    if not isinstance(target, CircleGrid):
        raise TargetError(
            f"{name_of(target)}: the edges of its squares can't be told from the outlines of an unknown gripper; "
            "discs, such as circles:12x10:0.008:0.004, or a gripper file (gripmon gripper from-images makes one)"
        )


def refuse_other_size(target: Target, recorded: str | None, made: str = "the camera was calibrated with") -> None:
    """Raise :class:`OtherSizeError` if the target ``recorded`` in a file (as :func:`name_of` writes it; None: none is)
    has the same pattern in another size: no image contradicts a wrong size, and what is measured scales with it.
    """
    try:
        known = None if recorded is None else parse_target(recorded)
    except TargetError:  # a person's own words
        return
    if known is None or type(known) is not type(target):
        return
    if {known.columns, known.rows} != {target.columns, target.rows}:  # discs show the same with both swapped
        return
    lengths = [name for name in known.__struct_fields__ if name.endswith("_m")]
    if not all(math.isclose(getattr(target, n), getattr(known, n), rel_tol=_AS_WRITTEN) for n in lengths):
        raise OtherSizeError(f"{name_of(target)}: {made} {name_of(known)}, the same pattern in another size")


def turns_alike(target: Target) -> int:
    """In how many ways the target can be turned so that an image of all of it looks the same: one with markers, with
    the colours of a board that has an odd and an even number of corners, with an odd number of staggered rows; else
    two, or four of a square.
    """
    if isinstance(target, Charuco):
        return 1
    if isinstance(target, StaggeredCircles):
        return 2 - target.rows % 2
    if isinstance(target, Chequerboard) and (target.columns + target.rows) % 2:
        return 1
    return 4 if target.columns == target.rows else 2
