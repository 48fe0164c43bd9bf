"""A gripper file from images before changing backgrounds, against the simulator's exact outlines and poses."""

from __future__ import annotations

import itertools
import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from support.changing_backgrounds import (
    CAMERA,
    beside_truth_px,
    coverage,
    crossing_px,
    images_of,
    made_of,
    moving_robot,
)
from support.simulated import BOX_FINGERS, PAPER_LENS, nominal_cam_T_grip

import gripmon
from gripmon.calibrate.documents import HandEyeCalibration
from gripmon.cli import main
from gripmon.daemon.config import read_gripper
from gripmon.daemon.gripper_images import images_taken
from gripmon.judge.policy import PolicySettings
from gripmon.model.errors import InputError, NoResultError
from gripmon.model.geometry import from_record, invert, rotation_angle, to_record
from gripmon.model.gripper import SIZE_UNKNOWN, Gripper
from gripmon.model.poses import perturbation_between
from gripmon.model.records import Array, Frame, ReferenceRecord, Transform, ValidBy, Verdict
from gripmon.monitor import Monitor
from gripmon.monitor.settings import MonitorSettings
from gripmon.simulate import Scenario, paper_rig
from gripmon.simulate.scenario import Background, Creep, FingerLook, FingerMark, Light, Sensor
from gripmon.teach.fingers import UnclearPartsError
from gripmon.teach.from_images import GripperFromImages, gripper_from_images
from gripmon.teach.image_borders import Border
from gripmon.teach.image_size import NOMINAL_DISTANCE_M
from gripmon.teach.matte import BLOCK_PX, blocks, grey_levels
from gripmon.teach.silhouette import backgrounds_beside

DEPTH_M = 0.115
DISTANCE = (DEPTH_M, 5e-5)


def chains_of(found: GripperFromImages) -> list:
    return [chain for finger in found.seen.fingers for chain in finger.chains]


@pytest.fixture(scope="module")
def box() -> tuple[list[np.ndarray], GripperFromImages]:
    images = images_of(moving_robot(**SCENES["plain look"]))
    return images, gripper_from_images(images, PAPER_LENS, distance_m=DISTANCE)


SCENES = {
    "plain look": {"seed": 301},
    "print": {"seed": 302, "kind": "printed"},
    "speckle, flicker": {"seed": 303, "kind": "speckle", "light": Light(flicker=0.15)},
    "two tones": {
        "seed": 304,
        "kind": "stripes",
        "fingers": FingerLook(
            level_dn=140.0, marks=(FingerMark(from_tip_m=(0.004, 0.3), across=(-2.0, 2.0), gain=0.45),)
        ),
    },
    "cut by the border": {"seed": 305, "cam_T_grip": nominal_cam_T_grip(tcp_m=(0.0004, 0.020, 0.115))},
    "soft": {"seed": 306, "kind": "chequer", "sensor": Sensor(psf_sigma_px=0.95, read_noise_dn=1.5, jpeg_quality=90)},
}

MORE = ("print", "speckle, flicker", "soft")
"""Scenes that take more images: fewer leave borders unseen, or are too soft for a fifth of a pixel."""


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow("6 s; a print is behind the gripper that moves, too"))
        if name == "print"
        else name
        for name in SCENES
    ],
)
def test_the_outline_lies_within_a_fifth_of_a_pixel_of_the_true_silhouette(name: str, box: tuple) -> None:
    simulator, found = moving_robot(**SCENES[name]), box[1]
    if name != "plain look":  # that is the box
        images = images_of(simulator, 30 if name in MORE else 15)
        found = made_of(images, PAPER_LENS, distance_m=DISTANCE)
    away = beside_truth_px(chains_of(found), coverage(simulator))
    assert len(away) > 200
    assert np.quantile(away, 0.95) <= 0.2
    assert found.outline_sigma_px < 0.2


