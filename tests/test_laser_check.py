"""Fresh spots against a calibration, with simulated truth: false alarms, what moved, wrong spots, what is unclear."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.fresh_spots import AXES, calibration, drawn_setup, fresh, known, pixels, poses, true_setup
from support.laser_scenes import numeric, paper_setup, sampled, scene

from gripmon.calibrate.sighting import CalibrationError, NotFound
from gripmon.daemon.config.yaml_file import read_document
from gripmon.laser.api import Samples, check_laser
from gripmon.laser.check import CheckSettings, Sample, SpotFault, check_spots
from gripmon.laser.documents import LaserCalibration, calibrated, laser_document
from gripmon.laser.explanations import covariance_max, foresee
from gripmon.laser.forecast import forecast
from gripmon.laser.setup import in_camera, spots_on_plane
from gripmon.laser.spots import Spot, plain_spot
from gripmon.laser.ways import PAIRS, disagreements, three_ways
from gripmon.model.geometry import perturb
from gripmon.model.records import Cause

STRICT = CheckSettings(false_alarms_per_1000_spots=10.0)
ARM = (1e-4, 2e-4)


def checked(uv_px, base_T_ee, settings=None):
    samples = [
        Sample(f"{k}", pose, uv if isinstance(uv, NotFound) else [plain_spot(uv)])
        for k, (uv, pose) in enumerate(zip(uv_px, base_T_ee, strict=True))
    ]
    return check_spots(known(), samples, settings or CheckSettings())


def some(rng, count):
    return poses()[rng.permutation(len(poses()))[:count]]


def anywhere(uv_px, share, rng):
    """Some of the spots anywhere in the image."""
    wrong = rng.permutation(len(uv_px)) < round(share * len(uv_px))
    uv_px[wrong] = rng.uniform([0.0, 0.0], [639.0, 479.0], (int(wrong.sum()), 2))
    return wrong


# ---- nothing moved


@pytest.mark.parametrize(("places", "wrong"), [(None, 0.0), (3, 0.2)])
def test_false_alarms_are_no_more_frequent_than_stated(places, wrong):
    """Calibrations off by what they claim, an arm that is off by the same at a pose again and again: neither is
    mistaken for a motion.  10 in 1000 is the most that may be asked for.
    """
    alarms = 0
    for seed in range(10):
        rng = np.random.default_rng([seed, 7])
        where = some(rng, 20) if places is None else some(rng, places)[np.arange(20) % places]
        uv_px = fresh(drawn_setup(rng), where, rng, arm=ARM)
        anywhere(uv_px, wrong, rng)
        alarms += checked(uv_px, where, STRICT).verdict == "moved"
    # Two are what 200 spots may have: more than six are rarer than 1 % then.
    assert alarms <= 6


def test_the_odds_of_a_motion_are_one_at_most_while_nothing_moved():
    """What bounds the false alarms: the mean over truths that the calibration allows."""
    odds = []
    for seed in range(20):
        rng = np.random.default_rng([seed, 8])
        where = some(rng, 10)
        probability = checked(fresh(drawn_setup(rng), where, rng), where, STRICT).probability_moved
        odds.append(probability / (1.0 - probability) / STRICT.false_alarm_chance(10))
    assert 1e-4 < np.mean(odds) < 1.0


def test_errors_that_spots_have_in_common_are_not_counted_as_many():
    """A calibration that is off by two of its own standard deviations in the direction that spots show the most: 120
    spots from one pose average their noise away, but not that.
    """
    where = np.repeat(poses()[:1], 120, axis=0)
    rows = foresee(known(), where[:1], np.zeros((6, 6))).rows[0]
    root = np.linalg.cholesky(known().covariance)
    worst = root @ np.linalg.svd(rows @ root)[2][0]
    found = checked(fresh(known().setup.moved(2.0 * worst), where, np.random.default_rng(1)), where)
    assert found.verdict == "same"
    assert np.mean([np.linalg.norm(spot.off_px) for spot in found.spots_judged]) > np.linalg.norm(rows @ worst)


def test_a_repeated_error_of_the_arm_is_no_motion():
    """One pose half a millimetre off, five of its standard deviations, a hundred times."""
    where = np.repeat(poses()[3][None], 100, axis=0)
    real = np.stack([perturb(pose, np.r_[5e-4, np.zeros(5)]) for pose in where])
    assert checked(fresh(true_setup(), real, np.random.default_rng(3)), where).cause is None


@pytest.mark.parametrize("share", [0.2, 0.3])
def test_wrong_spots_are_left_out_and_are_no_motion(share):
    for seed in range(3):
        rng = np.random.default_rng([seed, 9])
        where = some(rng, 30)
        uv_px = fresh(true_setup(), where, rng)
        wrong = anywhere(uv_px, share, rng)
        found = checked(uv_px, where)
        assert found.verdict == "same"
        used = np.array([spot.used for spot in found.spots_judged])
        assert not used[wrong].any() and used[~wrong].mean() > 0.9
        assert all(
            spot.fault is SpotFault.OUTLIER and "px from where it should be" in spot.reason
            for spot in found.spots_judged
            if not spot.used
        )


def test_a_reflection_that_stays_in_one_place_is_no_motion():
    """A lamp that is taken for the spot wherever the beam is: four of ten spots agree, but not by any motion."""
    rng = np.random.default_rng(10)
    where = some(rng, 20)
    uv_px = fresh(true_setup(), where, rng)
    uv_px[:8] = rng.normal([400.0, 100.0], 0.1, (8, 2))
    found = checked(uv_px, where)
    assert found.verdict == "same" and not any(spot.used for spot in found.spots_judged[:8])


def test_a_reflection_that_outshines_the_spot_is_passed_over():
    rng = np.random.default_rng(11)
    where = some(rng, 12)
    for setup, verdict in ((true_setup(), "same"), (true_setup().moved(5e-3 * AXES[8]), "moved")):
        uv_px = fresh(setup, where, rng)
        samples = []
        for pose, uv in zip(where, uv_px, strict=True):
            others = [Spot(rng.uniform(0, 470, 2), 1e-4 * np.eye(2), 1e5, 50) for _ in range(2)]
            samples.append(Sample("", pose, [*others, plain_spot(uv)]))
        found = check_spots(known(), samples, CheckSettings())
        assert found.verdict == verdict
        assert all(spot.used and spot.uv_px == tuple(uv) for spot, uv in zip(found.spots_judged, uv_px, strict=True))


# ---- something moved

MOTIONS = [
    (2e-3 * AXES[0], Cause.CAMERA_MOUNT), (np.radians(0.5) * AXES[4], Cause.CAMERA_MOUNT),
    (np.radians(10.0) * AXES[4] + 0.03 * AXES[0], Cause.CAMERA_MOUNT), (5e-3 * AXES[8], Cause.PLANE_MOVED),
    (np.radians(1.0) * AXES[6], Cause.PLANE_MOVED), (np.radians(0.5) * AXES[9], Cause.LASER_MOVED),
    (5e-3 * AXES[11], Cause.LASER_MOVED),
]  # fmt: skip


@pytest.mark.parametrize(("change", "cause"), MOTIONS)
def test_what_moved_is_named_also_with_a_third_of_the_spots_wrong(change, cause):
    """Two millimetres, half a degree, a fall; once in ten times the name needs more spots."""
    named = 0
    for seed, wrong in ((1, 0.0), (2, 0.3), (3, 0.3)):
        rng = np.random.default_rng([seed, 12])
        where = some(rng, 20)
        uv_px = fresh(drawn_setup(rng).moved(change), where, rng, arm=ARM)
        anywhere(uv_px, wrong, rng)
        inside = (uv_px > 0.0).all(axis=1) & (uv_px < [639.0, 479.0]).all(axis=1)
        found = checked(uv_px[inside], where[inside])
        assert found.verdict == "moved" and found.cause in (cause, Cause.UNKNOWN) and found.causes[0].cause is cause
        assert sum(w.probability for w in found.causes) == pytest.approx(1.0, abs=1e-4)
        named += found.cause is cause
    assert named >= 2


def test_many_spots_tell_what_moved_no_worse_than_few():
    """Evidences of a hundred spots differ by more powers of ten than numbers have."""
    rng = np.random.default_rng(20)
    where = some(rng, 100)
    uv_px = fresh(true_setup().moved(0.05 * AXES[8]), where, rng)
    inside = (uv_px > 0.0).all(axis=1) & (uv_px < [639.0, 479.0]).all(axis=1)
    assert inside.sum() > 70
    found = checked(uv_px[inside], where[inside])
    assert found.cause is Cause.PLANE_MOVED and found.causes[0].probability > 0.999


def test_no_motion_is_given_another_s_name():
    """Of random motions, from what hardly shows to centimetres: the cause is right, or unknown, or nothing is said."""
    parts = {Cause.CAMERA_MOUNT: slice(0, 6), Cause.PLANE_MOVED: slice(6, 9), Cause.LASER_MOVED: slice(9, 13)}
    named = 0
    for seed in range(18):
        rng = np.random.default_rng([seed, 13])
        cause = list(parts)[seed % 3]
        change = np.zeros(13)
        change[parts[cause]] = 10.0 ** rng.uniform(-3.0, -1.6) * rng.normal(size=13)[parts[cause]]
        where = some(rng, 10)
        uv_px = fresh(drawn_setup(rng).moved(change), where, rng, arm=ARM)
        inside = (uv_px > 0.0).all(axis=1) & (uv_px < [639.0, 479.0]).all(axis=1)
        found = checked(uv_px[inside], where[inside])
        assert found.cause in (None, Cause.UNKNOWN, cause)
        named += found.cause is cause
    assert named >= 12


def test_the_camera_s_motion_is_estimated_as_exactly_as_it_claims():
    change = np.zeros(13)
    change[:6] = 3e-3, -2e-3, 1e-3, 4e-3, 6e-3, -3e-3
    squares = []
    for seed in range(10):
        rng = np.random.default_rng([seed, 14])
        where = some(rng, 30)
        motion = checked(fresh(drawn_setup(rng).moved(change), where, rng), where).motion
        off = change[:6] - np.r_[motion.position_m, motion.rotation_rad]
        squares.append(off @ np.linalg.solve(np.reshape(motion.covariance, (6, 6)), off))
    # Six degrees of freedom, ten times: the mean is 6 ± 1.1; noise is taken for no less than the residuals show.
    assert 2.0 < np.mean(squares) < 10.0


@pytest.mark.parametrize("change", [2e-3 * AXES[0], 5e-3 * AXES[11]])
def test_one_orientation_does_not_tell_what_moved_and_says_so(change):
    """A shifted camera and a shifted pointer move the spots alike while the hand doesn't turn."""
    data = scene(orientations=1)
    found = checked(fresh(true_setup().moved(change), data.base_T_ee, np.random.default_rng(1)), data.base_T_ee)
    assert (found.verdict, found.cause) == ("moved", Cause.UNKNOWN)
    assert "don't tell what moved" in found.text and found.causes[0].probability < 0.9
    assert {w.cause for w in found.causes if w.probability > 0.1} >= {Cause.CAMERA_MOUNT, Cause.LASER_MOVED}


