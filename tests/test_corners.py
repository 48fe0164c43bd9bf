"""Measured corners and poses on rendered images against the renderer's exact truth, by sampling, and every fault."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from support.box_models import cube_model
from support.grippers import gripper_from_dict
from support.meters import (
    FISHEYE_LENS,
    NARROW,
    box_gripper,
    corners_px,
    difference,
    measure,
    meter,
    moved,
    picture,
    simulated,
)
from support.simulated import BOX_FINGERS, PAPER_LENS, STRONG_LENS, nominal_cam_T_grip, plain_scenario, simulator

from gripmon.model.camera import LensSettings, make_camera
from gripmon.model.gripper import Gripper
from gripmon.model.records import CornerFault
from gripmon.simulate import Simulator, make_scenario, paper_rig
from gripmon.simulate.scenario import BentFinger, JawScript
from gripmon.track.edges import Measurement, MeasurementSettings, agreeing_fingers, trace_of
from gripmon.track.edges.settings import CornerSettings, RobustFitSettings

PLAIN = plain_scenario()
IDS = box_gripper().corner_ids
LENSES = [PAPER_LENS, STRONG_LENS, FISHEYE_LENS]


def noisy(clean: np.ndarray, rng: np.random.Generator, sigma_dn: float) -> np.ndarray:
    return np.clip(np.rint(clean + rng.normal(scale=sigma_dn, size=clean.shape)), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("lens", LENSES, ids=["paper", "brown_conrady", "fisheye"])
def test_corners_and_pose_of_a_clean_image_are_those_of_the_truth(lens: LensSettings):
    truth = simulated(PLAIN, 1, lens).truth(0)
    found = measure(picture(PLAIN, lens=lens), using=meter(lens=lens))
    np.testing.assert_array_equal(found.corners.usable, truth.visible)
    error_px = (found.corners.uv_px - truth.corner_uv_px)[truth.visible]
    assert np.abs(error_px).max() < 0.05
    error = difference(found.cam_T_grip, truth.cam_T_grip)
    assert np.abs(error[:2]).max() < 3e-6 and abs(error[2]) < 1e-5
    assert np.degrees(np.abs(error[3:]).max()) < 0.01
    assert found.trusted and found.consensus.share > 0.95
    ideal = make_camera(lens).undistort(truth.corner_uv_px[truth.visible])
    np.testing.assert_allclose(found.corners.xy[truth.visible], ideal, atol=0.05 / 640.0)


@pytest.mark.parametrize("direction", [0, 2, 5])
def test_a_motion_within_the_profiles_reach_is_measured_as_well_as_none(direction: int):
    """Two pixels along each unknown: after linearising again nothing is left of where the measurement began."""
    xi = np.zeros(6)
    xi[direction] = 2.5e-4 if direction < 2 else 1.2e-3 if direction == 2 else 0.01
    still, shifted = measure(picture(PLAIN)), measure(picture(PLAIN), moved(nominal_cam_T_grip(), xi))
    assert shifted.trusted
    away = difference(still.cam_T_grip, shifted.cam_T_grip)
    assert np.abs(away[:2]).max() < 1.5e-6 and abs(away[2]) < 1e-5 and np.abs(away[3:]).max() < 2e-4


def test_corners_off_the_prediction_are_measured_as_well_as_on_it():
    """Less than what calls for linearising again: the lines' offsets and slopes carry the corner all the way."""
    truth, on_it = simulated(PLAIN).truth(0), measure(picture(PLAIN)).corners.uv_px
    for xi in ([5e-5, 0, 0, 0, 0, 0], [0, -5e-5, 0, 0, 0, 0], [0, 0, 0, 0, 0, 1.2e-3], [3e-5, 3e-5, 0, 0, 0, -6e-4]):
        expected = moved(nominal_cam_T_grip(), np.array(xi))
        found = measure(picture(PLAIN), expected)
        assert np.nanmax(np.abs(found.corners.uv_px - on_it)) < 0.06
        predicted_px = corners_px(make_camera(PAPER_LENS), box_gripper(), found.prediction.cam_T_grip)
        assert np.abs(predicted_px - truth.corner_uv_px)[truth.visible].max() > 0.2, "it was off"