@pytest.mark.parametrize(
    ("name", "count"),
    [
        *itertools.product(["plain look"], [5, 7]),
        ("two tones", 7),
        ("cut by the border", 5),
        *(
            pytest.param(*each, marks=pytest.mark.slow("6 s; the same look or as few images are in the default run"))
            for each in (("two tones", 5), ("cut by the border", 7))
        ),
    ],
)
def test_of_few_images_what_is_written_is_right_and_the_rest_is_left_out(name: str, count: int) -> None:
    """Backgrounds agree by chance in five images: of outlines found there up to a quarter was wrong."""
    simulator = moving_robot(**SCENES[name])
    images = images_of(simulator)
    covered, written, reasons = coverage(simulator), 0, []
    for first in (0, 2):
        try:
            found = made_of(images[first::4][:count], PAPER_LENS, distance_m=DISTANCE)
        except NoResultError as refused:
            reasons.append(str(refused))
            continue
        written += 1
        away = beside_truth_px(chains_of(found), covered)
        assert np.mean(away > 1.0) < 0.02 and np.quantile(away, 0.95) < 0.5
    assert written or count == 5
    assert all(re.search("of a finger's outline shows|may be fingers|one finger is seen", why) for why in reasons)


@pytest.mark.usefixtures("tools_importable")
@pytest.mark.parametrize(
    ("seed", "faces", "written"),
    [(12, 0, False), (24, 0, True), (57, 1, True), (67, 3, True), (73, 1, False), (6026, 2, True)],
)
def test_fingers_with_narrow_faces_are_right_or_refused(seed: int, faces: int, written: bool) -> None:
    """Half of the first fingers' outline was written along creases before faces of the walls' grey; of the next three
    along their tone's border and pads', since a tip and pads as grey as the walls were left out; and of the last with a
    vertex between two lines that a step of 8 px is between.
    """
    from benchmarks.faced import FACES, FacedFingers, outcome

    found = outcome(FacedFingers(seed, FACES[faces]))
    assert not found.wrong and (not found.why) == written
    assert written or "of a finger's outline shows" in found.why


def test_a_border_before_one_background_is_named_and_marked() -> None:
    """Right of the right finger there is a grey band in all images, which fades into what changes: it may as well be a
    face.
    """
    simulator = moving_robot(**SCENES["plain look"])
    images, covered = images_of(simulator)[:12], coverage(simulator)
    away = cv2.distanceTransform((covered < 0.5).astype(np.uint8), cv2.DIST_L2, 5)
    band = np.clip((34.0 - away) / 24.0, 0.0, 1.0) * (1.0 - covered)
    row, column = np.indices(band.shape)
    band *= np.clip((row - 250.0) / 40.0, 0.0, 1.0) * (column > 580)
    rng = np.random.default_rng(1)
    shown = [
        np.clip(np.rint(image * (1.0 - band) + 150.0 * band + rng.normal(0.0, 0.7, band.shape)), 0, 255)
        for image in images
    ]
    wanted = "along the right finger's outer border .* a face of the background's grey lies beyond; add"
    with pytest.raises(UnclearPartsError, match=wanted) as caught:
        made_of([image.astype(np.uint8) for image in shown], PAPER_LENS, distance_m=DISTANCE)
    unseen = np.vstack(caught.value.unseen_px)
    assert len(unseen) > 100 and np.mean(unseen[:, 0] > 500) > 0.8
    drawn = caught.value.picture(images[0])
    row, column = np.rint(unseen[len(unseen) // 2]).astype(int)[::-1]
    assert drawn[row, column].tolist() == [40, 40, 255]


@pytest.mark.parametrize(
    ("clear", "same", "words"),
    [
        (2, False, "usually 2 of 7 images have a background there that differs from it, .* something bright behind it"),
        (6, True, "the background is the same there in all images; add images with brighter and darker ones"),
        (6, False, "a face of the background's grey lies beyond; add images with something bright and plain behind it"),
    ],
)
def test_what_would_help_depends_on_what_is_missing(clear: int, same: bool, words: str) -> None:
    border = Border("the finger's tip", 90, 0.42, np.zeros((0, 2)), clear, 7, same, brighter=True)
    assert re.search(f"along the finger's tip 42 % of the outline shows: .*{words}$", border.words())
    between = replace(border, name="the left finger's inner border").words()  # what the jaws hold stays as well
    assert between.endswith(", and with nothing between the jaws") == (same and clear == 6)


@pytest.mark.parametrize(("quality", "written"), [(15, True), (5, False)])
def test_blocks_of_strong_compression_are_no_edges_and_are_named(quality: int, written: bool) -> None:
    """Their borders lie on a grid that stays in all images."""
    simulator = moving_robot(**SCENES["plain look"])
    coded = [cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1] for image in images_of(simulator)[:15]]
    images = [cv2.imdecode(data, cv2.IMREAD_UNCHANGED) for data in coded]
    words = "the images are compressed strongly .* a higher quality"
    if not written:
        with pytest.raises(NoResultError, match=words):
            made_of(images, PAPER_LENS, distance_m=DISTANCE)
        return
    found = made_of(images, PAPER_LENS, distance_m=DISTANCE)
    assert any(re.match(words, note) for note in found.notes)
    away = beside_truth_px(chains_of(found), coverage(simulator))
    # The coder's ringing, which stays, too, moves the outline by up to a pixel here, and by 0.2 to 0.5 px at 20 to 80.
    assert np.median(away) < 0.2 and np.quantile(away, 0.95) < 1.0
    for edge in (edge for finger in found.seen.fingers for edge in finger.inner):
        along, across = np.sort(np.abs(edge.uv_px[1] - edge.uv_px[0]))[::-1]
        axis = int(np.argmin(np.abs(edge.uv_px[1] - edge.uv_px[0])))
        beside = abs((float(edge.uv_px[:, axis].mean()) + 0.5 + BLOCK_PX / 2) % BLOCK_PX - BLOCK_PX / 2)
        assert across > 0.005 * along or beside > 0.2


def test_steps_at_coded_blocks_are_told_from_the_images(box: tuple) -> None:
    images = box[0][:3]
    by_quality = []
    for quality in (20, 40, 75):
        coded = [cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1] for image in images]
        by_quality.append(blocks([grey_levels(cv2.imdecode(data, cv2.IMREAD_UNCHANGED)) for data in coded]))
    assert by_quality[0] > by_quality[1] > by_quality[2] > 1.2
    assert abs(blocks([grey_levels(image) for image in images]) - 1.0) < 0.05


