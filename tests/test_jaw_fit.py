"""Which account of how fingers move is taken, and which of their edges the motion places."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gripmon.teach.image_motion import Unfit
from gripmon.teach.jaw_fit import _best_of, _Fit, _Solved
from gripmon.teach.jaw_unknowns import _shown
from gripmon.teach.vanishing import Outline

NONE = np.zeros(0)


class Fit:
    """Explains the outlines to a chi-squared, with a share of them that agrees, and another that is placed."""

    def __init__(self, chi2: float, agreeing: float, placed_share: float = 1.0):
        self.chi2, self.agreeing, self.placed_share = chi2, agreeing, placed_share

    def solve(self, common: Any) -> _Solved:
        if not np.isfinite(self.chi2):
            raise Unfit("a finger isn't found", 0.03)
        return _Solved(NONE, NONE, NONE, self.chi2, self.agreeing, common, NONE > 0)


@pytest.mark.parametrize(
    ("perspective", "motion", "taken", "agreeing"),
    [
        ((60.0, 0.85), (20.0, 0.95), 0, 0.85),  # not contradicted
        ((160.0, 0.43), (59.0, 0.86), 1, 0.86),
        ((19.3, 0.79), (18.3, 0.94), 0, 0.94),  # the outlines themselves are off: no depths explain them better
        ((np.inf, 0.0), (59.0, 0.86), 1, 0.86),
        ((160.0, 0.43), (np.inf, 0.0), 0, 0.43),
        ((4.0, 0.97, 0.3), (60.0, 0.9), 1, 0.9),  # of fingers with pads perspective places the pads alone
        ((4.0, 0.97, 0.3), (60.0, 0.7), 0, 0.97),  # what it leaves out doesn't move with the tips
    ],
)
def test_the_motion_overrules_perspective_where_the_outlines_do(
    perspective: tuple[float, ...], motion: tuple[float, ...], taken: int, agreeing: float
) -> None:
    fits: list[Any] = [Fit(*perspective), Fit(*motion)]
    fit, best = _best_of(fits, loose=False)
    assert fit is fits[taken] and best.agreeing == agreeing
    with pytest.raises(Unfit, match="isn't found"):
        _best_of([Fit(np.inf, 0.0)] * 2, loose=False)  # type: ignore[list-item]


def test_a_border_behind_which_a_finger_comes_out_isnt_placed_by_its_motion() -> None:
    """It moves along itself, and ends where it leaves the image; a tip's edge moves along itself as well."""
    xy = np.array([[-0.4, -0.1], [-0.2, -0.1], [-0.05, 0.3], [0.0, 0.3], [0.0, -0.3]])
    pieces = ((0, 1), (1, 2), (2, 3), (3, 4))
    corner, lengths = np.array([False, True, True, True, False]), np.full(4, 100.0)
    finger = Outline("left", xy, corner, pieces, np.array([0.0, 1.0]), lengths, np.zeros((0, 2, 2)), NONE)
    assert _shown(finger, np.array([1.0, 0.0])) == pieces[1:]
    assert _shown(finger, np.array([0.8, 0.6])) == pieces


@pytest.mark.parametrize(
    ("openings", "chi2", "turn"), [(1, 10.0, False), (1, 13.0, True), (3, 15.0, False), (3, 25.0, True)]
)
def test_turns_of_several_openings_explain_noise_without_a_turn(openings: int, chi2: float, turn: bool) -> None:
    """Two fingers' turns each: of 2 or 6 unknowns chi-squared is below 11.8 or 20.1 in 99.73 % (its tables)."""
    free = np.repeat([True, False], [4, 2 * openings])
    best = _Solved(NONE, NONE, NONE, 100.0, 1.0, NONE, free)
    turning = _Solved(NONE, NONE, np.full(2 * openings, 0.02), 100.0 - chi2, 1.0, NONE, free | True)
    fit: Any = SimpleNamespace(solve=lambda *_, **__: turning, frame=lambda _: (NONE, NONE), placed=True)
    assert bool(_Fit.turned(fit, best)) == turn