def test_covariances_are_the_spread_over_many_noisy_images():
    """With the floors for systematic errors out of the way; the noise is estimated, so it is known to a third only."""
    settings = MeasurementSettings(consensus=RobustFitSettings(point_floor_px=0.005, edge_floor_px=0.0))
    using, rng = meter(settings=settings), np.random.default_rng(1)
    clean, truth = picture(PLAIN).astype(float), simulated(PLAIN).truth(0)
    corner_errors, claims, pose_errors, pose_claims, nees = [], [], [], [], []
    for _ in range(100):
        found = measure(noisy(clean, rng, 8.0), using=using)
        corner_errors.append((found.corners.uv_px - truth.corner_uv_px)[truth.visible])
        lens = found.prediction.corners.d_uv_d_xy
        claims.append((lens @ found.corners.covariance_xy @ lens.transpose(0, 2, 1))[truth.visible])
        error = difference(found.cam_T_grip, truth.cam_T_grip)
        pose_errors.append(error)
        pose_claims.append(np.diag(found.covariance)[:6])
        nees.append(error @ np.linalg.solve(found.covariance[:6, :6], error))
    errors, claimed = np.array(corner_errors), np.mean(claims, axis=0)
    for k in range(errors.shape[1]):
        sampled = np.cov(errors[:, k].T)
        # Both axes of each corner's ellipse: generalised eigenvalues are one where it is right.
        ratio = np.linalg.eigvals(np.linalg.solve(claimed[k], sampled)).real
        assert ratio.min() > 0.25 and ratio.max() < 2.0
    spread = np.std(pose_errors, axis=0) / np.sqrt(np.mean(pose_claims, axis=0))
    assert spread.min() > 0.6 and spread.max() < 1.5
    assert 3.0 < np.mean(nees) < 10.0
    sigma_px = np.sqrt(np.linalg.eigvalsh(claims[-1])[:, -1])
    np.testing.assert_allclose(found.corners.sigma_px[truth.visible], sigma_px, rtol=1e-6)


# --- faults ---


def faults_of(found: Measurement, gripper: Gripper) -> dict[str, CornerFault | None]:
    usable = [fault is None for fault in found.corners.fault]
    np.testing.assert_array_equal(np.isfinite(found.corners.sigma_px) | ~np.array(usable), True)
    np.testing.assert_array_equal(found.corners.usable, usable)
    return dict(zip(gripper.corner_ids, found.corners.fault, strict=True))


def test_a_covered_corner_is_hidden_and_its_neighbours_are_not():
    image, truth = picture(PLAIN).copy(), simulated(PLAIN).truth(0)
    u, v = truth.corner_uv_px[IDS.index("R_in_near")].round().astype(int)
    image[v - 25 : v + 25, u - 25 : u + 25] = 90
    found = measure(image)
    faults = faults_of(found, box_gripper())
    assert faults.pop("R_in_near") is CornerFault.HIDDEN
    assert faults == {
        n: None if v else CornerFault.SELF_HIDDEN for n, v in zip(IDS, truth.visible, strict=True) if n != "R_in_near"
    }
    assert found.trusted
    assert np.abs(difference(found.cam_T_grip, truth.cam_T_grip)[:2]).max() < 1e-5