def test_a_border_counts_where_different_backgrounds_show_it() -> None:
    contrast = np.array(
        [
            [50.0, 50.0, 0.0, 50.0, 9.0],
            [51.0, -30.0, 0.0, 0.0, 30.0],
            [52.0, 20.0, 3.0, 0.0, 60.0],
            [50.0, 0.0, -2.0, 0.0, 90.0],
        ]
    )
    finger = np.full(contrast.shape, 80.0)
    clear, different = backgrounds_beside(contrast, finger, 1.0)
    assert clear.tolist() == [4, 3, 0, 1, 4] and different.tolist() == [1, 3, 0, 1, 4]
    clear, different = backgrounds_beside(contrast, finger, 3.0)
    assert clear.tolist() == [4, 3, 0, 1, 3] and different.tolist() == [1, 3, 0, 1, 3]


@pytest.mark.parametrize("pad", ["no light", "the finger's light"])
def test_a_pad_before_which_the_finger_changes_is_one_background(pad: str) -> None:
    light = 1.0 + 0.03 * np.random.default_rng(2).normal(size=(16, 30))
    finger = 180.0 * light
    behind = {"no light": 25.0 * np.ones_like(light), "the finger's light": 60.0 * light}
    clear, different = backgrounds_beside(behind[pad] - finger, finger, 1.0)
    assert (clear == 16).all() and np.mean(different > 1) < 0.05


@pytest.mark.usefixtures("tools_importable")
def test_a_pad_as_dark_as_the_room_is_no_outline() -> None:
    """Where pads met the metal a fifth of the outline was written, up to their width of 31 px beside the truth."""
    from benchmarks.faced import PaddedFingers, outcome

    found = outcome(PaddedFingers(1))
    assert not found.wrong and not found.why


