"""The belief beside the rules: it changes nothing, its rows say what pictures say, and it finds what is true."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest
from support.meters import box_gripper, difference, moved
from support.simulated import PAPER_LENS, nominal_cam_T_grip, plain_scenario, sharp_gripper
from support.watched import frames_of, new_monitor, reference_of, watched

from gripmon.belief.doubts import Told, log_told
from gripmon.belief.state import FOCAL, LENGTHS, LIGHT, MOTION, REFERENCE, SIZE, Seen
from gripmon.model.camera import make_camera
from gripmon.model.poses import perturb
from gripmon.model.records import Frame
from gripmon.monitor import Monitor, MonitorSettings
from gripmon.monitor.edge_lines import Frame2d, Line, Parts, lines_of, merged
from gripmon.monitor.ends_told import EndsTold
from gripmon.monitor.lighting import Lighting
from gripmon.monitor.shadow import Look, Shadow, _alike, _texture
from gripmon.simulate import paper_rig
from gripmon.simulate.scenario import Scenario
from gripmon.track.edges import FingerEndsSeen
from gripmon.track.edges.prediction import EdgeLayout

FRAME_S = 1.0 / 30.0


class Watching(Shadow):
    """What was seen of the newest frame."""

    seen: Seen
    told: Told

    def _told(self, frame: Frame, looks: list[Look], fit: int, now_s: float) -> Told:
        self.told = super()._told(frame, looks, fit, now_s)
        return self.told

    def _seen(self, frame: Frame, looks: list[Look], fit: int) -> Seen | None:
        seen = super()._seen(frame, looks, fit)
        assert seen is not None
        self.seen = seen
        return seen


def seen_in(image: np.ndarray, pose: np.ndarray, opening_m: float, camera: object = None) -> Seen:
    """A single frame's edges, against the nominal reference, measured from ``pose``."""
    reference = reference_of(nominal_cam_T_grip())
    monitor = Monitor(camera or make_camera(PAPER_LENS), sharp_gripper(), MonitorSettings(), reference)
    shadow = Watching(monitor._camera, sharp_gripper(), monitor._tracker, reference, MonitorSettings())
    frame = Frame(seq=0, stamp_ns=0, image=image, jaw_opening_m=opening_m)
    shadow.see(frame, monitor._tracker.measure(frame, pose, 0.0), 0.0)
    return shadow.seen


def picture(pose: np.ndarray, scenario: Scenario | None = None) -> tuple[np.ndarray, float]:
    simulator = paper_rig(sharp_gripper(), pose).simulator(scenario or plain_scenario(), 1)
    frame = simulator.frame(0)
    assert isinstance(frame.image, np.ndarray) and frame.jaw_opening_m is not None
    return frame.image, frame.jaw_opening_m


@pytest.mark.parametrize("xi", [np.eye(6)[k] * (2e-4 if k < 3 else 2e-3) for k in range(6)])
def test_rows_say_what_a_moved_gripper_does_to_the_picture(xi: np.ndarray) -> None:
    """Two rendered pictures, both searched at the nominal pose: their difference is the rows times the motion."""
    before, after = (seen_in(*_at(nominal_cam_T_grip(), step)) for step in (-xi, xi))
    both = before.shown & after.shown
    assert both.sum() >= 8
    shift = after.lines[both, 0] - before.lines[both, 0]
    assert np.abs(shift).max() > 0.3
    assert shift == pytest.approx(before.rows[both, 0][:, :, MOTION] @ (2.0 * xi), abs=0.08)
    assert np.array_equal(before.rows[..., MOTION], before.rows[..., REFERENCE])


