"""What may be wrong with a fit of a gripper's edges, and how probable that is in a frame before anything is seen."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import NOTHING_WRONG, Array

WRONG_EDGE = 1e-2
"""Probability a frame that an edge that agrees belongs to something else, a border parallel to it, a pad, a shadow; or
that the ends of one finger do, together, or the inner edges of all fingers, which close upon one object.
"""

WRONG_GRIPPER = 1e-3
"""Probability that the gripper isn't as its file and its jaw's report have it: a finger bent, shifted in its holder or
exchanged, or the jaw opening off by more than the report's standard deviation allows.
"""


@dataclass(frozen=True)
class Hypotheses:
    """h hypotheses about v edges: ``name``, ``prior`` (h,), ``keep`` (h, v) 1 for the edges that are not doubted,
    ``opening`` (h,) whether the reported opening is, too, and ``sudden`` (h,): it begins at some moment, so that where
    the gripper was before still counts.  The first is that nothing is wrong; ``ends`` is the number of the one that no
    end of a finger is what it seems, ``grasp`` those of something grasped that shifts the inner edges.
    """

    name: tuple[str, ...]
    prior: Array
    keep: Array
    opening: NDArray[np.bool_]
    sudden: NDArray[np.bool_]
    ends: int
    grasp: tuple[int, ...] = ()

    @cached_property
    def across(self) -> NDArray[np.bool_]:
        """(v,) the edges that don't run along the fingers: their ends."""
        return self.keep[self.ends] == 0.0

    @cached_property
    def endless(self) -> NDArray[np.bool_]:
        """(h,) which leave no end of a finger."""
        return np.asarray((self.keep[:, self.across] == 0.0).all(axis=1))

    @cached_property
    def more_than_ends(self) -> NDArray[np.bool_]:
        """(h,) which doubt something else than the ends."""
        return np.asarray((self.keep[:, ~self.across] == 0.0).any(axis=1) | self.opening)

    @cached_property
    def of_more_than_ends(self) -> float:
        """The sum of the priors of these."""
        return float(self.prior[self.more_than_ends].sum())

    def without_ends(self) -> Hypotheses:
        """The same where no end of a finger is what it seems besides."""
        name = tuple(f"{name}, and what looks like ends" for name in self.name)
        return replace(self, name=name, keep=self.keep * self.keep[self.ends])

    def pairs(self) -> Hypotheses:
        """Of :meth:`without_ends` those that doubt something else, and the one that doubts no more than the ends."""
        some = self.more_than_ends | (np.arange(len(self.prior)) == self.ends)
        names = tuple(name for name, kept in zip(self.name, some, strict=True) if kept)
        of_each = self.prior[some], self.keep[some], self.opening[some], self.sudden[some]
        return Hypotheses(names, *of_each, int(some[: self.ends].sum()))


def hypotheses_of(
    edge_names: tuple[str, ...],
    finger: NDArray[np.intp],
    finger_names: tuple[str, ...],
    along: NDArray[np.bool_],
    inner: NDArray[np.bool_],
    has_opening: bool,
    sides: tuple[NDArray[np.bool_], ...] = (),
) -> Hypotheses:
    """All that a fit of v edges has to reckon with: ``finger`` (v,) of each, ``along`` (v,) the finger or an end,
    ``inner`` (v,) for those that what is grasped touches.  The names as a sentence has them ("the left finger").

    A lone finger's ends are all that there are: something else taken for them is one hypothesis, as of all fingers.
    """
    count = len(edge_names)
    rows: list[tuple[str, float, NDArray[Any], bool, bool]] = []
    whole = np.ones(count)
    rows.append((NOTHING_WRONG, 1.0, whole, False, False))
    lone = len(finger_names) == 1
    for number, name in enumerate(edge_names):
        others = np.arange(count) != number
        if not (lone and (others == along).all()):
            rows.append((f"{name} belongs to something else", WRONG_EDGE, others, False, False))
    for number, name in enumerate(finger_names):
        own = finger == number
        if (own & ~along).sum() > 1 and not lone:
            what = f"the ends of {name} belong to something else"
            rows.append((what, WRONG_EDGE, ~(own & ~along), False, False))
        if own.any() and not own.all():
            rows.append((f"{name} is not where its model says", WRONG_GRIPPER, ~own, False, True))
    grasp: tuple[int, ...] = ()
    for part, what in ((inner & along, "inner edges"), (inner, "inner edges with their ends")):
        if part.sum() > 1 and not part.all() and (not grasp or (part & ~along).any()):
            grasp = (*grasp, len(rows))
            # In one image another distance and opening make up for it; where the gripper was before doesn't fit then.
            rows.append((f"the fingers' {what} belong to what is grasped", WRONG_EDGE, ~part, False, True))
    outer = along & ~inner
    if outer.sum() > 1 and not outer.all() and not lone:
        # A slot, a sleeve, a cable at each finger.
        rows.append(("the fingers' outer edges belong to something beside them", WRONG_EDGE, ~outer, False, True))
    for side in sides:
        if side.sum() > 1 and not side.all():
            what = "the edges on one side of all fingers belong to something else"
            rows.append((what, WRONG_EDGE, ~side, False, True))
    if has_opening:
        rows.append(("the jaw opening is wrong", WRONG_GRIPPER, whole, True, False))
    ends = len(rows)
    rows.append(("what looks like the fingers' ends is something else", 1.0, along, False, True))
    names, prior, keep, opening, sudden = zip(*rows, strict=True)
    return Hypotheses(
        tuple(names), np.array(prior), np.array(keep, dtype=float), np.array(opening), np.array(sudden), ends, grasp
    )
