"""What a hypothesis holds, and the numbers that it begins with.

A hypothesis is a set of doubts, one Gaussian over g (23 quantities that all edges share) and a log weight.  What only
one edge has, how far off it is for good and before the present background, is kept for each of its two rows *given g*:

u | g  ~  N(a + A g, C),     u = (lasting error, error before each remembered background)

so that nothing of the size of g and all edges together is ever formed, and an edge that is measured again before the
same background tells nothing twice.  A doubted edge says nothing of g: it lies near or far from where it was searched.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array

Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]

SIZE = 23
MOTION = slice(0, 6)
"""d: translation of the TCP, m, and rotation, rad, in camera axes, since the reference."""
LATELY = slice(6, 12)
"""p: where d was in the last fifth of a second.  A background's error that was learnt then stays tied to that place;
without p a creeping mount before a still picture comes out two to four times too certain."""
REFERENCE = slice(12, 18)
"""b: error of the reference, as d."""
OPENING = 18
LENGTHS = slice(19, 21)
LIGHT = 21
"""One shift of all edges into the dark, px."""
FOCAL = 22
"""Logarithm of the focal length over the calibrated one."""

NEAR, FAR = 0, 1
FOREIGN_KINDS = 2
MEMORIES = 4
"""Things remembered of a doubted edge: as many places are searched, the fit's and the three heaviest."""
MOST_LINES = 3
"""Lines of an edge that one look at it finds, at most."""
LINES_APART_PX = 1.2
"""Distance from which two lines are two: twice three standard deviations of an edgel hypothesis."""
STILL = 0.99
"""Likeness of two pictures from which on the background counts as the same one."""
LATELY_S = 0.19
"""Time constant of p: 0.3 of the way in a frame at 15 frames/s."""
MOST_LAG = 0.99
"""Of the way to d in one frame, however long ago the last one was: what is nearer has no transition that can be undone.
"""
LEAST_LIGHT_MEMORY = 0.01
"""What is left of a light that is renewed: none would make its transition singular."""


@dataclass(frozen=True)
class Priors:
    """Standard deviations, and rates per second, fixed before any benchmark.

    Of the reference's error b (6,), m and rad; of the jaw opening and the finger lengths, m; of the light, px; of the
    focal length, relative, over hours (a lens that warms).  ``lasting_px``: how far off an edge of the gripper file is
    for good.  ``near_px`` and ``far_px``: where another thing's edge is found, by the width of an edge and by the reach
    of the search; ``aligned``: share of what lies over fingers' ends that is straight across them, at ``across_m`` from
    these along the fingers (half of the search's reach); ``missed``: probability that an edge, of the gripper or of
    another thing, isn't among the lines that were found there (the same for both: else a picture that stays tells more
    with every frame).  ``creep_m_s`` and ``creep_rad_s``: wandering of a mount in a second's square root.
    ``small_per_s``: how often it moves by ``small_m``, ``small_rad`` an axis; while it is loose as far in a second's
    square root, and besides, shaking, ``shakes_per_s`` as often (brackets shake at some ten Hz: a part of the frames
    shows them elsewhere).  ``knock_per_s``: one knock a month, of log-normal size, median 3 mm, 1 to 10 mm, as three
    Gaussians (``any_way``: standard deviation and share) in 2 of 3, else along the fingers.  ``unseen_knock``: its
    probability since an end was seen last, in each set of doubts (policy: what hides them is what knocks).
    ``opening_first``,
    ``opening_per_s``: the reported opening is wrong by ``opening_jump_m``, at first and later.
    """

    reference: tuple[float, ...] = (1e-3, 1e-3, 1e-3, 1e-2, 1e-2, 1e-2)
    opening_m: float = 0.3e-3
    length_m: float = 0.2e-3
    light_px: float = 0.2
    focal: float = 1e-4
    lasting_px: float = 0.05
    near_px: float = 0.5
    far_px: float = 7.0
    aligned: float = 0.5
    across_m: float = 6e-3
    missed: float = 0.05
    creep_m_s: float = 3e-6
    creep_rad_s: float = 3e-5
    small_per_s: float = 0.02
    small_m: float = 0.3e-3
    small_rad: float = 3e-3
    shakes_per_s: float = 10.0
    knock_per_s: float = 4e-7
    unseen_knock: float = 1e-3
    any_way: tuple[tuple[float, float], ...] = ((1.3e-3, 0.40), (2.6e-3, 0.45), (5.5e-3, 0.15))
    knock_rad: float = 20e-3
    along_share: float = 1.0 / 3.0
    along: tuple[tuple[float, float], ...] = ((1.7e-3, 0.35), (3.8e-3, 0.45), (8.5e-3, 0.20))
    opening_first: float = 1e-3
    opening_per_s: float = 1e-6
    opening_jump_m: float = 3e-3

    def covariance(self) -> Array:
        """(23, 23) at the reference.  d is zero there by definition: a micrometre and a microradian leave it free."""
        at_reference = (1e-6,) * 12
        rest = (self.opening_m, self.length_m, self.length_m, self.light_px, self.focal)
        return np.diag(np.square([*at_reference, *self.reference, *rest]))


