"""The motion since the images that edges were taught from, of a mount with play: whatever the mount does, no frame is
beyond its bound, and what moved is in the motion.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import msgspec
import numpy as np
import pytest
from support.meters import box_gripper, moved
from support.simulated import nominal_cam_T_grip
from support.taught_scenes import CAMERA, OPENING_M, RIG, image_of, reference, scene
from support.watched import pose_of

from gripmon.judge.policy import PolicySettings
from gripmon.model.poses import perturbation_between
from gripmon.model.records import Frame, FrameRecord, Since, ValidBy, Verdict
from gripmon.monitor import Monitor, Tracker, seen_in_images
from gripmon.monitor.since import AtReferences
from gripmon.teach.measure import teach
from gripmon.teach.views import TeachingImage
from gripmon.track.edges import TaughtEdges
from gripmon.track.edges.taught import own_covariance

POSE, BEVEL_M = nominal_cam_T_grip(), 2e-4
SETTINGS = msgspec.structs.replace(RIG.settings, policy=PolicySettings(valid_by=ValidBy.REFERENCE))
REFERENCE = reference(None, 1e-3, 1e-2)
LEVELS_DN = (150.0, 165.0, 180.0, 195.0, 210.0)
AXIS = POSE[:3, :3] @ np.array([0.0, 0.0, 1.0])
"""Along the fingers, camera axes."""

PLAY_M = 1.5e-4
PLAY = PLAY_M * np.array([[0, 0, 0], [0.9, -0.5, 0.3], [-0.9, 0.5, -0.3], [0.4, 0.9, 0.2], [-0.4, -0.9, -0.2]])
"""Places (5, 3) of the mount, m; none on average."""


def shown(shift_m: np.ndarray, number: int) -> np.ndarray:
    """Fingers before one of five tables, in noise of its own: a picture that repeats to the bit is an old one."""
    xi = np.concatenate([np.round(shift_m, 6), np.zeros(3)])
    image = image_of(BEVEL_M, scene(LEVELS_DN[number % 5]), moved(POSE, xi))
    noise_dn = np.random.default_rng(number).normal(0.0, 1.0, image.shape)
    return np.clip(np.rint(image + noise_dn), 0.0, 255.0).astype(np.uint8)


@lru_cache(maxsize=4)
def taught_at(places: tuple[tuple[float, ...], ...]) -> TaughtEdges:
    """What images of these places teach, as a file has it."""
    gripper = box_gripper()
    images = [TeachingImage(shown(np.array(m), k), OPENING_M, f"{k}.png") for k, m in enumerate(places)]
    found = teach(RIG._replace(settings=SETTINGS), REFERENCE, images)
    assert not found.left_out
    known = own_covariance(REFERENCE, gripper), found.reference_offset, found.reference_covariance
    edges = TaughtEdges.of(found.edges, gripper, POSE, OPENING_M, *known)
    frames = [Frame(k, 10**9 * k, image.image, OPENING_M, image.name) for k, image in enumerate(images)]
    tracker = Tracker(CAMERA, gripper, SETTINGS, edges)
    seen = seen_in_images(tracker, gripper, SETTINGS, REFERENCE, frames, found.play, 0)
    return replace(edges, at_reference=seen, play=tuple(found.play.tolist()))


def with_play() -> TaughtEdges:
    return taught_at(tuple(map(tuple, PLAY.tolist())))


class Watched:
    """A monitor with what was taught, along a way of the mount (n, 3), m from the average place of the images."""

    def __init__(self, edges: TaughtEdges, way_m: np.ndarray, mean_m: np.ndarray | None = None) -> None:
        self.monitor = Monitor(CAMERA, box_gripper(), SETTINGS, REFERENCE, edges)
        self.records: list[FrameRecord] = []
        errors, bounds, motions = [], [], []
        for k, place_m in enumerate(way_m):
            record = self.monitor.process(Frame(k, 10**9 * (k + 1), shown(place_m, 3 * k), OPENING_M))
            self.monitor.run_pending()
            assert record.cam_T_grip is not None and record.since_reference is not None
            motion = perturbation_between(POSE, pose_of(record.cam_T_grip))
            true_m = place_m - (0.0 if mean_m is None else mean_m)
            self.records.append(record)
            errors.append((np.linalg.norm(motion[:3] - true_m), np.linalg.norm(motion[3:])))
            bounds.append((record.since_reference.position_m, record.since_reference.rotation_rad))
            motions.append(motion[:3])
        self.errors, self.bounds, self.motions_m = np.array(errors), np.array(bounds), np.array(motions)

    @property
    def beyond(self) -> int:
        return int((self.errors > self.bounds).any(axis=1).sum())

    @property
    def valid(self) -> float:
        return float(np.mean([record.verdict is Verdict.VALID for record in self.records[1:]]))


JUMP_M = np.array([3e-4, 0.0, 0.0])
"""To another place of the play, twice its standard deviation."""

WAYS = {
    "to and fro": PLAY[np.arange(30) * 3 % 5],
    "stays at another place": np.concatenate([PLAY[np.arange(6) % 5], np.tile(JUMP_M, (34, 1))]),
    "stands elsewhere from the first frame on": np.tile(JUMP_M, (30, 1)),
    "a creep within the play": np.linspace(0.0, 2.0, 40)[:, None] * 0.5 * JUMP_M,
    "a knock along the fingers": PLAY[np.arange(30) * 3 % 5] + (np.arange(30) >= 12)[:, None] * 2e-3 * AXIS,
    "a knock by as much as the play along the fingers": (np.arange(30) >= 12)[:, None] * 3e-4 * AXIS,
}


@pytest.mark.parametrize("changed", ["knocked before the start", "taught with longer tips"])
def test_what_may_be_the_mount_or_the_gripper_since_the_images_is_in_the_bound(changed: str):
    """Worn tips, another lamp or another focus than on the day of the teaching look like a motion."""
    along_m = 1.5e-3 * AXIS
    run = Watched(with_play(), np.tile(along_m, (40, 1)))
    true_m = along_m if changed == "knocked before the start" else np.zeros(3)
    errors_m = np.linalg.norm(run.motions_m - true_m, axis=1)
    assert (errors_m <= run.bounds[:, 0]).all() and run.valid == 0.0
    # The operator who says that it was the mount ends it, with a new reference of this run's own frames.
    (kept,) = run.monitor.state().at_reference
    assert np.linalg.norm(np.array(kept.away[:3]) - along_m) < 5e-5


@pytest.mark.parametrize("name", WAYS)
def test_no_frame_is_beyond_its_bound_and_what_moved_is_in_the_motion(name: str):
    run = Watched(with_play(), WAYS[name])
    assert run.beyond == 0 and run.valid > 0.8
    assert {record.since_reference.since for record in run.records} == {Since.REFERENCE}
    # Neither is an average that follows the mount taken for where it stood, nor is a place of its play averaged away.
    assert np.abs(run.motions_m[-1] - WAYS[name][-1]).max() < 5e-5


def test_an_image_to_teach_from_that_was_knocked_moves_what_the_motion_counts_from_by_its_part():
    """Not by so much that the other images' place is beyond a bound."""
    knocked = np.zeros((5, 3))
    knocked[2, 0] = 1.2e-4
    edges = taught_at(tuple(map(tuple, knocked.tolist())))
    for mean_m in (knocked.mean(axis=0), np.zeros(3)):
        run = Watched(edges, np.zeros((12, 3)), mean_m)
        assert run.beyond == 0 and run.valid > 0.8


