"""How the edges show while all is well: the calibration's error, and what the gripper model doesn't say.

Like is compared with like: a bevel, a shade or a reference that is off by a tenth of a millimetre shifts the edges
before and after alike.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gripmon.records import Array, EdgeEvidence

SETTLED = 4
"""Frames from which the baseline counts, and"""

ENOUGH = 24
"""frames at which it is complete: what changes later is news, not baseline."""


class Baseline:
    """Means over frames in which all was well: ``motion`` (m,) of the unknowns from the reference, ``bias_px`` (e,) of
    each edge beyond that, ``blur_px2`` of the edges.
    """

    def __init__(self, unknowns: int, edges: int):
        self.frames = 0
        self.motion = np.zeros(unknowns)
        self._sum = np.zeros(edges)
        self._count = np.zeros(edges)
        self._blurs_px2: list[float] = []

    @property
    def known(self) -> bool:
        return self.frames >= SETTLED

    @property
    def complete(self) -> bool:
        return self.frames >= ENOUGH

    @property
    def blur_px2(self) -> float | None:
        """None where too few frames told."""
        return float(np.median(self._blurs_px2)) if len(self._blurs_px2) >= SETTLED else None

    def add(self, motion: Array, edge: NDArray[np.intp], residual_px: Array, blur_px2: float | None) -> None:
        self.frames += 1
        self.motion = self.motion + (motion - self.motion) / self.frames
        count = np.bincount(edge, minlength=len(self._sum))
        total = np.bincount(edge, residual_px, len(self._sum))
        seen = count > 0
        self._sum[seen] += total[seen] / count[seen]
        self._count += seen
        if blur_px2 is not None:
            self._blurs_px2.append(blur_px2)

    @property
    def bias_px(self) -> Array:
        """(e,) zero for edges that were not seen."""
        return self._sum / np.maximum(self._count, 1)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(e,) whether an edge was seen in enough frames."""
        return np.asarray(self._count >= SETTLED)


def isotropic_blur_px2(evidence: EdgeEvidence) -> float | None:
    """The least variance of the edges' blur over all directions in the image; None with too few directions.

    Motion smears edges along one direction only; a lens out of focus blurs all of them.
    """
    if len(evidence.edge) < 6:
        return None
    angle = 2.0 * np.arctan2(evidence.across[:, 1], evidence.across[:, 0])
    design = np.column_stack([np.ones(len(angle)), np.cos(angle), np.sin(angle)])
    if np.linalg.cond(design) > 10.0:
        return None
    weight = np.ones(len(angle))
    for _ in range(8):  # towards least absolute deviations: an edge beside another one looks wide
        terms = np.linalg.lstsq(design * weight[:, None], evidence.blur_px2 * weight, rcond=None)[0]
        rest = np.abs(evidence.blur_px2 - design @ terms)
        weight = 1.0 / np.sqrt(np.maximum(rest, 0.02))
    return max(float(terms[0] - np.hypot(terms[1], terms[2])), 0.0)