def test_fingers_are_told_apart_and_placed_in_space_by_their_perspective(box: tuple) -> None:
    _, found = box
    assert found.gripper.finger_ids == ("left", "right") and not any("round fingertips" in note for note in found.notes)
    assert len(found.gripper.corner_ids) >= 5
    apart = perturbation_between(nominal_cam_T_grip(), found.cam_T_grip)
    # One length was given, so only its own error may be along the axis; here it was given exactly.
    assert np.abs(apart[:3]).max() < 4e-4
    assert np.abs(apart[3:]).max() < np.radians(0.3)
    true = read_gripper(BOX_FINGERS).points_grip_m()
    corners = found.gripper.points_grip_m()[found.gripper.corner_points]
    nearest = np.linalg.norm(corners[:, None] - true[None], axis=2).min(axis=1)
    assert nearest.max() < 5e-4
    assert found.covariance[2, 2] >= DISTANCE[1] ** 2


def reference_of(cam_T_grip: Array, covariance: Array) -> ReferenceRecord:
    flat = tuple(np.ravel(covariance).tolist())
    return ReferenceRecord("made", 1, 0, "configuration", to_record(cam_T_grip), flat)


def errors_of(gripper, cam_T_grip, covariance, frames, truths) -> tuple[float, int, Array]:
    """Share of valid frames, how many of them mislead, and the errors (n, 6) against the true motion."""
    monitor = Monitor(CAMERA, gripper, MonitorSettings(), reference_of(cam_T_grip, covariance))
    true_T_made = invert(truths[0].cam_T_grip) @ cam_T_grip
    errors, misleading = [], 0
    for frame, truth in zip(frames, truths, strict=True):
        record = monitor.process(frame)
        if record.verdict.value == "valid":
            error = perturbation_between(truth.cam_T_grip @ true_T_made, from_record(record.cam_T_grip))
            errors.append(error)
            misleading += bool(np.linalg.norm(error[:3]) > record.protection.position_m)
    return len(errors) / len(frames), misleading, np.array(errors)


def test_a_model_made_so_is_tracked_as_exactly_as_the_true_one(box: tuple) -> None:
    """On backgrounds that it wasn't made from, while the camera moves by 1.3 mm: faster than mounts creep, so that two
    frames of sixty, besides the first, wait for a proof of the new place.
    """
    _, found = box
    creep = Creep(start_s=0.5, time_s=0.8, tcp_shift_m=(0.0012, 0.0005))
    scenario = Scenario(name="x", duration_s=4.0, fps=15.0, mount=(creep,), background=Background(kind="printed"))
    truth = read_gripper(BOX_FINGERS)
    simulator = paper_rig(truth).simulator(scenario, 77)
    shown, truths = [simulator.frame(k) for k in range(60)], [simulator.truth(k) for k in range(60)]
    standing = [Frame(f.seq, f.stamp_ns, f.image, None, f.name) for f in shown]
    exact = errors_of(truth, truths[0].cam_T_grip, np.diag([1e-8] * 3 + [1e-6] * 3), shown, truths)
    made = errors_of(found.gripper, found.cam_T_grip, found.covariance, standing, truths)
    assert made[0] >= 0.95
    assert made[1] == 0
    across, along = (np.sqrt(np.square(e[2][:, :2]).sum(axis=1).mean()) for e in (exact, made))
    assert along <= max(2.0 * across, 3e-5)
    assert np.quantile(np.abs(made[2][:, 2]), 0.95) <= max(2.0 * np.quantile(np.abs(exact[2][:, 2]), 0.95), 1e-4)


def test_how_well_the_size_is_known_is_in_every_bound(box: tuple) -> None:
    """Told a distance that is a standard deviation too long: nothing in an image can show that."""
    images, exact = box
    sigma_m = 0.002
    found = made_of(images[::2], PAPER_LENS, distance_m=(DEPTH_M + sigma_m, sigma_m))
    assert found.gripper.model.scale_sigma == pytest.approx(sigma_m / (DEPTH_M + sigma_m), rel=0.05)
    scenario = Scenario(name="x", duration_s=2.0, fps=15.0, background=Background(kind="printed"))
    simulator = paper_rig(read_gripper(BOX_FINGERS)).simulator(scenario, 77)
    reference = reference_of(found.cam_T_grip, found.covariance)
    for limit_m, verdict in ((1e-3, Verdict.SUSPECT), (2e-2, Verdict.VALID)):
        settings = MonitorSettings(policy=PolicySettings(alert_limit_m=limit_m))
        monitor, verdicts = Monitor(CAMERA, found.gripper, settings, reference), set()
        for k in range(2, 30):
            shown = simulator.frame(k)
            record = monitor.process(Frame(shown.seq, shown.stamp_ns, shown.image, None, shown.name))
            assert record.cam_T_grip is not None and record.protection is not None
            off_m = np.linalg.norm(from_record(record.cam_T_grip)[:3, 3] - exact.cam_T_grip[:3, 3])
            assert 0.8 * sigma_m < off_m < record.protection.position_m < 6.0 * sigma_m
            verdicts |= {record.verdict} if k > 2 else set()
        assert verdicts == {verdict}


