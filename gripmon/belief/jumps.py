"""What moves at once: small motions, knocks, an opening that was told wrong."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gripmon.belief.state import OPENING, SIZE, Ints, Priors
from gripmon.model.records import Array


class Jumps(NamedTuple):
    """What moves at once: a ``share`` (j,) of what happens ``per_s`` (j,), or ``loose_per_s`` (j,) while the mount is
    loose, or is so ``at_first`` (j,), with ``factors`` (j, 6, 23) of its covariance, of which ``ranks`` (j,) rows
    count; ``knock`` (j,): it is one.
    """

    share: Array
    per_s: Array
    loose_per_s: Array
    at_first: Array
    factors: Array
    ranks: Ints
    knock: Array

    @classmethod
    def of(cls, priors: Priors, along: Array) -> Jumps:
        """``along`` (3,): the fingers' direction in camera axes."""
        shares, rates, factors, knock = [], [], [], []

        def put(share: float, rate: float, rows: Array, is_knock: bool) -> None:
            shares.append(share)
            rates.append(rate)
            factors.append(rows)
            knock.append(is_knock)

        put(1.0, priors.small_per_s, _diagonal([priors.small_m] * 3 + [priors.small_rad] * 3), False)
        for size_m, share in priors.any_way:
            put(
                share * (1.0 - priors.along_share),
                priors.knock_per_s,
                _diagonal([size_m] * 3 + [priors.knock_rad] * 3),
                True,
            )
        for size_m, share in priors.along:
            row = np.zeros((1, SIZE))
            row[0, :3] = size_m * along
            put(share * priors.along_share, priors.knock_per_s, row, True)
        row = np.zeros((1, SIZE))
        row[0, OPENING] = priors.opening_jump_m
        put(1.0, priors.opening_per_s, row, False)
        padded = np.zeros((len(factors), 6, SIZE))
        for j, rows in enumerate(factors):
            padded[j, : len(rows)] = rows
        at_first = np.where(np.arange(len(factors)) == len(factors) - 1, priors.opening_first, 0.0)
        ranks = np.array([len(f) for f in factors])
        loose = np.array([priors.shakes_per_s, *rates[1:]])
        return cls(np.array(shares), np.array(rates), loose, at_first, padded, ranks, np.array(knock))


def _diagonal(sigmas: Sequence[float]) -> Array:
    rows = np.zeros((len(sigmas), SIZE))
    rows[range(len(sigmas)), range(len(sigmas))] = sigmas
    return rows
