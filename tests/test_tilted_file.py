"""A gripper file whose plane isn't that of the fingers, as one made of images may be: what a motion is off by then."""

from __future__ import annotations

from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest
from scipy.optimize import least_squares
from support.meters import difference, moved
from support.simulated import PAPER_LENS, nominal_cam_T_grip
from support.watched import pose_of, reference_of

from gripmon.judge.policy import PolicySettings
from gripmon.model.camera import make_camera
from gripmon.model.geometry import skew
from gripmon.model.gripper import EdgeModel, FaceModel, FingerModel, Gripper, GripperModel, PointModel, contents_of
from gripmon.model.records import Array, ReferenceRecord, ValidBy
from gripmon.monitor import Monitor, MonitorSettings, Tracker
from gripmon.monitor.common import EXACT_PLANE, CommonError, Tilt
from gripmon.monitor.possible import Possible
from gripmon.simulate import Scenario, paper_rig
from gripmon.simulate.scenario import Background, Bump, FingerLook
from gripmon.teach.finger_depth import USUAL_TILT_RAD, USUAL_TILT_SIGMA_RAD, place
from gripmon.teach.result import GripperResult
from gripmon.teach.vanishing import Outline
from gripmon.track.edges.taught import TaughtEdge, TaughtEdges, gripper_digest, own_covariance
from gripmon.track.integrity.level_kernel import levels
from gripmon.track.integrity.level_kernel import moved as moved_since
from gripmon.track.integrity.separation import limits_of

FILE_T = nominal_cam_T_grip(np.degrees(USUAL_TILT_RAD))
SIDES = {"left": (-0.025, -0.013), "right": (0.013, 0.025)}
LENGTH_M, THICK_M = 0.06, 1e-3
BOUND_SIGMAS = 4.4 * 1.2
"""Of a bound at a risk of 1e-5, with the factor for tails."""
SECOND_ORDER = 0.1


def plates(points_m: dict[str, Array], sigma_rad: float = 0.0) -> Gripper:
    """Flat fingers by their corners (4, 3), from one root to the other."""
    points, edges, faces = {}, {}, []
    for name, corners in points_m.items():
        for k, xyz in enumerate(corners):
            points[f"{name}{k}"] = PointModel(finger=name, xyz_m=tuple(map(float, xyz)), corner=k in (1, 2))
        for k in range(3):
            edges[f"{name}{k}"] = EdgeModel(start=f"{name}{k}", end=f"{name}{k + 1}")
        faces.append(FaceModel(finger=name, points=tuple(f"{name}{k}" for k in range(4))))
    fingers = {name: FingerModel() for name in points_m}
    return Gripper(
        GripperModel(
            name="plates", fingers=fingers, points=points, edges=edges, faces=tuple(faces), tilt_sigma_rad=sigma_rad
        )
    )


def true_plates() -> Gripper:
    def corners(a: float, b: float) -> Array:
        # Counter-clockwise for the camera, which looks along y.
        return np.array([(b, 0.0, -LENGTH_M), (b, 0.0, 0.0), (a, 0.0, 0.0), (a, 0.0, -LENGTH_M)])

    return plates({name: corners(*side) for name, side in SIDES.items()})


def solid_plates() -> Gripper:
    """The same for the simulator, which needs bodies: thin ones, wider at the front."""
    front = true_plates().model
    points, faces = dict(front.points), list(front.faces)
    for name, (a, b) in SIDES.items():
        low, middle = -LENGTH_M, np.array([0.5 * (a + b), 0.0, -0.5 * LENGTH_M])
        for k, (x, z) in enumerate(((b, low), (b, 0.0), (a, 0.0), (a, low))):
            behind = middle + 0.8 * (np.array([x, 0.0, z]) - middle) + [0.0, THICK_M, 0.0]
            points[f"{name}_back{k}"] = PointModel(finger=name, xyz_m=tuple(map(float, behind)))
        back = [f"{name}_back{k}" for k in range(4)]
        faces.append(FaceModel(finger=name, points=tuple(back[::-1])))
        for k in range(4):
            m = (k + 1) % 4
            faces.append(FaceModel(finger=name, points=(f"{name}{m}", f"{name}{k}", back[k], back[m])))
    return Gripper(msgspec.structs.replace(front, points=points, faces=tuple(faces)))


