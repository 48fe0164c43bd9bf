"""Still frames made up from a gripper's geometry, with errors of known covariance: for the tests of recalibration."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from gripmon.judge.recalibrate import StillFrame
from gripmon.model.geometry import perturb, skew, to_record
from gripmon.model.gripper import Gripper
from gripmon.model.records import EdgeSums, ReferenceRecord
from support.simulated import nominal_cam_T_grip, sharp_gripper

FOCAL_PX = 962.0
REFERENCE_T = nominal_cam_T_grip()
KNOCK = np.array([0.003, -0.002, 0.001, 0.01, -0.02, 0.015])
TRUE_T = perturb(REFERENCE_T, KNOCK)
POINTS, PER_STRETCH, POINT_PX = 24, 8, 0.05
LASTING = np.diag(np.square([3e-6, 3e-6, 8e-6, 2e-4, 2e-4, 1e-4]))
CHANGING = np.diag(np.square([4e-6, 3e-6, 9e-6, 2e-4, 3e-4, 1e-4]))


def reference() -> ReferenceRecord:
    covariance = tuple((np.eye(6) * 1e-8).ravel().tolist())
    return ReferenceRecord("before", 1, 0, "configuration", to_record(REFERENCE_T), covariance)


def image(points_m: np.ndarray, cam_T_grip: np.ndarray) -> np.ndarray:
    points = points_m @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3]
    return points[:, :2] / points[:, 2:]


def by_motion(points_m: np.ndarray, cam_T_grip: np.ndarray) -> np.ndarray:
    """(n, 2, 6) derivative of :func:`image` by a perturbation of the transform."""
    levers = points_m @ cam_T_grip[:3, :3].T
    x, y, z = (levers + cam_T_grip[:3, 3]).T
    by_point = np.zeros((len(z), 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = 1.0 / z
    by_point[:, 0, 2], by_point[:, 1, 2] = -x / z**2, -y / z**2
    return np.concatenate([by_point, -by_point @ skew(levers)], axis=2)


@dataclass
class Scene:
    """What made-up frames show: standard deviation ``corner_px`` of the corners, the ``lasting`` and the ``changing``
    covariance of the tracked poses, corners that are ``hidden`` and by how much some are ``off_px`` (name: u, v),
    ``bend_m`` of the first finger in gripper axes, the jaw's ``openings_m`` in turn.
    """

    gripper: Gripper = field(default_factory=sharp_gripper)
    true_T: np.ndarray = field(default_factory=lambda: TRUE_T)
    corner_px: float = 0.05
    lasting: np.ndarray = field(default_factory=lambda: LASTING)
    changing: np.ndarray = field(default_factory=lambda: CHANGING)
    hidden: tuple[str, ...] = ()
    off_px: dict[str, tuple[float, float]] = field(default_factory=dict)
    bend_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    openings_m: tuple[float | None, ...] = (None,)
    fingers: tuple[str, ...] = ()

    def frames(self, count: int, seed: int = 1) -> list[StillFrame]:
        rng = np.random.default_rng(seed)
        lasting = rng.multivariate_normal(np.zeros(6), self.lasting)
        visible = self._visible()
        lasting_px = rng.normal(0.0, 0.7 * self.corner_px, (len(visible), 2))
        edge_px = rng.normal(0.0, POINT_PX, 100)
        return [
            self._frame(rng, k, visible, lasting, lasting_px, edge_px, self.openings_m[k % len(self.openings_m)])
            for k in range(count)
        ]

    def _visible(self) -> np.ndarray:
        eye = -self.true_T[:3, :3].T @ self.true_T[:3, 3]
        visible = self.gripper.corners_visible(self.gripper.points_grip_m(None), eye)
        return visible & ~np.isin(self.gripper.corner_ids, self.hidden)

    def _frame(
        self,
        rng: np.random.Generator,
        seq: int,
        visible: np.ndarray,
        lasting: np.ndarray,
        lasting_px: np.ndarray,
        edge_px: np.ndarray,
        opening_m: float | None,
    ) -> StillFrame:
        gripper = self.gripper
        points = gripper.points_grip_m(opening_m)
        corners = points[gripper.corner_points]
        noise_px = lasting_px + rng.normal(0.0, 0.7141 * self.corner_px, lasting_px.shape)
        for name, off in self.off_px.items():
            noise_px[gripper.corner_ids.index(name)] += off
        covariance_xy = np.eye(2 * int(visible.sum())) * (self.corner_px / FOCAL_PX) ** 2
        tracked_T = perturb(self.true_T, -lasting - rng.multivariate_normal(np.zeros(6), self.changing))
        return StillFrame(
            seq,
            1_000_000 * seq,
            tracked_T,
            self.lasting + self.changing,
            corners,
            visible,
            np.where(visible[:, None], image(corners, self.true_T) + noise_px / FOCAL_PX, np.nan),
            covariance_xy,
            self._edges(rng, points, tracked_T, edge_px),
        )

    def _edges(self, rng: np.random.Generator, points: np.ndarray, tracked_T: np.ndarray, edge_px: np.ndarray):
        gripper = self.gripper
        eye = -self.true_T[:3, :3].T @ self.true_T[:3, 3]
        shown = [
            int(e)
            for e in np.flatnonzero(gripper.edge_view(points, eye).visible)
            if not self.fingers or gripper.finger_ids[gripper.edge_finger[e]] in self.fingers
        ]
        rows = []
        for edge in shown:
            ends = points[gripper.edge_points[edge]]
            along = np.linspace(0.05, 0.95, POINTS)[:, None]
            on_edge = ends[0] + along * (ends[1] - ends[0])
            xy = image(on_edge, tracked_T)
            direction = xy[-1] - xy[0]
            normal = np.array([-direction[1], direction[0]]) / np.linalg.norm(direction)
            bend = np.array(self.bend_m) * (gripper.edge_finger[edge] == 0)
            # A bent finger shows along its edge as far as it has been shifted there.
            offset_px = (image(on_edge + bend, self.true_T) - xy) @ normal * FOCAL_PX
            offset_px += 0.7 * edge_px[edge] + rng.normal(0.0, POINT_PX, POINTS)
            jacobian = FOCAL_PX * np.einsum("i,nij->nj", normal, by_motion(on_edge, tracked_T))
            for stretch in range(POINTS // PER_STRETCH):
                part = slice(stretch * PER_STRETCH, (stretch + 1) * PER_STRETCH)
                rows.append((edge, stretch, offset_px[part], jacobian[part]))
        weight = 1.0 / POINT_PX**2
        edges = np.array([r[0] for r in rows], dtype=np.intp)
        return EdgeSums(
            edge=edges,
            finger=gripper.edge_finger[edges],
            stretch=np.array([r[1] for r in rows], dtype=np.intp),
            weight=np.full(len(rows), weight * PER_STRETCH),
            residual_px=np.array([r[2].mean() for r in rows]),
            jacobian=np.array([r[3].mean(axis=0) for r in rows]).reshape(-1, 6),
            moment=np.array([weight * r[3].T @ r[2] for r in rows]).reshape(-1, 6),
            information=np.array([weight * r[3].T @ r[3] for r in rows]).reshape(-1, 6, 6),
            spread_px=np.zeros(len(rows)),
        )


def moved(frame: StillFrame, xi: np.ndarray) -> StillFrame:
    """The same with another tracked pose."""
    return replace(frame, cam_T_grip=perturb(frame.cam_T_grip, xi))