def test_a_covered_finger_hides_its_corners_and_the_other_one_still_gives_a_pose():
    image, truth = picture(PLAIN).copy(), simulated(PLAIN).truth(0)
    image[:, : image.shape[1] // 2] = 180
    found = measure(image)
    faults = faults_of(found, box_gripper())
    assert {faults[n] for n in IDS if n.startswith("L")} == {CornerFault.HIDDEN, CornerFault.SELF_HIDDEN}
    assert faults["R_in_near"] is faults["R_in_far"] is None
    error = difference(found.cam_T_grip, truth.cam_T_grip)
    assert error @ np.linalg.solve(found.covariance[:6, :6], error) < 25.0


def test_corners_out_of_the_image_are_outside():
    pose = moved(nominal_cam_T_grip(), np.array([0.025, 0.0, 0.0, 0.0, 0.0, 0.0]))
    scene = simulator(PLAIN, cam_T_grip=pose)
    uv_px = corners_px(make_camera(PAPER_LENS), box_gripper(), pose)
    out = ((uv_px < 2.0) | (uv_px > [765.0, 573.0])).any(axis=1)
    assert 0 < out.sum() < 8
    found = measure(scene.render(0), pose)
    faults = faults_of(found, box_gripper())
    assert [faults[name] is CornerFault.OUTSIDE for name in IDS] == out.tolist()
    assert faults["L_in_near"] is None and faults["L_out_near"] is None
    assert np.abs(difference(found.cam_T_grip, pose)[:2]).max() < 1e-5


def cube_seen(pose: np.ndarray, settings: MeasurementSettings | None = None) -> tuple[Measurement, Simulator, Gripper]:
    gripper = gripper_from_dict(cube_model(0.03))
    scene = paper_rig(gripper, pose).simulator(PLAIN, 1)
    return meter(gripper, settings=settings).measure(scene.render(0), pose, 0.0, 0.9, NARROW), scene, gripper


def test_the_near_corner_of_a_cube_has_no_outlines_unless_creases_are_used():
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [0.5, 0.6, 0.1]).as_matrix()
    pose[2, 3] = 0.15
    found, scene, gripper = cube_seen(pose)
    faults = faults_of(found, gripper)
    nearest = gripper.corner_ids[int(found.corners_at(0.0)[:, 2].argmin())]
    farthest = gripper.corner_ids[int(found.corners_at(0.0)[:, 2].argmax())]
    assert faults.pop(nearest) is CornerFault.FEW_POINTS
    assert faults.pop(farthest) is CornerFault.SELF_HIDDEN
    assert set(faults.values()) == {None}
    error_px = found.corners.uv_px - scene.truth(0).corner_uv_px
    assert np.nanmax(np.abs(error_px)) < 0.06
    assert np.abs(difference(found.cam_T_grip, pose)[:3]).max() < 3e-5


