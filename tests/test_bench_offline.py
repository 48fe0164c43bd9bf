"""``tools/bench offline`` in small: its images against projections, its verdicts, its peers, its tables."""

from __future__ import annotations

import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("tools_importable")


def test_discs_lie_where_they_are_projected_to():
    """Centroids of what is dark against the disc's outline, sent point by point through the camera."""
    from benchmarks.offline_images import DISCS, PAPER_LENS, Setting

    from gripmon.model.camera import make_camera
    from gripmon.simulate.plates import Plate, Print

    setting = Setting.random(np.random.default_rng(2), print_m=5e-5)
    assert setting.errors_m is not None
    cam_T_plate = setting.cam_T_grip @ setting.grip_T_plate
    light = Plate(DISCS, cam_T_plate, Print(margin=np.inf, errors_m=setting.errors_m)).light(PAPER_LENS, 0.6)
    camera, way = make_camera(PAPER_LENS), np.linspace(0.0, 2.0 * np.pi, 400, endpoint=False)
    for column, row in ((3, 3), (4, 5), (5, 2)):
        centre = np.array([column, row]) * DISCS.spacing_m + setting.errors_m[row, column]
        ring = centre + 0.5 * DISCS.diameter_m * np.stack([np.cos(way), np.sin(way)], axis=1)
        points = np.column_stack([ring, np.zeros(len(ring))]) @ cam_T_plate[:3, :3].T + cam_T_plate[:3, 3]
        u, v = camera.project(points).T
        cross = u * np.roll(v, -1) - np.roll(u, -1) * v
        area = 0.5 * cross.sum()
        inside = np.array([((u + np.roll(u, -1)) * cross).sum(), ((v + np.roll(v, -1)) * cross).sum()]) / (6.0 * area)
        a, b = np.rint(inside).astype(int)
        window = 200.0 - light[b - 22 : b + 23, a - 22 : a + 23].astype(float)
        y, x = np.mgrid[b - 22 : b + 23, a - 22 : a + 23]
        found = np.array([(window * x).sum(), (window * y).sum()]) / window.sum()
        np.testing.assert_allclose(found, inside, atol=5e-3)
        assert window.sum() / 160.0 == pytest.approx(abs(area), rel=1e-3)


@pytest.mark.slow("5 s: a benchmark in small; plane and intrinsics have tests of their own")
def test_a_trial_finds_the_gripper_and_a_gap_is_told_of():
    """Against bounds that are ten times the tool centre point's stated deviation, not the benchmark's own."""
    from benchmarks import offline, offline_plane

    done: list[int] = []
    errors = offline_plane.trials(2, 1, 0.0, lambda: done.append(1))
    assert [row.way for row in errors] == list(offline_plane.WAYS) and len(done) == 2
    for row in errors[:2]:
        assert len(row.error) + len(row.refused) == 2 and row.error
        assert (row.position_mm < 1e4 * np.array(row.claimed_m)).all()
    gap = offline_plane.Revealed("0.1 mm above", 1.0)
    for seed in (4, 5):
        rng = np.random.default_rng(seed)
        setting = offline_plane.Setting.random(rng, gap_m=offline_plane.GAP_M)
        apart = np.array([0.0, 0.0, offline_plane.GAP_M])
        offline_plane._look(gap, setting, setting.simulators(1, (1.0,))[0].render(0), rng, apart)
    assert gap.count == 2 and gap.by_residuals == 2 and gap.by_apart == len(gap.apart) == 2
    assert [a[2] for a in gap.apart] == pytest.approx([offline_plane.GAP_M] * 2, rel=0.5)
    # Three corners alone can't tell; four can.
    assert min(gap.power) > 0.5 and min(gap.corner_power) == 0.0 and max(gap.corner_power) > 0.9
    text = offline.report(errors, [gap], [], [], 1, ["something"])
    assert "first seed 1" in text and "MISSED: something" in text and "nan" not in text


@pytest.mark.slow("5 s: a benchmark in small; plane and intrinsics have tests of their own")
def test_everybody_calibrates_the_same_camera():
    """Errors of the mapping by their definition, and two other libraries near us on points of a known noise."""
    import msgspec
    from benchmarks import offline_intrinsics as cameras

    turned = msgspec.structs.replace(cameras.LENS, fx_px=cameras.LENS.fx_px + 2.0)
    assert cameras.mapping_px(cameras.LENS) < 1e-9
    assert 0.05 < cameras.mapping_px(turned) < 2.0
    rng = np.random.default_rng(1)
    images = cameras.views(cameras.LENS, cameras.BOARD, 5, rng)
    assert all(image.shape == (cameras.LENS.height_px, cameras.LENS.width_px) for image in images)
    names = [cameras.OURS, cameras.OPENCV, cameras.OPENCV_OURS] + [cameras.COLMAP] * cameras.colmap_installed()
    fits = {who: cameras.Fits(who) for who in names}
    ours, theirs = cameras.Found("us"), cameras.Found("them")
    cameras._fit_all(fits, cameras._ours(images, ours), cameras._opencv(images, theirs))
    assert ours.found == theirs.found == 5
    for who, row in fits.items():
        assert row.failed == 0 and row.mapping_px[0] < 0.5, who
    same = [fits[who].error[0] for who in names if who not in (cameras.OPENCV, cameras.OURS)]
    np.testing.assert_allclose(same[-1], same[0], atol=1e-2)