def test_without_any_length_motion_is_measured_in_units_of_the_distance(box: tuple) -> None:
    images, _ = box
    found = made_of(images, PAPER_LENS)
    assert found.gripper.model.scale_sigma == SIZE_UNKNOWN and found.cam_T_grip[2, 3] == NOMINAL_DISTANCE_M
    assert found.covariance[2, 2] >= NOMINAL_DISTANCE_M**2
    assert any("size is unknown" in note and "valid_by: reference" in note for note in found.notes)
    creep = Creep(start_s=1.2, time_s=0.6, tcp_shift_m=(0.0008, 0.0004), translation_m=(0.0, 0.0, 0.0004))
    scenario = Scenario(name="x", duration_s=3.0, fps=10.0, mount=(creep,), background=Background(kind="printed"))
    simulator = paper_rig(read_gripper(BOX_FINGERS)).simulator(scenario, 77)
    settings = MonitorSettings(policy=PolicySettings(valid_by=ValidBy.REFERENCE))
    monitor = Monitor(CAMERA, found.gripper, settings, reference_of(found.cam_T_grip, found.covariance))

    def true_T(k: int) -> Array:
        """In the file's unit."""
        pose = np.array(simulator.truth(k).cam_T_grip)
        pose[:3, 3] *= NOMINAL_DISTANCE_M / DEPTH_M
        return pose

    valid, frames, number = 0, 30, {}
    for k in range(frames):
        shown = simulator.frame(k)
        number[shown.stamp_ns] = k
        record = monitor.process(Frame(shown.seq, shown.stamp_ns, shown.image, None, shown.name))
        monitor.run_pending()
        if record.verdict is not Verdict.VALID:
            continue
        valid += 1
        assert record.cam_T_grip is not None and record.protection is not None
        assert record.since_reference is not None
        true_d = true_T(k) @ invert(true_T(number[record.since_reference.since_ns]))
        error = perturbation_between(true_d @ found.cam_T_grip, from_record(record.cam_T_grip))
        off_m = float(np.linalg.norm(error[:3]))
        assert off_m < record.protection.position_m and (k > 12 or off_m < 3e-5)
        assert record.absolute is not None and record.absolute.position_m > NOMINAL_DISTANCE_M
    assert valid >= 0.9 * (frames - 2)


def _curve_ends(gripper: Gripper, true_T_grip: Array) -> Array:
    """Places (n, 3) where sides turn into curves, in the true gripper's frame, from left to right."""
    points = np.unique(gripper.edge_points[gripper.edge_curved])
    places = gripper.points_grip_m()[points] @ true_T_grip[:3, :3].T + true_T_grip[:3, 3]
    return np.asarray(places[np.argsort(places[:, 0])])


def _curves_beside_px(found: GripperFromImages, covered: np.ndarray) -> Array:
    """How far the file's curves lie beside the true silhouette where they were made, at 100 places of each."""
    gripper, pose = found.gripper, found.cam_T_grip
    curves = np.flatnonzero(gripper.edge_curved)
    points_m = gripper.points_grip_m() @ pose[:3, :3].T + pose[:3, 3]
    places = gripper.outlines_m(points_m, curves, 100, pose[:3, :3])
    return np.concatenate([crossing_px(CAMERA.project(place), covered) for place in places])