def test_many_spots_from_one_pose_are_one_spot_which_may_be_a_reflection():
    where = np.repeat(poses()[:1], 10, axis=0)
    found = checked(fresh(true_setup().moved(np.radians(3.0) * AXES[3]), where, np.random.default_rng(16)), where)
    assert found.verdict == "unclear" and not any(spot.used for spot in found.spots_judged)


def test_several_things_that_moved_at_once_are_not_called_one():
    change = np.array([2e-3, 2e-3, 2e-3, 8e-3, 8e-3, 8e-3, 5e-3, 5e-3, 3e-3, 8e-3, 8e-3, 3e-3, 3e-3])
    rng = np.random.default_rng(17)
    where = some(rng, 25)
    found = checked(fresh(true_setup().moved(change), where, rng), where)
    assert found.cause is Cause.UNKNOWN and found.causes[0].cause is Cause.UNKNOWN
    assert found.causes[0].probability > 0.9 and "alone" in found.text


def test_spots_all_over_the_place_are_unclear():
    rng = np.random.default_rng(18)
    where = some(rng, 20)
    found = checked(rng.uniform([0.0, 0.0], [639.0, 479.0], (20, 2)), where)
    assert found.verdict == "unclear" and found.cause is None and "can be believed" in found.text


# ---- samples that can't be judged


