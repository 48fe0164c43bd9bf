"""The state of everything that may have moved, and where the edges' stretches are predicted for it.

The unknowns are one vector for all models: the camera's pose (6), the jaw opening (1), the logarithm of the focal
length (1), and six for each finger.  A model of what moved frees some of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.judge.causes.kernel import FINGERS, FOCAL, JAW, POSE, beside_edges
from gripmon.model.camera import Camera
from gripmon.model.geometry import exp_rotation, perturb, perturbation_between
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, EdgeEvidence


def finger_slice(finger: int) -> slice:
    return slice(FINGERS + 6 * finger, FINGERS + 6 * (finger + 1))


@dataclass(frozen=True, slots=True)
class State:
    """``cam_T_grip`` (4, 4), ``jaw_opening_m``, ``log_focal``: logarithm of the focal length over the calibrated one,
    ``finger`` (f, 6): each finger's own motion beyond that, translation (m) and rotation vector (rad).
    """

    cam_T_grip: Array
    jaw_opening_m: float
    log_focal: float
    finger: Array

    def moved(self, step: Array, gripper: Gripper) -> State:
        """After a step (m,) of all unknowns; an opening beyond the jaw's range stays at its end."""
        opening_m = min(max(self.jaw_opening_m + float(step[JAW]), gripper.jaw_min_m), gripper.jaw_max_m)
        return State(
            perturb(self.cam_T_grip, step[POSE]),
            opening_m,
            self.log_focal + float(step[FOCAL]),
            self.finger + step[FINGERS:].reshape(-1, 6),
        )

    def since(self, before: State) -> Array:
        """(m,) the unknowns that lead from another state to this one."""
        return np.concatenate(
            [
                perturbation_between(before.cam_T_grip, self.cam_T_grip),
                [self.jaw_opening_m - before.jaw_opening_m, self.log_focal - before.log_focal],
                (self.finger - before.finger).ravel(),
            ]
        )


def opened(gripper: Gripper, jaw_opening_m: float) -> tuple[Array, Array]:
    """All points (p, 3) in the gripper frame at an opening, and their derivative by it (p, 3)."""
    points = gripper.points_grip_m(jaw_opening_m if gripper.has_jaw else None)
    return points, gripper.point_motion(jaw_opening_m)


def points_cam(gripper: Gripper, state: State, at_opening: tuple[Array, Array]) -> tuple[Array, Array, Array]:
    """All points (p, 3) in the camera frame, their derivative by the opening (p, 3), and the middles of the fingers'
    points (f, 3) before their own motion; ``at_opening`` from :func:`opened`.
    """
    rotation = state.cam_T_grip[:3, :3]
    points = at_opening[0] @ rotation.T + state.cam_T_grip[:3, 3]
    rate = at_opening[1] @ rotation.T
    own = gripper.point_finger == np.arange(len(gripper.finger_ids))[:, None]
    middle = own @ points / np.count_nonzero(own, axis=1)[:, None]
    for finger in np.flatnonzero(state.finger.any(axis=1)).tolist():
        motion, lever = state.finger[finger], points[own[finger]] - middle[finger]
        points[own[finger]] += lever @ (exp_rotation(motion[3:]) - np.eye(3)).T + motion[:3]
    return points, rate, middle


def edge_places(gripper: Gripper, state: State, edge: NDArray[np.intp], fraction: Array) -> tuple[Array, Array]:
    """Ideal image coordinates (s, 2) of places on edges with the calibrated focal length, and the direction (s, 2)
    across them in which offsets count as positive.
    """
    points, _, _ = points_cam(gripper, state, opened(gripper, state.jaw_opening_m))
    a, b = gripper.tangents_m(points, edge, fraction, state.cam_T_grip[:3, :3])
    spot = a + fraction[:, None] * (b - a)
    return spot[:, :2] / spot[:, 2:], _across(a, b)


class EdgeView:
    """Predicts the stretches of one frame's evidence."""

    def __init__(self, camera: Camera, gripper: Gripper, evidence: EdgeEvidence):
        self._gripper, self._evidence = gripper, evidence
        self._start = gripper.edge_points[evidence.edge, 0]
        self._finger = gripper.edge_finger[evidence.edge]
        self._per_px = np.ascontiguousarray(evidence.per_px)
        self._camera = camera
        self._uv_px = camera.distort(evidence.xy)
        self._centre_px = np.array([camera.cx_px, camera.cy_px])
        # Most models leave the opening and the focal length as they are.
        self._opened: tuple[float, tuple[Array, Array]] | None = None
        self._at: tuple[float, tuple[Array, Array]] | None = None

    def residual(self, state: State) -> tuple[Array, Array]:
        """(s,) measured minus predicted place of each stretch across its edge, px, and (s, m) the derivative of the
        predicted one by all unknowns.
        """
        return self._beside(state)[:2]

    def beside(self, state: State) -> tuple[Array, Array]:
        """(s,) measured minus predicted place of each stretch across its edge, px, and the fraction (s,) of the edge's
        image beside which it lies: :func:`edge_places` there, and so much across, is the measured place.
        """
        residual, _, fraction = self._beside(state)
        return residual, fraction

    def _beside(self, state: State) -> tuple[Array, Array, Array]:
        if self._opened is None or self._opened[0] != state.jaw_opening_m:
            self._opened = state.jaw_opening_m, opened(self._gripper, state.jaw_opening_m)
        points, rate, middle = points_cam(self._gripper, state, self._opened[1])
        evidence, pose = self._evidence, state.cam_T_grip
        a, b = self._gripper.tangents_m(points, evidence.edge, evidence.fraction, pose[:3, :3])
        xy, by_focal = self._ideal(state.log_focal)
        pivots = middle + state.finger[:, :3]
        found: tuple[Array, Array, Array] = beside_edges(
            a, b, xy, by_focal, self._per_px, rate[self._start], self._finger, pose[:3, 3].copy(), pivots
        )
        return found

    def _ideal(self, log_focal: float) -> tuple[Array, Array]:
        """Ideal coordinates (s, 2) of the stretches with another focal length, and (s, 2) what its logarithm moves
        *predictions* by.
        """
        if self._at is not None and self._at[0] == log_focal:
            return self._at[1]
        from_centre = self._uv_px - self._centre_px
        xy, d_xy = self._camera.undistort_with_jacobian(self._centre_px + from_centre * np.exp(-log_focal))
        self._at = log_focal, (xy, np.einsum("sij,sj->si", d_xy, from_centre) * np.exp(-log_focal))
        return self._at[1]


def _across(a: Array, b: Array) -> Array:
    """(s, 2) across the images of edges from a to b, ideal coordinates, along the search lines' direction."""
    along = b[:, :2] / b[:, 2:] - a[:, :2] / a[:, 2:]
    along /= np.sqrt(np.einsum("si,si->s", along, along))[:, None]
    return np.column_stack([-along[:, 1], along[:, 0]])


def finger_lever_m(gripper: Gripper) -> Array:
    """(f,) root mean square distance of a finger's points from their middle: turns by a lever of one radian show as
    motions of that size.
    """
    points = gripper.points_grip_m(None)
    levers = []
    for finger in range(len(gripper.finger_ids)):
        own = points[gripper.point_finger == finger]
        levers.append(float(np.sqrt(((own - own.mean(axis=0)) ** 2).sum(axis=1).mean())))
    return np.array(levers)