class Bank(NamedTuple):
    """h hypotheses of e edges (2 e rows), k - 1 remembered backgrounds: ``log_weight`` (h,), ``doubts`` (h,) as bits;
    ``mean`` (h, 23) and ``covariance`` (h, 23, 23) of g; each row's u given g: ``offset`` a (h, 2 e, k), ``slope`` A
    (h, 2 e, k, 23), ``spread`` C (h, 2 e, k, k), px.  Of doubted edges by kind (near, far) its log share ``kind`` (h,
    e, 2), and of the things seen there, the last first and of each kind in turn: where each row was ``searched``
    (h, e, 8, 2), px, when its place was drawn, and the ``place`` (h, e, 8, 2, 2) beside that (place, background) with
    variances and covariance ``place_spread`` (h, e, 8, 2, 3).
    """

    log_weight: Array
    doubts: Ints
    mean: Array
    covariance: Array
    offset: Array
    slope: Array
    spread: Array
    searched: Array
    kind: Array
    place: Array
    place_spread: Array

    @classmethod
    def empty(cls, hypotheses: int, edges: int, backgrounds: int) -> Bank:
        """Zeros."""
        h, e, k, m = hypotheses, edges, 1 + backgrounds, FOREIGN_KINDS * MEMORIES
        return cls(
            np.zeros(h), np.zeros(h, np.int64), np.zeros((h, SIZE)), np.zeros((h, SIZE, SIZE)),
            np.zeros((h, 2 * e, k)), np.zeros((h, 2 * e, k, SIZE)), np.zeros((h, 2 * e, k, k)),
            np.zeros((h, e, m, 2)), np.zeros((h, e, 2)), np.zeros((h, e, m, 2, 2)), np.zeros((h, e, m, 2, 3)),
        )  # fmt: skip


class Seen(NamedTuple):
    """A frame's edges.  Of the lines that were found where an edge was searched, ``found`` (e,) of them: ``rows`` (e,
    l, 2, 23), how offset at the middle and slope times half the length, px, change with g (zero for p), ``lines`` (e,
    l, 2) both, ``white`` (e, l, 2), the variance of what is new in every frame, px^2, ``searched`` (e, l, 2), where the
    edge was looked for, px, and ``image`` (e, l, 2), both numbers in a frame of the edge's own that is fixed in the
    image, whatever place the rows are for, with ``image_white``; ``fitted`` (e,): which of them agrees with the fit, -1
    for none.  ``background`` (e,), the remembered one that is behind the edge now; ``likeness`` (e,) of it to when it
    was last seen, 0 for a new one; ``strength`` (e,), the variance of a background's error, px^2.
    """

    rows: Array
    lines: Array
    white: Array
    searched: Array
    image: Array
    image_white: Array
    found: Ints
    fitted: Ints
    background: Ints
    likeness: Array
    strength: Array

    @property
    def shown(self) -> Flags:
        """(e,) whether anything was found."""
        return self.found > 0