def test_samples_that_can_show_no_spot_are_named_as_that():
    setup, pose = known().setup, poses()[0]

    def pointing(beam, height_m=0.0):
        turn = Rotation.align_vectors([beam], [setup.direction_ee])[0].as_matrix()
        out = np.eye(4)
        spot = spots_on_plane(setup, pose[None])[0] + height_m * setup.normal_base
        out[:3, :3], out[:3, 3] = turn, spot - 0.3 * beam - turn @ setup.point_ee_m
        return out

    along = np.cross(setup.normal_base, [0.3, 0.5, 0.8])
    along /= np.linalg.norm(along)
    nearly = (along + 0.004 * setup.normal_base) / np.linalg.norm(along + 0.004 * setup.normal_base)
    away, far = pose.copy(), pose.copy()
    away[:3, 3] += setup.base_T_cam[:3, 0]
    behind = setup.base_T_cam[:3, 2] - setup.normal_base * float(setup.base_T_cam[:3, 2] @ setup.normal_base)
    far[:3, 3] -= 30.0 * behind / np.linalg.norm(behind)
    nothing = NotFound("no spot: laser on?")
    samples = [
        Sample("parallel", pointing(along, 0.01), nothing), Sample("nearly", pointing(nearly), nothing),
        Sample("away", away, nothing), Sample("dark", pose, nothing), Sample("far", far, nothing),
    ]  # fmt: skip
    found = check_spots(known(), samples, CheckSettings())
    assert found.verdict == "unclear" and not any(spot.used for spot in found.spots_judged)
    reasons = {spot.name: (spot.fault, spot.reason) for spot in found.spots_judged}
    assert reasons["parallel"] == (SpotFault.NOT_FORESEEN, "the beam runs along the plane")
    assert reasons["nearly"][0] is SpotFault.NOT_FORESEEN and "nearly runs along the plane" in reasons["nearly"][1]
    assert reasons["away"][0] is SpotFault.NOT_FORESEEN and "not safely within the image" in reasons["away"][1]
    assert reasons["dark"] == (SpotFault.NO_SPOT, "no spot: laser on?")
    assert reasons["far"][0] is SpotFault.NOT_FORESEEN and "behind the camera" in reasons["far"][1]


