"""Evidence without images: pieces of edges where a given scene shows them, with known errors."""

from __future__ import annotations

import dataclasses
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gripmon.judge.causes import CauseJudge, CauseSettings
from gripmon.model.camera import Camera, LensSettings, make_camera
from gripmon.model.gripper import Gripper, GripperModel
from gripmon.model.records import Cause, EdgeEvidence
from support.box_models import two_fingers_model
from support.simulated import PAPER_LENS, nominal_cam_T_grip

OPENING_M = 0.034
REFERENCE_SIGMA = np.array([1e-4] * 3 + [1e-3] * 3)
FRACTIONS = (0.15, 0.5, 0.85)
FRAMES = 8
"""After so many :func:`told` asks."""


def knocked(cam_T_grip: np.ndarray, shift_m: tuple[float, ...], turn_deg: tuple[float, ...] = (0, 0, 0)) -> np.ndarray:
    """The gripper shifted in camera axes and turned about its TCP."""
    out = cam_T_grip.copy()
    out[:3, :3] = Rotation.from_rotvec(np.deg2rad(turn_deg)).as_matrix() @ out[:3, :3]
    out[:3, 3] += shift_m
    return out


class Shown:
    """A gripper before a camera, of which pieces of the visible edges are shown."""

    def __init__(self, gripper: Gripper, lens: LensSettings = PAPER_LENS, seed: int = 1) -> None:
        self.gripper, self.camera = gripper, make_camera(lens)
        self.reference = nominal_cam_T_grip()
        self.rng = np.random.default_rng(seed)

    def evidence(
        self,
        cam_T_grip: np.ndarray | None = None,
        *,
        opening_m: float = OPENING_M,
        reported_m: float | None = OPENING_M,
        bent: dict[str, np.ndarray] | None = None,
        camera: Camera | None = None,
        sigma_px: float = 0.03,
        outliers: int = 0,
        blur_px: float = 0.7,
        hidden: tuple[str, ...] = (),
        noise: float = 0.004,
        brightest: float = 0.7,
        steepest: float = 0.3,
        grey: float = 0.4,
    ) -> EdgeEvidence:
        """``bent``: 4x4 motion of a finger's points in the gripper frame; ``camera``: the one that really looks;
        ``outliers``: so many pieces are off by up to 5 px.
        """
        gripper, reference = self.gripper, self.reference
        pose = reference if cam_T_grip is None else cam_T_grip
        points = gripper.points_grip_m(opening_m if gripper.has_jaw else None).copy()
        for name, motion in (bent or {}).items():
            own = gripper.point_finger == gripper.finger_ids.index(name)
            points[own] = points[own] @ motion[:3, :3].T + motion[:3, 3]
        points_cam = points @ pose[:3, :3].T + pose[:3, 3]
        view = gripper.edge_view(gripper.points_grip_m(None), -reference[:3, :3].T @ reference[:3, 3])
        fingers = gripper.edge_finger
        edges = [e for e in np.flatnonzero(view.visible & ~view.crease) if gripper.finger_ids[fingers[e]] not in hidden]
        edge, fraction, uv, across = [], [], [], []
        for e in edges:
            a, b = points_cam[gripper.edge_points[e]]
            for f in FRACTIONS:
                ends = (camera or self.camera).project(np.array([a + (f - 0.01) * (b - a), a + (f + 0.01) * (b - a)]))
                along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
                edge.append(e)
                fraction.append(f)
                uv.append(0.5 * (ends[0] + ends[1]))
                across.append([-along[1], along[0]])
        off_px = self.rng.normal(0.0, sigma_px, len(edge))
        wrong = self.rng.permutation(len(edge))[:outliers]
        off_px[wrong] += self.rng.uniform(-5.0, 5.0, len(wrong))
        across_px = np.reshape(across, (-1, 2))
        uv_px = np.reshape(uv, (-1, 2)) + off_px[:, None] * across_px
        xy, d_xy = self.camera.undistort_with_jacobian(uv_px)
        return EdgeEvidence(
            cam_T_grip=pose,
            jaw_opening_m=opening_m,
            jaw_reported_m=reported_m if gripper.has_jaw else None,
            edge=np.array(edge, dtype=np.intp),
            fraction=np.array(fraction),
            xy=xy,
            per_px=np.linalg.norm(np.einsum("sij,sj->si", d_xy, across_px), axis=1),
            sigma_px=np.full(len(edge), max(sigma_px, 1e-3)),
            spread_px=np.full(len(edge), 0.02),
            blur_px2=np.full(len(edge), blur_px**2),
            across=across_px,
            finger_share=np.array([0.05 if name in hidden else 0.8 for name in gripper.finger_ids]),
            noise=noise,
            brightest=brightest,
            steepest=steepest,
            cells=np.full((12, 16), grey),
            reach_px=7.0,
        )

    def judge(self, *, well: int = 10, jaw_sigma_m: float = 5e-5, **shown: object) -> CauseJudge:
        """A judge that has seen the scene while all was well."""
        settings = CauseSettings()
        judge = CauseJudge(self.camera, self.gripper, settings, REFERENCE_SIGMA, jaw_sigma_m, 2e-4)
        for _ in range(well):
            judge.well(self.evidence(**shown))  # type: ignore[arg-type]
        return judge


def bend(gripper: Gripper, finger: str, tip_shift_m: tuple[float, float]) -> np.ndarray:
    """A turn about the middle of the finger's rearmost points that shifts its tip across it, gripper frame."""
    points = gripper.points_grip_m(None)[gripper.point_finger == gripper.finger_ids.index(finger)]
    root, tip = points[points[:, 2] < points[:, 2].min() + 1e-3].mean(axis=0), points[:, 2].max()
    length = tip - root[2]
    turn = Rotation.from_rotvec([-tip_shift_m[1] / length, tip_shift_m[0] / length, 0.0]).as_matrix()
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn, root - turn @ root
    return motion


def two_fingers() -> Gripper:
    return Gripper(msgspec.convert(two_fingers_model(), GripperModel))


def told(shown: Shown, judge: CauseJudge, **scene: Any) -> tuple[Cause, str | None, str]:
    for _ in range(FRAMES):
        judge.add(shown.evidence(**scene))
    explanation = judge.explanation(shown.reference)
    assert sum(c.probability for c in explanation.causes) == pytest.approx(1.0)
    assert [c.probability for c in explanation.causes] == sorted(
        (c.probability for c in explanation.causes), reverse=True
    )
    return explanation.probable.cause, explanation.probable.part, explanation.text


def ill_seen(evidence: EdgeEvidence, *shares: float) -> EdgeEvidence:
    """With other shares of the fingers' profiles that agree."""
    return dataclasses.replace(evidence, finger_share=np.array(shares))


def beside(shown: Shown, evidence: EdgeEvidence, edges: tuple[str, ...], off_px: float) -> EdgeEvidence:
    """With a line beside each of some edges taken for them."""
    own = np.isin([shown.gripper.edge_ids[e] for e in evidence.edge], edges)
    uv_px = shown.camera.distort(evidence.xy) + np.where(own, off_px, 0.0)[:, None] * evidence.across
    return dataclasses.replace(evidence, xy=shown.camera.undistort_with_jacobian(uv_px)[0])