def test_where_nothing_is_known_of_the_images_play_is_no_play():
    """What the motion counts from would go with the mount: of a file of an earlier version it is a knock, as before."""
    run = Watched(replace(with_play(), at_reference=None), WAYS["stays at another place"])
    assert {record.since_reference.since for record in run.records} == {Since.FIRST_PROVED}
    of_play = replace(with_play(), at_reference=None, play=(0.0,) * 6)
    np.testing.assert_array_equal(run.bounds, Watched(of_play, WAYS["stays at another place"]).bounds)


def test_measured_with_other_settings_the_images_are_not_what_the_motion_counts_from():
    seen = with_play().at_reference
    assert seen is not None
    other = replace(with_play(), at_reference=msgspec.structs.replace(seen, measured_as="0" * 16))
    run = Watched(other, WAYS["to and fro"][:4])
    assert run.records[-1].since_reference.since is Since.FIRST_PROVED
    assert run.monitor.since_refused is not None and "teach again" in run.monitor.since_refused


def test_a_state_of_the_first_frames_does_not_replace_images_taught_since():
    """The same edges taught again with what earlier versions didn't keep: only that the mount was knocked counts."""
    run = Watched(with_play(), np.zeros((4, 3)))
    (kept,) = run.monitor.state().at_reference
    earlier = msgspec.structs.replace(kept, of_images=False, since=Since.FIRST_PROVED, knocked=True)
    state = msgspec.structs.replace(run.monitor.state(), at_reference=(earlier,))
    (now,) = Monitor(CAMERA, box_gripper(), SETTINGS, REFERENCE, with_play(), state).state().at_reference
    assert now == msgspec.structs.replace(kept, knocked=True, away=())