@pytest.mark.usefixtures("tools_importable")
@pytest.mark.parametrize("radius_m", [0.002, pytest.param(0.004, marks=pytest.mark.slow("9 s: another radius"))])
def test_round_tips_become_curves_between_straight_sides_and_are_seen_as_ends(radius_m: float) -> None:
    """Also after the camera has moved, before backgrounds that the file wasn't made from."""
    from benchmarks.rounded import rounded_model, rounded_solids

    solids = rounded_solids(0.012, radius_m)
    found = made_of(images_of(moving_robot(311, gripper=solids)), PAPER_LENS, distance_m=DISTANCE)
    gripper = found.gripper
    assert len(gripper.edge_ids) == 6 and np.count_nonzero(gripper.edge_curved) == 2 and not len(gripper.corner_ids)
    assert any("plane of their sides" in note for note in found.notes)
    apart = perturbation_between(nominal_cam_T_grip(), found.cam_T_grip)
    assert np.abs(apart[3:]).max() < np.radians(1.0)
    # The tips lie in the plane of their sides; how far behind the tip a curve leaves its side shows less exactly.
    off = _curve_ends(gripper, invert(nominal_cam_T_grip()) @ found.cam_T_grip)
    off -= _curve_ends(rounded_model(0.012, radius_m), np.eye(4))
    assert np.abs(off[:, :2]).max() < 7e-4 and np.abs(off[:, 2]).max() < 2e-3
    # 0.13 to 0.23 px over six seeds.
    assert np.quantile(_curves_beside_px(found, coverage(moving_robot(311, gripper=solids))), 0.95) < 0.25
    creep = Creep(start_s=0.5, time_s=0.8, tcp_shift_m=(0.0012, 0.0005))
    scenario = Scenario(name="x", duration_s=4.0, fps=15.0, mount=(creep,), background=Background(kind="printed"))
    simulator = paper_rig(solids).simulator(scenario, 77)
    shown, truths = [simulator.frame(k) for k in range(60)], [simulator.truth(k) for k in range(60)]
    standing = [Frame(f.seq, f.stamp_ns, f.image, None, f.name) for f in shown]
    share, misleading, errors = errors_of(gripper, found.cam_T_grip, found.covariance, standing, truths)
    assert misleading == 0 and share > 0.5
    assert np.quantile(np.abs(errors[:, :2]), 0.95) < 5e-5 and np.quantile(np.abs(errors[:, 2]), 0.95) < 1e-4


def test_openings_in_metres_tell_distance_and_motion() -> None:
    images, openings = [], []
    for seed, opening_m, count in ((401, 0.034, 15), (402, 0.024, 12)):
        images += images_of(moving_robot(seed, "printed", opening_m=opening_m), count)
        openings += [opening_m] * count
    found = made_of(images, PAPER_LENS, openings_m=openings)
    sigma_m = float(np.sqrt(found.covariance[2, 2]))
    assert abs(found.cam_T_grip[2, 3] - DEPTH_M) < max(4.0 * sigma_m, 0.01 * DEPTH_M)
    assert found.gripper.jaw_nominal_m == 0.034
    # As far again as the images show, to either side, and less certain there.
    assert found.gripper.jaw_min_m == pytest.approx(0.014) and found.gripper.jaw_max_m == pytest.approx(0.044)
    assert found.gripper.beyond_m(0.024) == 0.0 < found.gripper.beyond_m(0.02) < found.gripper.beyond_m(0.014) < 1e-3
    moved = found.gripper.points_grip_m(0.024) - found.gripper.points_grip_m(0.034)
    left = found.gripper.point_finger == 0
    # Each finger moves by half of the opening, the left one to the right.
    assert np.abs(moved[left] - [0.005, 0.0, 0.0]).max() < 3e-4
    assert np.abs(moved[~left] - [-0.005, 0.0, 0.0]).max() < 3e-4


def test_a_fingers_width_or_a_calibration_give_the_scale(box: tuple) -> None:
    images = box[0][::2]
    by_width = made_of(images, PAPER_LENS, finger_width_m=(0.010, 1e-4))
    assert abs(by_width.cam_T_grip[2, 3] - DEPTH_M) < 0.02 * DEPTH_M
    pose, covariance = nominal_cam_T_grip(), np.diag([1e-8] * 3 + [1e-6] * 3)
    on_plate = made_of(images, PAPER_LENS, reference=(pose, covariance))
    assert np.array_equal(on_plate.cam_T_grip, pose)
    assert np.array_equal(on_plate.covariance, covariance)
    innermost = on_plate.gripper.points_grip_m()[on_plate.gripper.corner_points]
    assert np.abs(np.abs(innermost[:, 2])).max() < 5e-4


