"""The transform averaged over time: a Kalman filter for a camera that stands still or creeps.

The state is the pose itself, its covariance that of ``xi = (rho, omega)``.  Between frames the pose may wander like a
random walk; an innovation that the two covariances don't explain, twice in a row, starts the average anew.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta
from scipy.linalg.lapack import dposv

from gripmon.geometry import perturb, perturbation_between
from gripmon.records import Array

GATE = 37.7
"""Squared normalised innovation that six normal errors exceed once in a million frames (chi-square, 6 degrees of
freedom).
"""

INDEPENDENT_FRAMES = 10.0
"""Averaging more frames than this doesn't help: background that stands still shifts the edges in all of them."""

MEMORY = 0.05
"""Rate of the running means of innovations, per frame."""


class SmoothingSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How far the mount may creep between frames."""

    creep_m_per_sqrt_s: Annotated[
        float,
        Meta(
            ge=0.0, le=0.1, description="random walk of the TCP's position, each axis (m per square root of a second)"
        ),
    ] = 1e-5
    creep_rad_per_sqrt_s: Annotated[
        float,
        Meta(ge=0.0, le=1.0, description="random walk of the rotation, each axis (rad per square root of a second)"),
    ] = 1e-4


class PoseAverage:
    """Running average of ``cam_T_grip``; ``cam_T_grip`` is None until the first measurement."""

    def __init__(self, settings: SmoothingSettings):
        rates = [settings.creep_m_per_sqrt_s] * 3 + [settings.creep_rad_per_sqrt_s] * 3
        self._variance_per_s = np.square(rates)
        self.cam_T_grip: Array | None = None
        self.covariance: Array = np.zeros((6, 6))
        self._suspicions = 0
        self._lag: Array = np.zeros(6)
        self._surprise = 1.0
        self._newest_covariance: Array = np.zeros((6, 6))

    @property
    def claimed_covariance(self) -> Array:
        """Covariance (6, 6) of the average's error as it shows: the filter's own, made larger by what innovations say.

        Frames err together, so the average is worth :data:`INDEPENDENT_FRAMES` frames at most; innovations that are
        larger than they should be, or that all point the same way because the average lags behind a creeping mount,
        count with the size that they have.
        """
        white = self.covariance + self._newest_covariance / INDEPENDENT_FRAMES
        return max(1.0, self._surprise) * white + np.outer(self._lag, self._lag)

    def forget(self) -> None:
        """Start anew with the next measurement."""
        self.cam_T_grip = None

    def wander(self, elapsed_s: float) -> None:
        """Time passes: the covariance grows by the random walk."""
        self.covariance.flat[::7] += self._variance_per_s * elapsed_s

    def add(self, cam_T_grip: Array, covariance: Array) -> None:
        """One measurement (4, 4) with the covariance (6, 6) of its error."""
        if self.cam_T_grip is None:
            self._restart(cam_T_grip, covariance)
            return
        innovation = perturbation_between(self.cam_T_grip, cam_T_grip)
        # (P + R)^-1 (P | innovation) in one solve: gain transposed and normalised innovation.
        sides = np.empty((6, 7), order="F")  # as LAPACK wants it: no copy
        sides[:, :6], sides[:, 6] = self.covariance, innovation
        _, both, failed = dposv(self.covariance + covariance, sides)
        if failed:
            raise ValueError("a covariance that is not positive definite")
        surprise = float(innovation @ both[:, 6])
        self._lag = self._lag + MEMORY * (innovation - self._lag)
        self._surprise += MEMORY * (surprise / 6.0 - self._surprise)
        self._newest_covariance = covariance
        if surprise > GATE:
            self._suspicions += 1
            if self._suspicions >= 2:
                self._restart(cam_T_grip, covariance)
            return
        self._suspicions = 0
        gain = both[:, :6].T
        self.cam_T_grip = perturb(self.cam_T_grip, gain @ innovation)
        self.covariance = self.covariance - gain @ self.covariance
        self.covariance = 0.5 * (self.covariance + self.covariance.T)

    def _restart(self, cam_T_grip: Array, covariance: Array) -> None:
        self.cam_T_grip, self.covariance = cam_T_grip, covariance.copy()
        self._lag, self._surprise, self._newest_covariance = np.zeros(6), 1.0, covariance
        self._suspicions = 0