def test_edges_that_run_into_each_other_in_the_image_make_no_corner():
    """A cube whose upper edges lie at the height of the camera: both outlines at the corner run along one row."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("y", 0.6).as_matrix()
    pose[:3, 3] = [0.0, 0.0148, 0.15]
    found, scene, gripper = cube_seen(pose)
    uv_px = scene.truth(0).corner_uv_px
    assert faults_of(found, gripper)["cube_100"] is CornerFault.PARALLEL
    assert np.ptp(uv_px[[gripper.corner_ids.index(f"cube_{n}") for n in ("000", "100", "101")], 1]) < 1.0


def test_corners_that_are_too_uncertain_are_refused():
    settings = MeasurementSettings(corners=CornerSettings(largest_sigma_px=0.1))
    relaxed, strict = measure(picture(PLAIN)), measure(picture(PLAIN), using=meter(settings=settings))
    for name, sigma_px, fault, before in zip(
        IDS, relaxed.corners.sigma_px, strict.corners.fault, relaxed.corners.fault, strict=True
    ):
        if before is None:
            assert (fault is CornerFault.UNCERTAIN) == (sigma_px > 0.1), name
    assert CornerFault.UNCERTAIN in strict.corners.fault and None in strict.corners.fault


def test_an_empty_table_has_no_corners_and_is_not_trusted():
    rng = np.random.default_rng(3)
    found = measure(noisy(np.full((576, 768), 120.0), rng, 3.0))
    assert not found.trusted
    assert not found.corners.usable.any()
    assert found.corner_rms_px(found.cam_T_grip) is None


# --- kinds of images ---


def test_colour_sixteen_bits_and_floats_give_what_eight_bits_give():
    image = picture(make_scenario("static"))
    reference = measure(image)
    for kind, other in {
        "colour": np.repeat(image[..., None], 3, axis=2),
        "uint16": image.astype(np.uint16) * 257,
        "float32": image.astype(np.float32) / 255.0,
        "columns first": np.asfortranarray(image),
        "a view": np.pad(image, 5)[5:-5, 5:-5],
    }.items():
        found = measure(other)
        # Interpolated grey levels of eight bits are rounded to whole ones, the others' are not.
        finer = kind in ("uint16", "float32")
        np.testing.assert_allclose(
            found.corners.uv_px, reference.corners.uv_px, atol=0.04 if finer else 2e-3, err_msg=kind
        )
        away = np.abs(difference(reference.cam_T_grip, found.cam_T_grip)) / np.sqrt(np.diag(reference.covariance)[:6])
        assert away.max() < (0.3 if finer else 0.01), kind
        assert found.corners.fault == reference.corners.fault
        assert found.consensus.share == pytest.approx(reference.consensus.share, abs=0.02)


def test_a_coloured_edge_is_measured_in_its_luma():
    image = picture(PLAIN)
    bgr = cv2.merge([255 - image, image, image])  # blue runs against the others and is worth 0.114
    found, reference = measure(bgr), measure(image)
    np.testing.assert_allclose(found.corners.uv_px, reference.corners.uv_px, atol=0.02)


def brighter_sides(image: np.ndarray) -> dict[str, str]:
    """For every sampled edge the side that is brighter for someone who walks it in the image, read off the image."""
    gripper, camera, pose = box_gripper(), make_camera(PAPER_LENS), nominal_cam_T_grip()
    points = gripper.points_grip_m(0.034) @ pose[:3, :3].T + pose[:3, 3]
    sides = {}
    for edge in np.unique(measure(image).prediction.layout.edge):
        start, end = camera.project(points[gripper.edge_points[edge]])
        middle, walk = 0.5 * (start + end), (end - start) / np.linalg.norm(end - start)
        # Rows count downwards: who walks along a row to the right has larger rows to his right.
        right = np.array([-walk[1], walk[0]])
        values = [float(image[tuple(np.rint(middle + 5.0 * s * right)[::-1].astype(int))]) for s in (1.0, -1.0)]
        sides[gripper.edge_ids[edge]] = "right" if values[0] > values[1] else "left"
    return sides


def test_the_taught_polarity_admits_its_own_contrast_and_no_other():
    image = picture(PLAIN)
    sides = brighter_sides(image)
    assert set(sides.values()) == {"left", "right"}
    model = yaml.safe_load(BOX_FINGERS.read_text())
    for name, side in sides.items():
        model["edges"][name]["brighter"] = side
    taught = measure(image, using=meter(gripper_from_dict(model)))
    assert taught.consensus.share > 0.95
    turned = "L_tip_near"
    model["edges"][turned]["brighter"] = {"left": "right", "right": "left"}[sides[turned]]
    other = measure(image, using=meter(gripper_from_dict(model)))
    index = box_gripper().edge_ids.index(turned)
    assert taught.consensus.edge_seen[index] and not other.consensus.edge_seen[index]
    assert measure(255 - image, using=meter(gripper_from_dict(model))).consensus.share < 0.3, (
        "a negative shows no gripper"
    )


# --- purity, jaw, fingers, trace ---


def test_a_measurement_does_not_depend_on_images_seen_before():
    used = meter()
    image = picture(make_scenario("static"))
    first = measure(image, using=used)
    rng = np.random.default_rng(4)
    measure(rng.integers(0, 255, image.shape, dtype=np.uint8), using=used)
    again = measure(image, using=used)
    np.testing.assert_array_equal(first.cam_T_grip, again.cam_T_grip)
    np.testing.assert_array_equal(first.covariance, again.covariance)
    # Poses expected before change where it is linearised, and no more than that.
    measure(image, moved(nominal_cam_T_grip(), np.array([1e-3, 0.0, 0.0, 0.0, 0.0, 0.01])), using=used)
    later = difference(first.cam_T_grip, measure(image, using=used).cam_T_grip)
    assert (np.abs(later) < 0.3 * np.sqrt(np.diag(first.covariance)[:6])).all()


@pytest.mark.parametrize("reported_offset_m", [0.0, 3e-4, -3e-4])
def test_a_wrongly_reported_jaw_opening_is_noticed_and_mostly_corrected(reported_offset_m: float):
    opened = plain_scenario(jaw=JawScript(knots=((0.0, 0.036), (1.0, 0.036))))
    found = measure(picture(opened), jaw_opening_m=0.036 + reported_offset_m)
    assert found.jaw_opening_m == pytest.approx(0.036, abs=3e-5)
    assert found.jaw_innovation == pytest.approx(-reported_offset_m / 5e-5, abs=0.8), "in sigmas of the report"
    unreported = meter().measure(
        picture(opened), nominal_cam_T_grip(), 0.036 + reported_offset_m, 0.9, NARROW, jaw_reported=False
    )
    assert unreported.jaw_opening_m == pytest.approx(0.036, abs=1e-5)
    assert np.abs(difference(unreported.cam_T_grip, nominal_cam_T_grip())[:2]).max() < 5e-6


@pytest.mark.parametrize("tip_shift_m", [(0.0, 6e-4, 0.0), (6e-4, 0.0, 0.0), (0.0, 1.2e-3, 0.0)])
def test_a_bent_finger_agrees_less_with_the_pose_than_the_other(tip_shift_m: tuple[float, float, float]):
    bent = plain_scenario(bent_fingers=(BentFinger(finger="left", tip_shift_m=tip_shift_m, start_s=0.0),))
    left, right = agreeing_fingers(measure(picture(bent, index=1)), box_gripper())
    assert left < 0.7 < 0.8 < right


def test_both_fingers_agree_with_the_pose_while_nothing_is_bent():
    assert min(agreeing_fingers(measure(picture(PLAIN)), box_gripper())) > 0.95


def test_a_finger_out_of_view_is_not_held_against_the_pose():
    pose = moved(nominal_cam_T_grip(), np.array([0.06, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert agreeing_fingers(measure(picture(PLAIN), pose), box_gripper())[1] == 1.0


def test_the_trace_shows_edge_points_on_the_drawn_edges_and_corners_where_they_are():
    found, camera, gripper = measure(picture(PLAIN)), make_camera(PAPER_LENS), box_gripper()
    trace, truth = trace_of(found, camera, gripper), simulated(PLAIN).truth(0)
    assert len(trace.edge_uv_px) == len(trace.edge_used) == len(trace.edge_index)
    assert np.isfinite(trace.predicted_corners_uv_px).all(axis=1).tolist() == truth.visible.tolist()
    np.testing.assert_allclose(
        trace.predicted_corners_uv_px[truth.visible], truth.corner_uv_px[truth.visible], atol=0.05
    )
    view = gripper.edge_view(gripper.points_grip_m(0.034), np.linalg.inv(nominal_cam_T_grip())[:3, 3])
    assert len(trace.predicted_edges_uv_px) == view.visible.sum()
    lines = dict(zip(np.flatnonzero(view.visible), trace.predicted_edges_uv_px, strict=True))
    for point, edge in zip(trace.edge_uv_px[trace.edge_used], trace.edge_index[trace.edge_used], strict=True):
        start, end = lines[edge][:-1], lines[edge][1:]
        span = end - start
        share = np.clip(((point - start) * span).sum(axis=1) / (span**2).sum(axis=1), 0.0, 1.0)
        assert np.linalg.norm(start + share[:, None] * span - point, axis=1).min() < 0.3