def test_images_that_contradict_are_left_out_and_named(box: tuple) -> None:
    images, found = box
    spoilt = images[:18]
    spoilt[4] = np.roll(images[4], 3, axis=1)
    spoilt[9] = cv2.GaussianBlur(images[9], (0, 0), 2.5)
    spoilt[17] = np.roll(images[17], 40, axis=0)
    again = made_of(spoilt, PAPER_LENS, distance_m=DISTANCE)
    assert set(again.left_out) == {"image 10", "image 18"}
    assert "moved" in again.left_out["image 18"]
    assert "blurred" in again.left_out["image 10"]
    # A mount has play: an image that shows the gripper displaced by 3 px is moved back.
    matte = again.seen.matte
    assert abs(float(matte.moved_px[matte.kept.index(4), 0]) - 3.0) < 0.1 and np.abs(matte.moved_px).max() < 3.1
    assert rotation_angle(again.cam_T_grip[:3, :3] @ found.cam_T_grip[:3, :3].T) < np.radians(0.5)


def test_what_shows_no_gripper_is_refused_in_one_line(box: tuple) -> None:
    images, _ = box
    still = images_of(moving_robot(303, motion="still"), 12)
    rng = np.random.default_rng(1)
    noise = [np.clip(image + rng.normal(0.0, 1.0, image.shape), 0, 255).astype(np.uint8) for image in still]
    blurred = [cv2.GaussianBlur(image, (0, 0), 4.0) for image in images[:10]]
    moved = [np.roll(image, 9 * k, axis=1) for k, image in enumerate(images[:10])]
    narrow = nominal_cam_T_grip(tcp_m=(0.012, -0.012, 0.14))
    other = images_of(moving_robot(310, cam_T_grip=narrow), 12)
    for wrong, word in (
        (noise, "stays the same"),
        (blurred, "blurred"),
        (moved, "gripper|contradict|finger"),
        (images[:12] + other, "gripper|finger"),
    ):
        with pytest.raises(NoResultError, match=word) as caught:
            made_of(wrong, PAPER_LENS, distance_m=DISTANCE)
        assert "\n" not in str(caught.value)
    with pytest.raises(NoResultError, match=r"10 of 25 images show one opening, from image 16 to image 25; .* blurred"):
        made_of([*images[15:30], *blurred], PAPER_LENS, openings_m=[0.03] * 15 + [0.02] * 10)


def test_wrong_input_says_what_would_be_right(box: tuple) -> None:
    images, _ = box
    for wrong, values, word in (
        (images[:4], {"distance_m": DISTANCE}, "at least 5"),
        (images, {"openings_m": [0.03] * 30, "jaw_range_m": (0.0, 0.02)}, "jaw_range: is 0 to 0.02 m, but"),
        (images, {"distance_m": DISTANCE, "finger_width_m": (0.01, 1e-4)}, "one of"),
        ([*images[:12], images[3]], {"distance_m": DISTANCE}, "same image"),
        ([*images[:12], images[13][:-2]], {"distance_m": DISTANCE}, "one size"),
        (images, {"openings_m": [0.03, *[None] * 29]}, "of none"),
    ):
        with pytest.raises(InputError, match=word):
            gripper_from_images(wrong, PAPER_LENS, **values)


def _camera_file(path: Path) -> Path:
    lens = {"model": "paper", **{k: getattr(PAPER_LENS, k) for k in PAPER_LENS.__struct_fields__}}
    camera = {
        "schema": "gripmon.camera_calibration/1", "camera": lens, "parameters": [], "covariance": [],
        "provenance": {"gripmon": "0", "time": "2026-01-01T00:00:00", "command": "test"},
    }  # fmt: skip
    path.write_text(yaml.safe_dump(camera))
    return path


