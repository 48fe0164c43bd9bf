"""What a laser set-up's refinement minimises: spots against their predictions, and what is known beforehand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gripmon.calibrate.bundle import LensModel
from gripmon.calibrate.sighting import CalibrationError
from gripmon.laser.pointer.setup import PARAMETERS, LaserSetup, pose_slopes, spots_on_plane
from gripmon.model.camera import Camera
from gripmon.model.least_squares import whitening
from gripmon.model.records import Array

_FX, _FY = 0, 1  # the first two parameters of every lens model


@dataclass(frozen=True, slots=True)
class LensPrior:
    """A calibrated lens that may be refined, too: all its ``parameters`` (k,); ``free`` (p,) which of them were
    estimated; ``covariance`` (p, p) of these.  Where fx alone was, the aspect was held and fy follows.
    """

    model: LensModel
    parameters: Array
    free: tuple[int, ...]
    covariance: Array

    @property
    def root(self) -> Array:
        """(p, p), makes changes of the free parameters normal with unit variance.  Raises :class:`CalibrationError`."""
        try:
            return whitening(self.covariance)
        except np.linalg.LinAlgError:
            raise CalibrationError("the camera's covariance is no covariance (not positive definite)") from None

    @property
    def slopes(self) -> Array:
        """(k, p), all parameters by the free ones."""
        out = np.zeros((len(self.parameters), len(self.free)))
        out[list(self.free), np.arange(len(self.free))] = 1.0
        if _FX in self.free and _FY not in self.free:
            out[_FY, self.free.index(_FX)] = self.parameters[_FY] / self.parameters[_FX]
        return out


@dataclass(frozen=True, slots=True)
class PoseNoise:
    """Standard deviations of each pose that the arm reports: position, each axis, and rotation about each axis."""

    position_m: float
    rotation_rad: float

    def covariance(self) -> Array:
        """(6, 6), position then rotation."""
        return np.diag(np.square([self.position_m] * 3 + [self.rotation_rad] * 3))


@dataclass(frozen=True, slots=True)
class State:
    """What is estimated: the set-up, and changes (p,) of the lens's free parameters (none where it is held)."""

    setup: LaserSetup
    lens: Array

    def moved(self, change: Array) -> State:
        count = len(PARAMETERS)
        return State(self.setup.moved(change[:count]), self.lens + change[count:])


class SpotProblem:
    """Spots ``uv_px`` (n, 2) with ``covariance_px`` (n, 2, 2), the unit's one pixel if None, at ``base_T_ee``
    (n, 4, 4).  Covariances are believed up to a common scale, with what the arm's noise adds to them.
    """

    def __init__(
        self,
        camera: Camera,
        base_T_ee: Array,
        uv_px: Array,
        covariance_px: Array | None = None,
        *,
        lens: LensPrior | None = None,
        pose_noise: PoseNoise | None = None,
    ):
        self.base_T_ee, self.uv_px = base_T_ee, uv_px
        self._camera, self._lens, self._pose_noise = camera, lens, pose_noise
        self._spots_px2 = np.tile(np.eye(2), (len(uv_px), 1, 1)) if covariance_px is None else covariance_px
        self._whiten = whitening(self._spots_px2)
        self._root = np.empty((0, 0)) if lens is None else lens.root

    def __len__(self) -> int:
        return len(self.uv_px)

    @property
    def unknowns(self) -> int:
        """How many parameters are estimated."""
        return len(PARAMETERS) + len(self._root)

    def start(self, setup: LaserSetup) -> State:
        """A state with the lens as it was calibrated."""
        return State(setup, np.zeros(len(self._root)))

    def camera(self, state: State) -> Camera:
        """The camera of a state."""
        if self._lens is None:
            return self._camera
        return self._lens.model.camera(self._parameters(self._lens, state))

    def with_pose_noise(self, state: State) -> SpotProblem:
        """With what the arm's noise adds to the spots' covariances at a state."""
        if self._pose_noise is None:
            return self
        spots, _ = spots_on_plane(state.setup, self.base_T_ee)
        _, by_point = self.camera(state).project_with_jacobian(spots)
        slopes = by_point @ pose_slopes(state.setup, self.base_T_ee)
        added = slopes @ self._pose_noise.covariance() @ slopes.transpose(0, 2, 1)
        added[~np.isfinite(added).all(axis=(1, 2))] = 0.0
        out = SpotProblem(self._camera, self.base_T_ee, self.uv_px, self._spots_px2 + added, lens=self._lens)
        out._pose_noise, out._spots_px2 = self._pose_noise, self._spots_px2
        return out

    def residuals_px(self, state: State) -> Array:
        """(n, 2), measured less predicted; NaN where the set-up puts no spot before the camera."""
        spots, _ = spots_on_plane(state.setup, self.base_T_ee)
        return self.uv_px - self.camera(state).project(spots)

    def sizes(self, state: State) -> Array:
        """(n,) lengths of the whitened residuals; infinite where there is none."""
        sizes = np.linalg.norm(np.einsum("nij,nj->ni", self._whiten, self.residuals_px(state)), axis=1)
        return np.where(np.isfinite(sizes), sizes, np.inf)

    def linearised(self, state: State) -> tuple[Array, Array]:
        """Whitened rows (n, 2, p) and residuals (n, 2) at a state; zero where there is no spot."""
        spots, slopes = spots_on_plane(state.setup, self.base_T_ee)
        if self._lens is None:
            uv_px, by_point = self._camera.project_with_jacobian(spots)
            rows = by_point @ slopes
        else:
            uv_px, by_lens, by_point = self._lens.model.project(self._parameters(self._lens, state), spots)
            rows = np.concatenate([by_point @ slopes, by_lens @ self._lens.slopes], axis=2)
        rows = self._whiten @ rows
        values = np.einsum("nij,nj->ni", self._whiten, self.uv_px - uv_px)
        good = np.isfinite(values).all(axis=1) & np.isfinite(rows).all(axis=(1, 2))
        rows[~good], values[~good] = 0.0, 0.0
        return rows, values

    def prior(self, state: State) -> tuple[Array, Array]:
        """Whitened rows (p, unknowns) and residuals (p,) of what is known of the lens."""
        rows = np.zeros((len(self._root), self.unknowns))
        rows[:, len(PARAMETERS) :] = self._root
        return rows, -self._root @ state.lens

    @staticmethod
    def _parameters(lens: LensPrior, state: State) -> Array:
        out: Array = lens.parameters + lens.slopes @ state.lens
        return out