def test_of_images_newer_than_the_frames_the_time_counts_from_the_first_frame():
    """A video counts from zero: a mount may creep in a day of it as in any other."""
    seen = with_play().at_reference
    assert seen is not None
    measured_as = Tracker(CAMERA, box_gripper(), SETTINGS, with_play()).measured_as
    since = AtReferences(REFERENCE, ValidBy.REFERENCE, 1e-5, measured_as)
    lasting = len(seen.shift) // (6 * 8)
    taught = msgspec.structs.replace(seen, since_ns=10**18)
    assert since.begin(taught, lasting, len(seen.of_model) // (6 * 8 * lasting))
    since.first_ns, since.now_ns = 10**9, 86_401 * 10**9
    assert since.elapsed_s == 86_400.0
    since.now_ns = 10**18 + 10**9
    assert since.elapsed_s > 86_400.0


def test_a_restart_goes_on_from_the_images_and_keeps_that_the_mount_was_knocked():
    run = Watched(with_play(), WAYS["a knock along the fingers"])
    state = run.monitor.state()
    back = Monitor(CAMERA, box_gripper(), SETTINGS, REFERENCE, with_play(), state)
    assert back.since_refused is None
    (kept,) = state.at_reference
    assert kept.of_images and kept.knocked and kept.since is Since.REFERENCE
    (again,) = back.state().at_reference
    np.testing.assert_allclose(again.cam_T_grip.rotation_xyzw, kept.cam_T_grip.rotation_xyzw, atol=1e-12)
    assert msgspec.structs.replace(again, cam_T_grip=kept.cam_T_grip) == kept
    # A state of before there was such a file has nothing of these images, and needs none.
    without = msgspec.structs.replace(state, at_reference=msgspec.UNSET)
    begun = Monitor(CAMERA, box_gripper(), SETTINGS, REFERENCE, with_play(), without)
    assert begun.since_refused is None and [each.of_images for each in begun.state().at_reference] == [True]


def test_the_file_has_what_a_monitor_sees_of_its_images():
    edges = with_play()
    seen = edges.at_reference
    assert seen is not None and seen.of_images and seen.proven and seen.frames == 5
    away = perturbation_between(POSE, pose_of(seen.cam_T_grip))
    assert np.linalg.norm(away[:3]) < 5e-5
    # Of five images: what one more deviates by, when its spread is known from these (Student).
    np.testing.assert_allclose(edges.play[:3], PLAY.std(axis=0, ddof=1) * np.sqrt(4.0 / 2.0), atol=4e-5)