def test_the_command_takes_a_video_as_it_is(box: tuple, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Also in a folder; a robot that waits shows one view several times, which counts once."""
    images, _ = box
    folder = tmp_path / "film"
    folder.mkdir()
    height, width = images[0].shape
    writer = cv2.VideoWriter(str(folder / "a.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (width, height))
    for image in images:
        for _ in range(5):
            writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    camera, out = _camera_file(tmp_path / "camera.yaml"), tmp_path / "gripper.yaml"
    words = ["gripper", "from-images", str(folder), "--camera", str(camera), "--distance", "0.115:0.002"]
    assert main([*words, "--out", str(out), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["videos"] == images_taken([folder / "a.mp4"]).notes == [
        f"{folder / 'a.mp4'}: 30 of 150 frames are used, one in 2, without 45 that show the view of the one before"
    ]  # fmt: skip
    assert said["images"] + len(said["left_out"]) == 30
    model = read_gripper(out)
    pose = from_record(Transform(**said["cam_T_grip"]))
    points = CAMERA.project(model.points_grip_m()[model.corner_points] @ pose[:3, :3].T + pose[:3, 3])
    true = read_gripper(BOX_FINGERS).points_grip_m() @ nominal_cam_T_grip()[:3, :3].T + nominal_cam_T_grip()[:3, 3]
    away = np.linalg.norm(points[:, None] - CAMERA.project(true)[None], axis=2).min(axis=1)
    assert len(away) >= 5 and np.median(away) < 0.5
    (folder / "a.mp4").write_bytes(b"no video")
    assert main(["gripper", "from-images", str(folder), "--camera", str(camera), "--out", str(tmp_path / "b")]) == 2
    assert "can't be opened as a video" in capsys.readouterr().err


def test_the_command_writes_what_check_takes(box: tuple, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    images, found = box
    folder = tmp_path / "free"
    folder.mkdir()
    for k, image in enumerate(images):
        cv2.imwrite(str(folder / f"{k:03d}.png"), image)
    _camera_file(tmp_path / "camera.yaml")
    wrong = ["gripper", "from-images", "nowhere", "--camera", str(tmp_path / "camera.yaml")]
    assert main([*wrong, "--out", str(tmp_path / "gripper.yaml")]) == 2
    assert "nowhere: the file is missing; an image file, or a folder with images" in capsys.readouterr().err
    words = ["gripper", "from-images", str(folder), "--camera", str(tmp_path / "camera.yaml")]
    outputs = ["--out", str(tmp_path / "gripper.yaml"), "--reference-out", str(tmp_path / "reference.yaml")]
    left, seen = ["--within", "0,0,384,576"], tmp_path / "seen.png"
    assert main([*words, *left, *outputs, "--picture", str(seen)]) == 3
    said = capsys.readouterr().err.splitlines()[-2:]
    assert said[0].startswith(f"written: {seen} (what was seen; with --force") and seen.is_file()
    assert said[1].startswith("one finger is seen; --fingers 1") and "a timestamps.csv if the jaws moved" in said[1]
    outputs += ["--picture", str(tmp_path / "gripper.png")]
    assert main([*words, "--distance", "0.115:0.002", *outputs, "--json"]) == 0
    said_of_all = json.loads(capsys.readouterr().out)
    assert said_of_all["images"] == 30
    assert read_gripper(tmp_path / "gripper.yaml").corner_ids == found.gripper.corner_ids
    assert cv2.imread(str(tmp_path / "gripper.png")).shape == (1152, 1536, 3)
    (tmp_path / "config.yaml").write_text(
        "robot: r\ncamera_name: wrist\ncamera: camera.yaml\ngripper: gripper.yaml\nreference: reference.yaml\n"
        f"source: {{kind: folder, path: {folder}}}\n"
    )
    config = gripmon.load_config(tmp_path / "config.yaml")
    assert isinstance(config.calibrated.hand_eye, HandEyeCalibration)
    record = gripmon.Monitor(config).process(Frame(0, 0, images[0], None, ""))
    assert record.cam_T_grip is not None
    assert main([*words, "--distance", "0.115:0.002", *outputs]) == 2
    assert "--force" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main([*words, "--distance", "115", *outputs])
    assert "M:SIGMA" in capsys.readouterr().err
