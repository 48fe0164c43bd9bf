"""The paper's two series as the simulator shows them: pairs of images of a gripper parked on a plate of discs."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from support.simulated import simulator

from gripmon.simulate import Simulator, make_scenario


def plate_points_m(series: Simulator, index: int, uv_px: np.ndarray) -> np.ndarray:
    """Where the rays of pixels meet the plane of the fingertips, gripper frame (n, 3)."""
    cam_T_grip = series.truth(index).cam_T_grip
    rays = np.column_stack([series.camera.undistort(uv_px), np.ones(len(uv_px))])
    grip_R_cam = cam_T_grip[:3, :3].T
    eye, directions = -grip_R_cam @ cam_T_grip[:3, 3], rays @ grip_R_cam.T
    return eye - directions * (eye[2] / directions[:, 2])[:, None]


@pytest.mark.parametrize("name", ["series1", "series2"])
def test_the_plate_touches_the_fingertips_and_does_not_move_against_them(name: str):
    """The image before, seen through the plane of the fingertips from the pose after, is the image after."""
    series = simulator(make_scenario(name), sharp=False)
    before, after = series.render(0).astype(np.float32), series.render(1)
    u, v = np.meshgrid(np.arange(60, 710, dtype=float), np.arange(20, 200, dtype=float))  # above the fingertips
    points = plate_points_m(series, 1, np.column_stack([u.ravel(), v.ravel()]))
    assert np.abs(points[:, 2]).max() < 1e-12
    cam_T_grip = series.truth(0).cam_T_grip
    uv = series.camera.project(points @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3]).astype(np.float32)
    shown = ((uv > 2.0) & (uv < [765.0, 220.0])).all(axis=1)
    maps = (uv[:, k].reshape(u.shape) for k in (0, 1))
    warped = cv2.remap(before, *maps, cv2.INTER_CUBIC).ravel()
    seen = after[20:200, 60:710].ravel().astype(float)
    assert np.count_nonzero(shown) > 50_000
    assert np.corrcoef(warped[shown], seen[shown])[0, 1] > 0.97
    # Discs of 4 mm on a square grid of 8 mm cover a fifth of it.
    dark = seen[shown] < 0.5 * (np.percentile(seen, 2) + np.percentile(seen, 98))
    assert dark.mean() == pytest.approx(np.pi * 4.0 / 64.0, abs=0.05)


@pytest.mark.parametrize(("name", "shift_mm", "sigma_mm"), [("series1", (1.5, 0.0), 0.3), ("series2", (0.0, 4.5), 0.2)])
def test_twenty_pairs_with_the_papers_displacements(name: str, shift_mm: tuple[float, float], sigma_mm: float):
    series = simulator(make_scenario(name), sharp=False)
    assert series.frame_count == 40
    truths = [series.truth(i) for i in range(40)]
    shifts_mm = 1e3 * np.array([t.tcp_shift_m for t in truths[1::2]])
    np.testing.assert_allclose(shifts_mm[:, :2].mean(axis=0), shift_mm, atol=4.0 * sigma_mm / np.sqrt(20.0))
    assert shifts_mm[:, :2].std(axis=0) == pytest.approx([sigma_mm] * 2, rel=0.6)
    assert not np.any([t.tcp_shift_m for t in truths[::2]])
    for before, after in zip(truths[::2], truths[1::2], strict=True):
        np.testing.assert_array_equal(before.cam_T_grip, after.reference_cam_T_grip)
