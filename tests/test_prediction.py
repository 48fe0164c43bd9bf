"""Predicted edges: Jacobians by central differences for every lens, normals, lines, and which parts are sampled."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from support.box_models import cube_model
from support.grippers import gripper_from_dict
from support.meters import FISHEYE_LENS, WIDE_LENS, box_gripper, measure, meter, moved
from support.simulated import BOX_FINGERS, PAPER_LENS, STRONG_LENS, nominal_cam_T_grip

from gripmon.daemon.config import read_gripper
from gripmon.model.camera import Camera, LensSettings, make_camera
from gripmon.model.gripper import Gripper
from gripmon.track.edges.lines import CornerGeometry
from gripmon.track.edges.prediction import FEWEST_SAMPLES, Prediction, lay_out, predict
from gripmon.track.edges.profiles import profile_offsets_px
from gripmon.track.edges.settings import CornerSettings, SamplingSettings

LENSES = [PAPER_LENS, STRONG_LENS, FISHEYE_LENS]
LENS_NAMES = ["paper", "brown_conrady", "fisheye"]
OPENING_M = 0.031
ADAPTIVE = read_gripper(BOX_FINGERS.parent / "adaptive_arc_fingers.yaml")
OFFSETS_PX = profile_offsets_px(7.0)


def predicted(
    lens: LensSettings = PAPER_LENS,
    gripper: Gripper | None = None,
    cam_T_grip: np.ndarray | None = None,
    settings: SamplingSettings | None = None,
    jaw_unknown: bool = True,
) -> Prediction:
    camera, gripper = make_camera(lens), gripper or box_gripper()
    pose = nominal_cam_T_grip() if cam_T_grip is None else cam_T_grip
    layout = lay_out(camera, gripper, pose, OPENING_M, settings or SamplingSettings())
    return predict(camera, gripper, layout, pose, OPENING_M, OFFSETS_PX, jaw_unknown)


def ends_cam_m(gripper: Gripper, edge: int, cam_T_grip: np.ndarray, opening_m: float) -> np.ndarray:
    ends = gripper.points_grip_m(opening_m)[gripper.edge_points[edge]]
    return ends @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3]


def crossing_px(camera: Camera, ends_m: np.ndarray, fraction: float, uv_px: np.ndarray, normal: np.ndarray) -> float:
    """Where along a normal the projected edge crosses it: what a profile there would measure."""
    near = np.array([fraction - 2e-3, fraction, fraction + 2e-3])
    curve = camera.project(ends_m[0] + near[:, None] * (ends_m[1] - ends_m[0])) - uv_px
    tangential = curve @ np.array([normal[1], -normal[0]])
    # The parabola through three points of the curve, taken where it meets the normal.
    fit = np.polyfit(near - fraction, np.column_stack([tangential, curve @ normal]), 2)
    roots = np.roots(fit[:, 0])
    at = float(roots[np.argmin(np.abs(roots))].real)
    return float(np.polyval(fit[:, 1], at))


@pytest.mark.parametrize("gripper", [box_gripper(), ADAPTIVE], ids=["along an axis", "on an arc"])
@pytest.mark.parametrize("lens", LENSES, ids=LENS_NAMES)
def test_jacobian_is_the_motion_of_the_edge_along_its_normal(lens: LensSettings, gripper: Gripper):
    """All seven columns: the moved edge, projected through the lens, is intersected with the profile."""
    camera, pose = make_camera(lens), nominal_cam_T_grip()
    prediction = predicted(lens, gripper)
    steps = np.array([2e-6] * 3 + [2e-5] * 3 + [2e-6])
    for i in range(0, len(prediction.uv_px), 7):
        edge, fraction = prediction.layout.edge[i], prediction.layout.fraction[i]
        numeric = np.empty(7)
        for k, step in enumerate(steps):
            sides = []
            for sign in (1.0, -1.0):
                xi = np.zeros(7)
                xi[k] = sign * step
                ends = ends_cam_m(gripper, edge, moved(pose, xi[:6]), OPENING_M + xi[6])
                sides.append(crossing_px(camera, ends, fraction, prediction.uv_px[i], prediction.normal[i]))
            numeric[k] = (sides[0] - sides[1]) / (2.0 * step)
        # Relative to how far each unknown moves any edge at all.
        scale = np.abs(prediction.jacobian).max(axis=0)
        np.testing.assert_allclose(prediction.jacobian[i] / scale, numeric / scale, atol=2e-5)


@pytest.mark.parametrize("shift_m", [0.0, 0.01, 0.03], ids=["inside", "partly outside", "half outside"])
def test_samples_lie_in_the_image_on_visible_outlines_away_from_their_ends(shift_m: float):
    camera, gripper = make_camera(PAPER_LENS), box_gripper()
    pose = moved(nominal_cam_T_grip(), np.array([shift_m, 0.0, 0.0, 0.0, 0.0, 0.0]))
    settings = SamplingSettings()
    prediction = predicted(cam_T_grip=pose)
    view = gripper.edge_view(gripper.points_grip_m(OPENING_M), np.linalg.inv(pose)[:3, 3])
    sampled = np.unique(prediction.layout.edge)
    assert (view.visible & ~view.crease)[sampled].all(), "creases are left out unless asked for"
    # Whole search lines: across the edge, which may run up to the border itself.
    ends_px = prediction.uv_px + np.array([-1.0, 1.0])[:, None, None] * settings.reach_px * prediction.normal
    inside_px = np.minimum(ends_px, [767.0, 575.0] - ends_px).min(axis=(0, 2))
    assert (inside_px >= 1.0).mean() >= 0.97
    np.testing.assert_array_equal(prediction.ok, inside_px >= 1.0)
    for edge in sampled:
        ends_px = camera.project(ends_cam_m(gripper, edge, pose, OPENING_M))
        mine = prediction.uv_px[prediction.layout.edge == edge]
        gap = np.linalg.norm(mine[:, None] - ends_px, axis=2).min()
        assert gap > settings.end_margin_px - 0.5
        step_px = np.linalg.norm(np.diff(mine, axis=0), axis=1)
        assert step_px.min() > 0.9, "no pixel is read twice"
    assert abs(len(prediction.uv_px) - settings.samples) <= 0.1 * settings.samples


def test_creases_are_sampled_when_asked_for():
    plain, with_creases = predicted(), predicted(settings=SamplingSettings(creases=True))
    more = set(with_creases.layout.edge.tolist()) - set(plain.layout.edge.tolist())
    gripper, eye_grip_m = box_gripper(), np.linalg.inv(plain.cam_T_grip)[:3, 3]
    view = gripper.edge_view(gripper.points_grip_m(plain.jaw_opening_m), eye_grip_m)
    assert more and all(view.crease[e] for e in more)


@pytest.mark.parametrize(
    "pose",
    [
        moved(nominal_cam_T_grip(), np.array([0.0, 0.0, -0.3, 0.0, 0.0, 0.0])),
        moved(nominal_cam_T_grip(), np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0])),
        moved(nominal_cam_T_grip(), np.array([0.0, 0.0, -0.115, 0.0, 0.0, 0.0])),
    ],
    ids=["behind", "beside", "around the camera"],
)
def test_a_gripper_out_of_view_gives_an_empty_or_a_sound_prediction(pose: np.ndarray):
    prediction = predicted(cam_T_grip=pose)
    assert np.isfinite(prediction.jacobian[prediction.ok]).all()
    assert np.isfinite(prediction.uv_px[prediction.ok]).all()
    if not len(prediction.uv_px):
        assert prediction.map_x.size == 0 and prediction.moved_px(np.full(7, 1e-3)) == 0.0


def test_moved_px_is_the_largest_motion_of_any_edge_point():
    prediction = predicted()
    shift = np.array([1e-4, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    later = predicted(cam_T_grip=moved(nominal_cam_T_grip(), shift[:6]))
    way = np.einsum("ni,ni->n", later.uv_px - prediction.uv_px, prediction.normal)
    assert prediction.moved_px(shift) == pytest.approx(np.abs(way).max(), rel=0.02)
    # 962 px focal length at about 115 mm
    assert prediction.pixels_per_m == pytest.approx(962.0 / 0.115, rel=0.3)


def test_a_gripper_without_faces_samples_all_its_edges():
    model = cube_model()
    model.pop("faces")
    pose = moved(nominal_cam_T_grip(), np.array([0.0, 0.0, 0.1, 0.3, 0.2, 0.1]))
    prediction = predicted(gripper=gripper_from_dict(model), cam_T_grip=pose, jaw_unknown=False)
    assert len(np.unique(prediction.layout.edge)) == 12


def test_what_leaves_the_lens_leaves_the_prediction():
    """A layout outlives the pose that it was made at; from the next one some of it may be beside or behind the lens."""
    camera, gripper, rng = make_camera(WIDE_LENS), box_gripper(), np.random.default_rng(0)
    shorter = 0
    for _ in range(60):
        tcp_m = (*rng.uniform(-0.03, 0.03, 2), rng.uniform(0.01, 0.05))
        pose = nominal_cam_T_grip(rng.uniform(0.0, 80.0), tcp_m)
        layout = lay_out(camera, gripper, pose, OPENING_M, SamplingSettings())
        there = moved(pose, np.concatenate([rng.normal(0.0, 0.01, 3), rng.normal(0.0, 0.1, 3)]))
        prediction = predict(camera, gripper, layout, there, OPENING_M, OFFSETS_PX, True)
        shorter += len(prediction.layout.edge) < len(layout.edge)
        for numbers in (prediction.uv_px, prediction.normal, prediction.jacobian, prediction.along, prediction.gain):
            assert np.isfinite(numbers).all() and len(numbers) == len(prediction.layout.edge)
        assert np.isfinite(prediction.map_x).all() and np.isfinite(prediction.map_y).all()
        kept = prediction.layout
        assert np.isfinite(prediction.line_origin[kept.edges]).all()
        np.testing.assert_array_equal(kept.edge[kept.first], kept.edges)
        assert (np.bincount(kept.edge, minlength=1)[kept.edges] >= FEWEST_SAMPLES).all()
        CornerGeometry.of(gripper, prediction, CornerSettings())
    assert shorter > 10


@pytest.mark.parametrize("seed", [38, 57, 63, 113, 128])
def test_a_fit_that_leads_out_of_the_lens_is_only_a_bad_fit(seed: int):
    """Nothing but texture, and fingers that reach past the end of the lens: the fit wanders off."""
    rng = np.random.default_rng(seed)
    texture = cv2.GaussianBlur(rng.uniform(0.0, 255.0, (540, 640)).astype(np.uint8), (0, 0), 3.0)
    image = cv2.normalize(texture, None, 0.0, 255.0, cv2.NORM_MINMAX)
    tilt_deg = rng.uniform(20.0, 90.0)
    tcp_m = (*rng.uniform(-0.03, 0.03, 2), rng.uniform(0.005, 0.02))
    found = measure(image, nominal_cam_T_grip(tilt_deg, tcp_m), using=meter(lens=WIDE_LENS))
    assert not found.trusted and np.isfinite(found.prediction.uv_px).all()