def true_pose(tilt_deg: float, roll_deg: float) -> Array:
    """Plates tilted against the line of sight, and rolled about their z axis, with the file's TCP."""
    pose = nominal_cam_T_grip(tilt_deg)
    c, s = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    pose[:3, :3] = pose[:3, :3] @ [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
    return pose


def file_of(true_T: Array, sigma_rad: float = USUAL_TILT_SIGMA_RAD) -> Gripper:
    """The plates' places in the image, in the file's plane."""
    gripper, tcp, normal = true_plates(), FILE_T[:3, 3], FILE_T[:3, 1]
    out = {}
    for k, name in enumerate(gripper.finger_ids):
        seen = gripper.points_grip_m()[gripper.point_finger == k] @ true_T[:3, :3].T + true_T[:3, 3]
        out[name] = (seen * (float(normal @ tcp) / (seen @ normal))[:, None] - tcp) @ FILE_T[:3, :3]
    return plates(out, sigma_rad)


def fitted(true_T: Array, motion: Array) -> Array:
    """What a fit across edges with the file's points is off by (6,) after a ``motion`` (6,) of the TCP, by SciPy."""
    here = []
    for gripper, pose in ((true_plates(), true_T), (file_of(true_T), FILE_T)):
        points = gripper.points_grip_m() @ pose[:3, :3].T + pose[:3, 3]
        here.append(gripper.outlines_m(points, np.arange(len(gripper.edge_ids)), 25))
    truth, file = here
    ways = np.gradient(file[..., :2] / file[..., 2:], axis=1)
    normal = np.stack([-ways[..., 1], ways[..., 0]], axis=-1) / np.sqrt(np.linalg.norm(ways, axis=-1))[..., None]

    def image(places: Array, xi: Array) -> Array:
        by = moved(FILE_T, xi) @ np.linalg.inv(FILE_T)
        at = places @ by[:3, :3].T + by[:3, 3]
        return np.asarray((at[..., :2] / at[..., 2:] * normal).sum(axis=-1).ravel())

    found = least_squares(lambda xi: (image(file, xi) - image(truth, motion)) * 1e6, motion, xtol=1e-14, ftol=1e-14)
    return np.asarray(found.x - motion)


def motions(count: int, shift_m: float, turn_deg: float) -> Array:
    rng = np.random.default_rng(5)
    ways = rng.normal(size=(count, 2, 3))
    ways /= np.linalg.norm(ways, axis=2)[..., None]
    return np.asarray(ways * np.array([shift_m, np.radians(turn_deg)])[:, None]).reshape(count, 6)


def camera_shift(motion: Array) -> Array:
    return np.asarray((moved(FILE_T, motion) @ np.linalg.inv(FILE_T))[:3, 3])


def test_a_small_error_of_the_tilt_makes_the_errors_that_are_reckoned_with():
    """Half a degree about each axis of the plane, alone."""
    off_deg = 0.5
    for number, true_T in enumerate((true_pose(35.0 + off_deg, 0.0), true_pose(35.0, off_deg))):
        tilt = Tilt.of(file_of(true_T, np.radians(off_deg)), FILE_T)
        for motion in motions(6, 2e-4, 0.1):
            error = fitted(true_T, motion)
            reckoned = tilt.of_motion @ camera_shift(motion)
            # The plane's two directions are any two: the errors span the same.
            weights, *_ = np.linalg.lstsq(reckoned.T, error, rcond=None)
            assert np.linalg.norm(weights) == pytest.approx(1.0, abs=0.08), number
            np.testing.assert_allclose(weights @ reckoned, error, atol=0.07 * np.abs(error).max())


TILTS_DEG = [(20.0, 0.0), (50.0, 0.0), (35.0, -20.0), (35.0, 20.0), (20.0, 10.0), (50.0, -20.0)]


@pytest.mark.parametrize(("tilt_deg", "roll_deg"), TILTS_DEG)
def test_errors_of_the_assumed_tilt_are_within_the_bound_of_its_error_alone(tilt_deg: float, roll_deg: float):
    true_T = true_pose(tilt_deg, roll_deg)
    tilt = Tilt.of(file_of(true_T), FILE_T)
    for shift_m, turn_deg in ((1e-3, 0.0), (5e-3, 0.0), (0.0, 0.5), (0.0, 2.0), (3e-3, 1.0), (5e-3, 2.0)):
        for motion in motions(8, shift_m, turn_deg):
            error, sigma = fitted(true_T, motion), tilt.of_motion @ camera_shift(motion)
            # A first order: what it leaves is some hundredths of the motion, or of its angle at the gripper's distance.
            second = SECOND_ORDER * np.linalg.norm(camera_shift(motion))
            for part, least in ((slice(0, 3), second), (slice(3, 6), second / FILE_T[2, 3])):
                assert np.linalg.norm(error[part]) < BOUND_SIGMAS * np.linalg.norm(sigma[:, part]) + least


def test_it_turns_the_absolute_rotation_alone():
    tilt = Tilt.of(file_of(FILE_T), FILE_T)
    off = CommonError(0.0, np.zeros((0, 6)), np.zeros(6), tilt).alike(FILE_T)
    turned = off.T @ off
    assert not turned[:3].any()
    expected = USUAL_TILT_SIGMA_RAD**2 * (np.eye(3) - np.outer(FILE_T[:3, 1], FILE_T[:3, 1]))
    np.testing.assert_allclose(turned[3:, 3:], expected, atol=1e-9)


@pytest.mark.parametrize(("tilt_deg", "roll_deg"), [(50.0, 0.0), (35.0, 20.0)])
@pytest.mark.parametrize("size", [0.9, 1.05])
def test_a_wrong_size_and_tilt_leave_nothing_to_teach_at_a_reference_of_the_same_images(
    tilt_deg: float, roll_deg: float, size: float
):
    """So that what is taught has no error of theirs in it; at a reference from elsewhere it has."""
    true_T = true_pose(tilt_deg, roll_deg)
    file, edges = file_of(true_T), np.arange(6)
    own_T = FILE_T.copy()
    own_T[:3, 3] *= size
    larger = plates({f: size * file.points_grip_m()[4 * k : 4 * k + 4] for k, f in enumerate(file.finger_ids)})

    def shown(gripper: Gripper, pose: Array) -> Array:
        places = gripper.outlines_m(gripper.points_grip_m() @ pose[:3, :3].T + pose[:3, 3], edges, 2)
        return np.asarray(places[..., :2] / places[..., 2:])

    truth = shown(true_plates(), true_T)
    np.testing.assert_allclose(shown(larger, own_T), truth, atol=1e-12)
    assert np.abs(shown(larger, true_T) - truth).max() > 1e-3


def own_reference(sigmas: tuple[float, float, float]) -> ReferenceRecord:
    """Off along the line of sight, beside it, and in rotation, by these standard deviations."""
    along, beside, turn = sigmas
    sight = FILE_T[:3, 3] / np.linalg.norm(FILE_T[:3, 3])
    covariance = np.diag([beside**2] * 3 + [turn**2] * 3)
    covariance[:3, :3] += (along**2 - beside**2) * np.outer(sight, sight)
    flat = tuple(covariance.ravel().tolist())
    return msgspec.structs.replace(reference_of(FILE_T), covariance=flat, with_gripper=True)


def test_an_error_that_file_and_reference_have_together_counts_once():
    """In the absolute bound; a reference from elsewhere has errors of its own."""
    size, beside_m, distance_m = 0.03, 1e-5, float(np.linalg.norm(FILE_T[:3, 3]))
    reference = own_reference((size * distance_m, beside_m, USUAL_TILT_SIGMA_RAD))
    model = msgspec.structs.replace(file_of(FILE_T).model, scale_sigma=size)
    edge = {"left1": TaughtEdge(share=(0.0, 1.0), offset_m=(0.0, 0.0), sigma_m=(0.0, 0.0), crease=False)}
    sight = FILE_T[:3, 3] / distance_m

    def sigmas(reference: ReferenceRecord, **states: float) -> tuple[float, float, float]:
        """Along the line of sight and beside it, and of the rotation's longest axis; taught with a file's statements
        replaced."""
        gripper = Gripper(msgspec.structs.replace(model, **states))
        taught = TaughtEdges.of(edge, gripper, FILE_T, None, own_covariance(reference, gripper))
        rows = taught.reference_error, np.zeros(6), Tilt.of(gripper, FILE_T)
        off = CommonError(gripper.model.scale_sigma, *rows).alike(FILE_T)
        beside = np.linalg.norm(off[:, :3] @ np.linalg.svd(sight[None])[2][1])
        return float(np.linalg.norm(off[:, :3] @ sight)), float(beside), float(np.linalg.norm(off[:, 3:], 2))

    once = size * distance_m, beside_m, USUAL_TILT_SIGMA_RAD
    twice = 2.0**0.5 * once[0], beside_m, 2.0**0.5 * once[2]
    np.testing.assert_allclose(sigmas(reference), once, rtol=1e-6)
    elsewhere = msgspec.structs.replace(reference, with_gripper=False)
    np.testing.assert_allclose(sigmas(elsewhere), twice, rtol=1e-6)
    # What the file doesn't state, the reference alone has.
    np.testing.assert_allclose(sigmas(reference, scale_sigma=0.0, tilt_sigma_rad=0.0), once, rtol=1e-6)


def test_a_file_that_states_none_is_as_before():
    exact, tilted = file_of(FILE_T, 0.0), file_of(FILE_T, 0.1)
    assert Tilt.of(exact, FILE_T) is EXACT_PLANE
    assert gripper_digest(exact) != gripper_digest(tilted)
    assert "tilt_sigma_rad" in contents_of(tilted.model) and "tilt_sigma_rad" not in contents_of(exact.model)
    texts = [GripperResult(gripper=each).text() for each in (tilted, exact)]
    assert "tilt_sigma_rad" in texts[0] and "tilt_sigma_rad" not in texts[1]


class Knocked(NamedTuple):
    """Errors and bounds (n,) of the motion since the reference, in the last frames."""

    error_m: Array
    bound_m: Array
    error_rad: Array
    bound_rad: Array


SHIFT = Bump(at_s=0.95, ring_fraction=0.0, tcp_shift_m=(0.002, 0.0), translation_m=(0.002, 0.0, 0.0))


def knocked(true_T: Array, file: Gripper, knock: Bump = SHIFT, *, still: bool = False) -> Knocked:
    """A knock that shifts and turns the camera; none if ``still``."""
    scenario = Scenario(
        name="tilted",
        fps=15.0,
        duration_s=2.0,
        mount=() if still else (knock,),
        background=Background(kind="printed"),
        fingers=FingerLook(carriers=False),
    )
    camera = make_camera(PAPER_LENS)
    simulator = paper_rig(solid_plates(), true_T).simulator(scenario, 3)
    reference = reference_of(FILE_T)
    reference = msgspec.structs.replace(reference, covariance=tuple(np.diag([1e-6] * 3 + [1e-2] * 3).ravel().tolist()))
    policy = PolicySettings(valid_by=ValidBy.REFERENCE, alert_limit_m=0.02, alert_limit_rad=0.35)
    monitor = Monitor(camera, file, MonitorSettings(policy=policy), reference)
    rows, first_T = [], simulator.truth(0).cam_T_grip
    for k in range(simulator.frame_count):
        record = monitor.process(simulator.frame(k))
        monitor.run_pending()
        if k >= 20 and record.measured:
            assert record.cam_T_grip is not None and record.since_reference is not None
            true_d = simulator.truth(k).cam_T_grip @ np.linalg.inv(first_T)
            error, since = difference(true_d @ FILE_T, pose_of(record.cam_T_grip)), record.since_reference
            rows.append((np.linalg.norm(error[:3]), since.position_m, np.linalg.norm(error[3:]), since.rotation_rad))
    assert len(rows) >= 5
    return Knocked(*np.array(rows).T)


@pytest.mark.parametrize(("tilt_deg", "roll_deg"), [(50.0, 0.0), (35.0, 20.0), (45.0, -15.0)])
def test_a_knock_that_a_tilted_file_measures_wrong_is_within_its_bound(tilt_deg: float, roll_deg: float):
    true_T = true_pose(tilt_deg, roll_deg)
    told = knocked(true_T, file_of(true_T))
    assert (told.error_m <= told.bound_m).all() and (told.error_rad <= told.bound_rad).all()
    if roll_deg:
        untold = knocked(true_T, file_of(true_T, 0.0))
        assert np.mean(untold.error_m > untold.bound_m) >= 0.8


@pytest.mark.parametrize(
    ("roll_deg", "knock"),
    [
        (
            -20.0,
            {"tcp_shift_m": (-0.0014, 0.0034), "roll_deg": -0.09, "translation_m": (0.0015, -0.0031, -0.0024)},
        ),
        (20.0, {"tcp_shift_m": (-0.00156, -0.00004), "roll_deg": 0.86, "translation_m": (0.00087, 0.00279, -0.00065)}),
    ],
)
def test_a_motion_that_is_measured_much_too_small_is_within_its_bound(roll_deg: float, knock: dict[str, Any]):
    """The published motion, which the file's error is reckoned from, has that error itself."""
    true_T = true_pose(35.0, roll_deg)
    told = knocked(true_T, file_of(true_T), Bump(at_s=0.95, ring_fraction=0.0, **knock))
    assert (told.error_m <= told.bound_m).all() and (told.error_rad <= told.bound_rad).all()


def test_while_the_mount_stays_a_tilted_file_costs_nothing():
    """A file's error acts by the motion, of which the noise of a frame is none."""
    told, untold = (knocked(FILE_T, file_of(FILE_T, sigma), still=True) for sigma in (USUAL_TILT_SIGMA_RAD, 0.0))
    assert np.median(told.bound_m) < 1.1 * np.median(untold.bound_m)


def stub(name: str, left: float, right: float, outwards: tuple[float, float]) -> Outline:
    """A finger of which little shows: wider than long, from below."""
    xy = np.array([(left, 0.37), (left, 0.35), (right, 0.35), (right, 0.37)])
    pieces = ((0, 1), (1, 2), (2, 3))
    length_px = 900.0 * np.linalg.norm(np.diff(xy, axis=0), axis=1)
    corner = np.array([False, True, True, False])
    return Outline(name, xy, corner, pieces, np.array(outwards), length_px, np.zeros((0, 2, 2)), np.zeros(0))


def test_two_short_flat_fingers_are_tilted_square_to_the_way_from_tip_to_tip():
    """Each by itself seems to point sideways: from the middle of what shows at the border to its farthest corner."""
    placed = place([stub("left", 0.07, 0.12, (-0.7, -0.7)), stub("right", 0.32, 0.38, (-0.96, -0.28))])
    assert placed.assumed and placed.tilt_sigma_rad == USUAL_TILT_SIGMA_RAD
    np.testing.assert_allclose(placed.rotation[:, 0], (1.0, 0.0, 0.0), atol=1e-9)
    depth = [float(points[:, 2].mean()) for points in placed.points]
    assert depth[0] == pytest.approx(depth[1], rel=1e-9)
    sight = placed.tcp - placed.rotation[:, 0] * float(placed.rotation[:, 0] @ placed.tcp)
    along = float(placed.rotation[:, 2] @ sight) / float(np.linalg.norm(sight))
    assert np.arccos(along) == pytest.approx(USUAL_TILT_RAD, abs=0.02) and placed.rotation[1, 2] < sight[1]


@pytest.mark.parametrize("root", [0.03, 0.01, -0.03], ids=["closing behind", "nearly parallel", "opening behind"])
def test_the_tcp_of_flat_fingers_is_between_their_tips(root: float):
    """Whatever lies innermost farther back: pads, roots, a body; the distance that a user states is the tips'."""

    def finger(name: str, side: float) -> Outline:
        xy = np.array([(side * (0.05 - root), 0.37), (side * 0.05, 0.05), (side * 0.09, 0.05), (side * 0.14, 0.37)])
        pieces = ((0, 1), (1, 2), (2, 3))
        length_px = 900.0 * np.linalg.norm(np.diff(xy, axis=0), axis=1)
        corner = np.array([False, True, True, False])
        return Outline(name, xy, corner, pieces, np.array([0.0, -1.0]), length_px, np.zeros((0, 2, 2)), np.zeros(0))

    placed = place([finger("left", -1.0), finger("right", 1.0)])
    np.testing.assert_allclose(placed.tcp, (0.0, 0.05, 1.0), atol=1e-9)
    assert [float(points[1, 2]) for points in placed.points] == pytest.approx([1.0, 1.0])


def beyond(way: str, odds: float, risk: float, count: int = 1500) -> tuple[float, float, float]:
    """Share of motions that are beyond their bound, of all and of mounts that were knocked (with probability ``odds``),
    and the median bound, m, as a file whose plane is tilted by 15 degrees measures them in a view that shows little;
    drawn from the model.
    """
    rng, tcp = np.random.default_rng(11), np.array([0.02, 0.03, 0.2])
    noise, usual = (np.diag(np.square(sd)) for sd in ([1e-4, 2e-4, 7e-4, 8e-3, 7e-3, 3e-3], [2e-4] * 3 + [2e-3] * 3))
    knock = np.diag(np.square([2.6e-3] * 3 + [0.02] * 3))
    by_motion = np.zeros((3, 6, 3))
    by_motion[1, (2, 3, 4, 5), (0, 1, 0, 2)] = 0.26 * np.array([1.6, 10.0, 7.5, 2.5])
    by_motion[2, (2, 3, 4, 5), (1, 0, 1, 1)] = 0.26 * np.array([1.2, 5.0, 5.0, 2.5])
    at_origin = np.hstack([np.eye(3), skew(tcp)])
    none, off, first, still = np.zeros((0, 6)), np.zeros((1, 0, 6)), np.zeros(1, dtype=np.intp), np.zeros((1, 6))
    # What the true motion is known by besides the fits: nothing, or as of a mount that stays, or was knocked by these
    # odds.
    by_fits, stays, or_knocked = (none, knock, 0.0), (usual, knock, 0.0), (usual, knock, odds)
    parts = {
        "by what fits show": (by_fits,),
        "as of a mount that stays": (stays,),
        "by the true motion": (stays, or_knocked),
    }[way]
    found = []
    for _ in range(count):
        knocked = rng.uniform() < odds
        motion = rng.multivariate_normal(np.zeros(6), usual + knock * knocked)
        wrong = np.einsum("kij,k->ij", by_motion, rng.normal(size=3)) @ at_origin @ motion
        error = wrong + rng.multivariate_normal(np.zeros(6), noise)
        seen = motion + error
        of = still, noise[None], off, np.ones(1), first, still, 1e-16 * np.eye(6)[None], off
        since = np.eye(6), by_motion, np.zeros(6), at_origin @ seen, tcp, -seen, none
        table = np.empty((7, len(parts)))
        for k, true in enumerate(parts):
            moved_since(*of, *since, *true, 1.0, risk / len(parts), table, k)
        position_m, rotation_rad, _ = levels(table, np.arange(len(parts)), limits_of(risk, 1.0))
        within = np.linalg.norm(error[:3]) <= position_m and np.linalg.norm(error[3:]) <= rotation_rad
        found.append((not within, knocked, position_m))
    out, is_knocked, bound_m = np.array(found).T
    return float(out.mean()), float(out[is_knocked > 0.0].mean()), float(np.median(bound_m))


def test_by_the_true_motion_bounds_hold_whether_the_mount_stayed_or_was_knocked_unnoticed():
    """They are smaller than by what noise in fits looks like; as of a mount that stays, whatever happened, wrong."""
    risk, odds = 1e-2, 0.1
    every, knocked, bound_m = beyond("by the true motion", odds, risk)
    assert every <= risk and knocked <= risk / odds
    assert bound_m < 0.85 * beyond("by what fits show", odds, risk)[2]
    every, knocked, _ = beyond("as of a mount that stays", odds, risk)
    assert every > 3.0 * risk and knocked > risk / odds


@pytest.mark.parametrize("sigma_rad", [0.0, USUAL_TILT_SIGMA_RAD])
def test_the_receding_edge_of_a_thick_fingers_end_is_doubted_with_the_end(sigma_rad: float):
    """In the plane of a file from images it runs along the finger, as a side does that has a bend."""
    outline = np.array([(12.0, -60.0), (12.0, 0.0), (2.0, 0.0), (0.0, -20.0), (-1.0, -60.0)])
    points, edges, fingers = {}, {}, {}
    for name, way, inner in (("left", -1.0, 12.0), ("right", 1.0, 12.0)):
        fingers[name] = FingerModel()
        for k, (x, z) in enumerate(outline):
            xyz_m = (1e-3 * way * (inner + x), 0.0, 1e-3 * z)
            points[f"{name}{k}"] = PointModel(finger=name, xyz_m=xyz_m, corner=0 < k < 4)
        for k in range(4):
            edges[f"{name}{k}"] = EdgeModel(start=f"{name}{k}", end=f"{name}{k + 1}")
    file = Gripper(GripperModel(name="outline", fingers=fingers, points=points, edges=edges, tilt_sigma_rad=sigma_rad))
    settings = MonitorSettings()
    tracker = Tracker(make_camera(PAPER_LENS), file, settings)
    assert tracker.along.tolist() == [True, False, True, True] * 2
    possible = Possible(tracker, file, settings, FILE_T)
    hypotheses = possible.hypotheses(np.arange(len(edges)))
    assert hypotheses.across.tolist() == [False, True, sigma_rad > 0.0, False] * 2