# ---- the three ways


def test_slopes_and_gaps_are_of_what_they_say():
    """The plane moved: beam and ray still meet.  The camera moved: they don't."""
    where = poses()[4][None]
    gaps = {}
    for name, change in (("plane", 5e-3 * AXES[8]), ("camera", 5e-3 * AXES[:3].sum(axis=0))):
        moved = known().setup.moved(change)
        spots, apart = three_ways(known(), known().setup, where, pixels(moved, where))
        gaps[name] = float(np.linalg.norm(apart[0, 3]))
        if name == "plane":
            assert np.allclose(spots[0, 2], spots_on_plane(moved, where)[0], atol=1e-9), "found without the plane"
    assert gaps["plane"] < 1e-9 and gaps["camera"] > 1e-3


def test_disagreements_are_as_large_as_they_claim():
    """Normalised squares of truths that the covariance allows have their degrees of freedom as their mean."""
    rng = np.random.default_rng(5)
    noise = np.tile(0.09 * np.eye(2), (1, 1, 1))
    squares = []
    for k in range(150):
        where = poses()[k % len(poses())][None]
        uv_px = pixels(drawn_setup(rng), where) + rng.normal(0.0, 0.3, 2)
        (found,) = disagreements(known(), where, uv_px, noise)
        assert [(gap.ways, gap.degrees_of_freedom) for gap in found] == list(PAIRS)
        squares.append([gap.square for gap in found])
    # The mean of 150 squares with k degrees of freedom scatters by sqrt(2 k / 150): four of these.
    assert np.all(np.abs(np.mean(squares, axis=0) - [2, 2, 1, 1]) < 4.0 * np.sqrt(2.0 * np.array([2, 2, 1, 1]) / 150))