def _at(pose: np.ndarray, xi: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    image, opening_m = picture(moved(pose, xi))
    return image, pose, opening_m


def test_a_longer_lens_and_brighter_light_move_edges_as_their_columns_say() -> None:
    image, opening_m = picture(nominal_cam_T_grip())
    pose = nominal_cam_T_grip()
    plain = seen_in(image, pose, opening_m)
    grown = 1.003
    centre = np.array([PAPER_LENS.cx_px, PAPER_LENS.cy_px])
    warp = np.hstack([grown * np.eye(2), ((1.0 - grown) * centre)[:, None]])
    size = image.shape[1], image.shape[0]
    zoomed = cv2.warpAffine(image, warp, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    longer = seen_in(zoomed, pose, opening_m)
    spread = seen_in(cv2.dilate(image, np.ones((3, 3), np.uint8)), pose, opening_m)
    for other, column, by in ((longer, FOCAL, np.log(grown)), (spread, LIGHT, 1.0)):
        both = plain.shown & other.shown
        shift = other.lines[both, 0, 0] - plain.lines[both, 0, 0]
        wanted = by * plain.rows[both, 0, 0, column]
        assert np.abs(wanted).max() > 0.5
        assert shift == pytest.approx(wanted, abs=0.08 if column == FOCAL else 0.45)  # a square spreads more


def test_only_ends_tell_of_lengths() -> None:
    image, opening_m = picture(nominal_cam_T_grip())
    seen = seen_in(image, nominal_cam_T_grip(), opening_m)
    lengths = np.abs(seen.rows[:, 0, 0, LENGTHS])
    finger = sharp_gripper().edge_finger
    tips = np.array(["tip" in name for name in sharp_gripper().edge_ids]) & seen.shown
    assert tips.any()
    for f in (0, 1):
        assert (lengths[tips & (finger == f), f] > 500.0).any()
        assert not lengths[~tips | (finger != f), f].any()


def test_pictures_are_alike_but_for_gain_and_noise() -> None:
    rng = np.random.default_rng(4)
    picture, other = rng.normal(120.0, 8.0, (2, 12))
    for gain, offset in ((1.0, 0.0), (0.8, 15.0)):
        again = gain * picture + offset + rng.normal(0.0, 0.5, 12)
        assert _alike(again, picture, 0.5) == 0.999
    assert _alike(other, picture, 0.5) < 0.8
    assert _alike(picture + rng.normal(0.0, 4.0, 12), picture, 0.5) <= 0.98


def test_a_background_that_creeps_is_another_one_in_the_end() -> None:
    """0.2 of a place a frame: no two frames differ by more than their noise, the first and the tenth do."""
    rng = np.random.default_rng(4)
    wide, at = np.cumsum(rng.normal(0.0, 1.0, 400)) + 120.0, np.arange(12.0) * 4.0
    creeping, still = ([np.interp(at + k * step, np.arange(400), wide) for k in range(40)] for step in (0.2, 0.0))
    for pictures, least, most in ((still, 0.95, 1.0), (creeping, 0.0, 0.7)):
        shadow = Shadow.__new__(Shadow)
        shadow._beside, shadow._like = np.full((1, 2, 12), np.nan), np.zeros(1)
        likes = [shadow._compare(0, np.array([p, p]) + rng.normal(0.0, 0.3, (2, 12)), 0.3) for p in pictures]
        assert likes[0] == 0.0
        assert least <= np.prod(likes[1:]) <= most


def test_a_light_is_left_as_far_as_the_fingers_are_as_bright() -> None:
    """By noise nothing changes; what changes slowly has changed as much in the end; a stop leaves exp(-1/2)."""
    rng = np.random.default_rng(6)
    grey = rng.uniform(40.0, 160.0, (10, 1)) + rng.normal(0.0, 3.0, (10, 12))

    def left(*gains: float) -> float:
        lighting = Lighting()
        return float(np.prod([lighting.kept(g * grey + rng.normal(0.0, 1.0, grey.shape), 1.0) for g in gains]))

    assert left(*[1.0] * 30) > 0.999
    assert left(1.0, 2.0) == pytest.approx(np.exp(-0.5), abs=0.01)
    assert left(*np.linspace(1.0, 2.0, 30)) == pytest.approx(left(1.0, 2.0), abs=0.01)
    assert left(1.0, 4.0, 1.0) < 0.1
    unseen = grey.copy()
    unseen[3] = np.nan
    lighting = Lighting()
    assert [lighting.kept(of, 1.0) for of in (unseen, grey, grey)] == [1.0, 1.0, 1.0]


def test_the_light_is_looked_at_on_the_fingers_and_the_belief_is_told() -> None:
    """The fingers half as bright: what was learnt of the light is partly forgotten; the background alone: nothing."""
    image, opening_m = picture(nominal_cam_T_grip())
    pose, reference = nominal_cam_T_grip(), reference_of(nominal_cam_T_grip())
    monitor = Monitor(make_camera(PAPER_LENS), sharp_gripper(), MonitorSettings(), reference)
    measure = monitor._tracker.measure
    of_fingers = measure(Frame(seq=0, stamp_ns=0, image=image, jaw_opening_m=opening_m), pose, 0.0).prediction.uv_px
    fingers = np.zeros(image.shape[:2], np.uint8)
    middle = 0.5 * (of_fingers[:, 0].min() + of_fingers[:, 0].max())
    for side in (of_fingers[:, 0] < middle, of_fingers[:, 0] >= middle):
        cv2.fillConvexPoly(fingers, cv2.convexHull(np.round(of_fingers[side]).astype(np.int32)), 1)
    kept, unsure = [], []
    for gain, where in ((1.0, fingers), (0.5, fingers), (0.8, 1 - fingers)):
        shadow = Shadow(monitor._camera, sharp_gripper(), monitor._tracker, reference, MonitorSettings())
        for k, of in enumerate([image] * 4 + [np.where(where > 0, gain * image, image).astype(np.uint8)]):
            frame = Frame(seq=k, stamp_ns=0, image=of, jaw_opening_m=opening_m)
            shadow.see(frame, measure(frame, pose, 0.0), k * FRAME_S)
        kept.append(shadow._light_kept)
        unsure.append(shadow._belief.moments[1][LIGHT, LIGHT])
    assert kept == pytest.approx([1.0, np.exp(-0.5), 1.0], abs=0.05)
    assert unsure[1] > 2.0 * unsure[0] and unsure[2] == pytest.approx(unsure[0], rel=0.2)


def test_texture_is_the_scatter_without_noise_and_shading() -> None:
    rng = np.random.default_rng(5)
    found = []
    for _ in range(400):
        side = 100.0 + np.linspace(0.0, 20.0, 12) + rng.normal(0.0, 3.0, 12) + rng.normal(0.0, 1.0, 12)
        found.append(_texture(side[None, None].repeat(2, axis=1), 0, 1.0) ** 2)
    assert np.mean(found) == pytest.approx(9.0, rel=0.1)


def test_lines_are_those_of_the_fit_and_what_half_of_the_rest_supports() -> None:
    """Twenty search lines: the fit's line, another 4 px beside and oblique, a third that too few show, and noise."""
    rng, fraction = np.random.default_rng(6), np.linspace(0.1, 0.9, 20)
    way = np.linspace(-1.0, 1.0, 20)
    rows = [(0.3 * np.ones(20), np.ones(20, bool)), (4.0 + 0.8 * way, rng.random(20) < 0.8)]
    rows += [(-5.0 * np.ones(20), np.arange(20) < 7), (rng.uniform(-7.0, 7.0, 20), rng.random(20) < 0.5)]
    sample = np.concatenate([np.flatnonzero(there) for _, there in rows])
    of = np.concatenate([np.full(there.sum(), k) for k, (_, there) in enumerate(rows)])
    offset = np.concatenate([at[there] for at, there in rows]) + rng.normal(0.0, 0.05, len(sample))
    order = np.argsort(sample, kind="stable")
    sample, of, offset = sample[order], of[order], offset[order]
    first, second = lines_of(offset, sample, fraction[sample], of == 0, 20)
    assert (first == (of == 0)).all()
    assert second[of == 1].mean() > 0.9
    assert second[of != 1].sum() <= 2
    assert len(lines_of(offset, sample, fraction[sample], np.zeros(len(of), bool), 20)) == 2
    noise = of == 3
    assert lines_of(offset[noise], sample[noise], fraction[sample[noise]], np.zeros(noise.sum(), bool), 20) == []


def test_a_line_that_stands_still_is_the_same_line_whatever_is_seen_of_it() -> None:
    """Two parts of one line, in the frame of the edge that was seen there first."""
    frame = Frame2d(np.array([100.0, 50.0]), np.array([20.0, 0.0]))
    for first, last in ((80.0, 120.0), (115.0, 160.0)):
        x = np.linspace(first, last, 12)
        place, variance = frame.line(np.column_stack([x, 52.0 + 0.1 * (x - 100.0)]), np.ones(12))
        assert place == pytest.approx([2.0, 2.0], abs=1e-9)
        basis = np.column_stack([np.ones(12), (x - 100.0) / 20.0])
        assert variance == pytest.approx(np.diag(np.linalg.inv(basis.T @ basis)))


def test_a_curve_is_several_edges_of_the_belief() -> None:
    """A straight border touches an arc in a part of it: in another the slopes differ."""
    parts = Parts(np.array([False, True]))
    assert len(parts) == 3 and parts.edge.tolist() == [0, 1, 1]
    edge, fraction = np.repeat([0, 1], 4), np.tile([0.0, 0.4, 0.6, 1.0], 2)
    two = np.ones(2, bool)
    layout = EdgeLayout(edge, fraction, np.array([0, 1]), np.array([0, 4]), two, ~two)
    assert parts.of(layout).tolist() == [0, 0, 0, 0, 1, 1, 2, 2]


def test_a_line_of_two_looks_is_one_and_the_fits_own_is_named() -> None:
    def line(place_px: float, agrees: bool) -> Line:
        two = np.zeros(2)
        return Line(np.zeros((2, SIZE)), np.array([place_px, 0.0]), two, two, two, two, 10.0, 50.0, agrees)

    looks = [[line(0.1, True), line(4.0, False)], [line(4.2, True), line(-20.0, False)]]
    assert [of.place_px[0] for of in merged(looks, 1)[0]] == [0.1, 4.0, -20.0]
    assert [merged(looks, by)[1] for by in (0, 1)] == [0, 1]
    assert merged([[], [line(1.0, False)]], 0)[1] == -1


def test_the_gripper_is_looked_for_where_it_is_believed_to_be_though_the_fit_slid_away() -> None:
    """Six millimetres along the fingers: the most plausible wrong place, and all that the rules' fit shows."""
    pose = nominal_cam_T_grip()
    image, opening_m = picture(pose)
    frame = Frame(seq=0, stamp_ns=0, image=image, jaw_opening_m=opening_m)
    monitor = Monitor(make_camera(PAPER_LENS), sharp_gripper(), MonitorSettings(), reference_of(pose))
    axis = pose[:3, :3] @ monitor._tracker.finger_axis
    slid = perturb(pose, np.concatenate([6e-3 * axis, np.zeros(3)]))
    fit = monitor._tracker.measure_held(frame, slid, np.array([1e-6] * 3 + [1e-6] * 3))
    assert np.linalg.norm(fit.cam_T_grip[:3, 3] - slid[:3, 3]) < 1e-3
    shadow = Watching(monitor._camera, sharp_gripper(), monitor._tracker, reference_of(pose), MonitorSettings())
    shadow.see(frame, fit, 0.0)
    plain = seen_in(image, pose, opening_m)
    both = plain.shown & shadow.seen.shown
    assert (both == plain.shown).all()
    nearest = np.array([np.abs(shadow.seen.lines[e, : shadow.seen.found[e], 0]).min() for e in np.flatnonzero(both)])
    assert nearest.max() < 1.0
    assert shadow.newest is not None and shadow.newest.known
    assert np.linalg.norm(shadow.newest.motion[:3]) < 1e-4


def test_ends_are_asked_wherever_the_frame_was_searched() -> None:
    """The camera slid along the fingers by 6 mm: no line is left at the old ends, whose answer speaks of these alone;
    what is asked again tells little.
    """
    pose = nominal_cam_T_grip()
    monitor = Monitor(make_camera(PAPER_LENS), sharp_gripper(), MonitorSettings(), reference_of(pose))
    slid = perturb(pose, np.concatenate([6e-3 * pose[:3, :3] @ monitor._tracker.finger_axis, np.zeros(3)]))
    image, opening_m = picture(slid)
    frame = Frame(seq=0, stamp_ns=0, image=image, jaw_opening_m=opening_m)
    fit = monitor._tracker.measure(frame, slid, 0.0)
    shadow = Watching(monitor._camera, sharp_gripper(), monitor._tracker, reference_of(pose), MonitorSettings())
    shadow.see(frame, fit, 0.0)
    told, away = shadow.told, np.linalg.norm(shadow.told.at[:, :3], axis=1)
    there, old = int(np.argmax(away)), int(np.argmin(away))
    assert away[there] > 5e-3 > 1e-4 > away[old] and told.fit == there
    assert (told.right[there] > told.wrong[there]).all() and (told.right[old] < told.wrong[old]).all()
    assert (told.memory == 0.0).all()
    unasked = EndsTold(2).told([FingerEndsSeen(*np.zeros((3, 2), int))], [fit], told.rows, told.at[:1], 0, 0.0)
    table = shadow._belief._table
    for before, after in itertools.product((0, int(table.ends[0])), repeat=2):
        assert log_told(before, after, table, unasked, False, np.zeros(2, int)) == 0.0
    shadow.see(frame, fit, FRAME_S)
    assert (shadow.told.memory[[there, old]] > 0.4).all() and (shadow.told.repeats[[there, old]] == 1.0).all()


def test_records_are_the_same_with_and_without() -> None:
    frames, _ = frames_of("clutter")
    reference = reference_of(nominal_cam_T_grip())
    beside = Monitor(make_camera(PAPER_LENS), box_gripper(sharp=False), MonitorSettings(), reference, shadow=True)
    records = [beside.process(frame) for frame in frames[:20]]
    assert records == [*watched("clutter").records[:20]]
    assert new_monitor().shadow is None


@pytest.mark.parametrize("scene", ["clutter", "bump", "bent_finger"])
def test_its_motion_is_true_within_its_bound(scene: str) -> None:
    """A mount that jumps, a finger that bends: where the gripper stands is known at once.  That what shows its ends
    after a jump along the fingers isn't something else is not, so that the bound stays wide.
    """
    frames, truths = frames_of(scene)
    reference = reference_of(nominal_cam_T_grip())
    monitor = Monitor(make_camera(PAPER_LENS), box_gripper(sharp=False), MonitorSettings(), reference, shadow=True)
    assert monitor.shadow is not None
    within, errors_m = [], []
    for frame, truth in zip(frames, truths, strict=True):
        monitor.process(frame)
        believed = monitor.shadow.newest
        assert believed is not None
        error = difference(nominal_cam_T_grip(), truth.cam_T_grip) - believed.motion
        assert np.linalg.norm(error[:3]) <= believed.bound.position_m
        assert np.linalg.norm(error[3:]) <= believed.bound.rotation_rad
        errors_m.append(np.linalg.norm(error[:3]))
        within.append(believed.bound.position_m < 1e-3)
    assert np.quantile(errors_m, 0.9) < 1e-4
    assert np.mean(within) > (0.3 if scene == "bump" else 0.9)
