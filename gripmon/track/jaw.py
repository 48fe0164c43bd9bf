"""What the images tell, over time, about the error of the reported jaw opening.

In one image opening and distance look much alike, so that an opening known to a tenth of a millimetre spoils the
distance.  But the report's error doesn't change as long as the jaw stands still, and its offset doesn't change at all:
what many images say about it adds up, and then the distance is as good as with an exact opening.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gripmon.model.records import Array

UNREPORTED_MOTION_SIGMAS = 5.0
"""Standard deviations between what is known and what an image shows past which the jaw has moved without a report."""

SYSTEMATIC_M = 2e-6
"""What no number of images tells about the opening: a fiftieth of a pixel at 100 µm a pixel."""

LEAST_INFORMATION_RATIO = 1e-6  # of the prior's information: what an image must add to count

ALIKE_IMAGES, ALIKE_AT_FIRST, ALIKE_AT_MOST = 10.0, 0.8, 0.98
"""Number of images, or backgrounds, over which it is learnt how the edges' errors correlate from one to the next (no
unit), the correlation assumed before that, and the largest one.
"""


class OpeningSeen(NamedTuple):
    """What one image alone tells of the report's error: ``error_m`` with its ``variance``, and whether it
    ``contradicted`` what was known.
    """

    error_m: float
    variance: float
    contradicted: bool


@dataclass(frozen=True, slots=True)
class Fused:
    """``xi`` (6,) what has to be added to the pose's perturbation, ``covariance`` (6, 6) of the pose then, the opening
    with its standard deviation, by how many standard deviations the image contradicted what was known, what was known
    before it: an opening with its standard deviation; and what was ``seen``, None where the image tells nothing.
    """

    xi: Array
    covariance: Array
    jaw_opening_m: float
    sigma_m: float
    innovation: float
    known_m: float
    known_sigma_m: float
    seen: OpeningSeen | None


class AlikeErrors:
    """How many successive measurements count as one, because their errors are alike: by the ``correlation`` of
    neighbours, as in a first-order autoregression.
    """

    def __init__(self, correlation: float = ALIKE_AT_FIRST):
        self.correlation = correlation

    def learn(self, differing: float) -> None:
        """``differing``: square of the difference of two neighbours over what independent errors make it on average."""
        self.correlation += (min(1.0 - differing, 1.0) - self.correlation) / ALIKE_IMAGES

    @property
    def count(self) -> float:
        """Measurements that count as one."""
        correlation = min(max(self.correlation, 0.0), ALIKE_AT_MOST)
        return (1.0 + correlation) / (1.0 - correlation)


class JawKnowledge:
    """A filter of two states, both errors of the report: an offset that is always the same, and a part that changes as
    the jaw moves (backlash, rounding, calibration of the scale).

    The part that changes forgets itself as exp(-way / (2 sigma)) with the way that the report travels.
    """

    def __init__(self, sigma_m: float, offset_sigma_m: float):
        """``sigma_m`` zero: the report is exact, and there is nothing to learn."""
        self.exact = sigma_m == 0.0
        self._sigma_m, self._offset_sigma_m = sigma_m, 0.0 if self.exact else offset_sigma_m
        self._reported_m: float | None = None
        self._alike = AlikeErrors()
        self._against = 0  # so many images in a row contradict what is known
        self._doubted_m = 0.0  # the report in the first of them
        self._forget()

    @property
    def report_sigma_m(self) -> float:
        """Standard deviation of a report about whose error nothing is known."""
        return math.hypot(self._sigma_m, self._offset_sigma_m)

    def fuse(self, reported_m: float, jaw_opening_m: float, covariance: Array) -> Fused:
        """Replace the report's prior in an estimate by what is known about its error; :meth:`learn` what was ``seen``
        if the estimate is believed.

        ``covariance`` (7, 7) of pose and opening, from a fit with a prior of :attr:`report_sigma_m` about the report.
        """
        prior = self.report_sigma_m**2
        variance = float(covariance[6, 6])
        image = 0.0 if self.exact else 1.0 / variance - 1.0 / prior
        if image * prior <= LEAST_INFORMATION_RATIO:
            return Fused(
                np.zeros(6),
                covariance[:6, :6],
                jaw_opening_m,
                math.sqrt(variance),
                0.0,
                reported_m,
                self.report_sigma_m,
                None,
            )
        seen_variance = 1.0 / image
        error_m = seen_variance * (jaw_opening_m - reported_m) / variance  # of the report, by this image alone
        self._travel(reported_m)
        innovation = (error_m - self._mean.sum()) / math.sqrt(seen_variance + self._known_variance)
        known_m, known = float(self._mean.sum()), self._known_variance
        contradicted = abs(innovation) > UNREPORTED_MOTION_SIGMAS
        if contradicted:
            known_m, known = 0.0, prior
        fused = 1.0 / (image + 1.0 / known)
        opening_m = reported_m + fused * (image * error_m + known_m / known)
        gain = covariance[:6, 6] / variance
        conditioned = covariance[:6, :6] + np.outer(gain, gain) * (fused - variance)
        xi = gain * (opening_m - jaw_opening_m)
        return Fused(
            xi,
            0.5 * (conditioned + conditioned.T),
            opening_m,
            math.sqrt(fused),
            innovation,
            reported_m + known_m,
            math.sqrt(known),
            OpeningSeen(error_m, seen_variance, contradicted),
        )

    @property
    def _known_variance(self) -> float:
        return min(float(self._covariance.sum()) + SYSTEMATIC_M**2, self.report_sigma_m**2)

    def _forget(self) -> None:
        self._learnt = 0  # from so many images
        self._seen: tuple[float, float] | None = None  # by the last of them
        self._mean = np.zeros(2)
        self._covariance = np.diag([self._offset_sigma_m**2, self._sigma_m**2])

    def _travel(self, reported_m: float) -> None:
        if self._reported_m is not None and not self.exact:
            kept = math.exp(-abs(reported_m - self._reported_m) / (2.0 * self._sigma_m))
            keep = np.array([1.0, kept])
            self._mean *= keep
            self._covariance *= np.outer(keep, keep)
            self._covariance[1, 1] += (1.0 - kept**2) * self._sigma_m**2
        self._reported_m = reported_m

    def learn(self, seen: OpeningSeen) -> None:
        """Believe what an estimate showed of the report's error: a Kalman update.

        Images err alike while the background stands still: how much less than independent ones their errors differ from
        one to the next tells how many of them count as one.  What contradicts what is known is more probably an edge of
        something held between the fingers than a jaw that moved without a report: it isn't learnt before it is more
        images in a row than what is known is made of, or the jaw is elsewhere; and then instead of all before.
        """
        error_m, variance, contradicted = seen
        if contradicted and self._reported_m is not None:
            if not self._against:
                self._doubted_m = self._reported_m
            self._against += 1
            # What the jaw's old place tells of the report's error here, as a share of the information.
            left = math.exp(-abs(self._reported_m - self._doubted_m) / self._sigma_m)
            if left > LEAST_INFORMATION_RATIO and self._against <= self._learnt:
                return
            self._forget()
        self._against, self._learnt = 0, self._learnt + 1
        if self._seen is not None:
            before_m, before = self._seen
            self._alike.learn((error_m - before_m) ** 2 / (variance + before))
        self._seen = error_m, variance
        variance *= self._alike.count
        with_sum = self._covariance.sum(axis=1)
        gain = with_sum / (with_sum.sum() + variance)
        self._mean = self._mean + gain * (error_m - self._mean.sum())
        self._covariance = self._covariance - np.outer(gain, with_sum)