def test_a_foreseen_spot_s_rows_and_spread_are_those_of_differences():
    where = poses()[:3]
    found = foresee(known(), where, np.eye(6))
    rows = numeric(lambda step: pixels(known().setup.moved(step), where), 13)
    assert np.allclose(found.rows, rows, atol=1e-4 * np.abs(rows).max())
    by_arm = numeric(lambda step: pixels(known().setup, np.stack([perturb(pose, step) for pose in where])), 6)
    assert np.allclose(found.by_arm, by_arm @ by_arm.swapaxes(1, 2), rtol=1e-4)
    sampled = np.stack([pixels(drawn_setup(np.random.default_rng([k, 6])), where) for k in range(400)])
    for k in range(3):
        assert np.allclose(np.cov(sampled[:, k].T), found.by_calibration[k], atol=0.2 * found.by_calibration[k].max())


# ---- the forecast


@pytest.mark.parametrize(("index", "axis"), [(1, 0), (1, 5), (2, 2)])
def test_motions_show_about_as_small_as_foreseen(index, axis):
    foreseen = forecast(known(), CheckSettings()).noticed[index]
    change = (foreseen.position_m + foreseen.rotation_rad)[axis] * AXES[axis]
    seen = {2.0: 0, 0.1: 0}
    for factor in seen:
        for seed in range(4):
            rng = np.random.default_rng([seed, 19])
            where = some(rng, foreseen.spots)
            uv_px = fresh(drawn_setup(rng).moved(factor * change), where, rng)
            seen[factor] += checked(uv_px, where).verdict == "moved"
    assert seen == {2.0: 4, 0.1: 0}


def test_the_larger_of_two_covariances_is_nowhere_below_either():
    rng = np.random.default_rng(2)
    a, b = (m @ m.swapaxes(1, 2) + 1e-3 * np.eye(2) for m in rng.normal(size=(2, 20, 2, 2)))
    out = covariance_max(a, b)
    least = np.linalg.eigvalsh(np.stack([out - a, out - b]))[..., 0]
    assert (least > -1e-9).all() and (np.abs(least.min(axis=0)) < 1e-9).all(), "and touches one"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: msgspec.structs.replace(d, covariance=tuple(np.diag([-1.0] * 13).ravel())), "is none"),
        (lambda d: msgspec.structs.replace(d, covariance=d.covariance[:-1]), "not that of"),
        (
            lambda d: msgspec.structs.replace(d, laser=msgspec.structs.replace(d.laser, direction_ee=(0, 0, 3))),
            "length 3",
        ),
    ],
)
def test_files_whose_numbers_make_no_set_up_are_refused(change, said):
    with pytest.raises(CalibrationError, match=said):
        calibrated(change(calibration()))


def test_a_file_of_an_earlier_version_says_what_it_said():
    """Read, written again, and held against its truth, which it doesn't hold itself."""
    path = Path(__file__).with_name("kept") / "laser_calibration.yaml"
    earlier = read_document(path, LaserCalibration)
    found = calibrated(earlier)
    again = laser_document(
        found.setup, found.covariance, earlier.camera, earlier.residuals, earlier.warnings, earlier.provenance
    )
    assert again.parameters == earlier.parameters
    scale = np.sqrt(np.diag(np.reshape(earlier.covariance, (13, 13))))
    off = np.reshape(np.subtract(again.covariance, earlier.covariance), (13, 13)) / np.outer(scale, scale)
    assert np.abs(off).max() < 1e-9
    assert np.allclose(again.plane.normal_cam, earlier.plane.normal_cam, atol=1e-12)
    assert again.plane.distance_cam_m == pytest.approx(earlier.plane.distance_cam_m, abs=1e-12)
    rng = np.random.default_rng(4)
    truth = paper_setup(rng)
    where = sampled(truth, rng, orientations=4).base_T_ee
    for setup, cause in ((truth, None), (truth.moved(np.radians(3.0) * AXES[4]), Cause.CAMERA_MOUNT)):
        seen = found.camera.project(in_camera(setup, spots_on_plane(setup, where)))
        inside = (seen > 0.0).all(axis=1) & (seen < [639.0, 479.0]).all(axis=1)
        assert check_laser(earlier, Samples.of_spots(seen[inside], where[inside])).cause is cause
