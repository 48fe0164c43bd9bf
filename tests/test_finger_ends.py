"""Whether the ends of the fingers are seen as ends: in free view, behind a bar, where a pose slid along the fingers."""

from __future__ import annotations

import itertools
import sys
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from support.box_models import cube_model, two_fingers_model
from support.grippers import gripper_from_dict
from support.meters import NARROW, box_gripper, measure, meter, picture
from support.simulated import PLAIN_FINGERS, nominal_cam_T_grip, plain_scenario, simulator

from gripmon.daemon.config import read_gripper
from gripmon.model.gripper import Gripper
from gripmon.monitor.ends import MISREAD_PROBABILITY, EndsEvidence, proof
from gripmon.simulate import Scenario, make_scenario, paper_rig
from gripmon.simulate.scenario import Background, FingerMark, ObjectLook, Prop
from gripmon.track.edges import FingerEndsSeen, Measurement, MeasurementSettings
from gripmon.track.edges.roles import along_fingers
from gripmon.track.edges.settings import EdgeSettings

sys.path.insert(0, str(Path(__file__).parent.parent / "tools"))

from benchmarks.outline_seen import outline_seen

PLAIN = plain_scenario()
CUBE = Path(__file__).parent.parent / "configs" / "grippers" / "visp_cube.yaml"


def slid(slide_m: float) -> np.ndarray:
    """The nominal pose moved along the gripper's z."""
    pose = nominal_cam_T_grip()
    pose[:3, 3] += slide_m * pose[:3, 2]
    return pose


def slide_of(measurement: Measurement) -> float:
    """How far along the gripper's z a measured pose is from the nominal one."""
    nominal = nominal_cam_T_grip()
    return float((measurement.cam_T_grip[:3, 3] - nominal[:3, 3]) @ nominal[:3, 2])


def looked_at(scenario: Scenario, slide_m: float = 0.0, *, seed: int = 1) -> tuple[Measurement, FingerEndsSeen]:
    """A measurement about a slid pose, narrowly, and what is seen of the ends there."""
    using, image = meter(), picture(scenario, seed=seed)
    found = measure(image, slid(slide_m), using=using)
    return found, using.ends(image, found)


def bar_before_the_tips(z_m: float, size_z_m: float, level_dn: float, **look: object) -> Scenario:
    """Parallel to the tips, wider than the gripper, between it and the camera."""
    bar = Prop(
        size_m=(0.2, 0.01, size_z_m),
        centre_m=(0.0, -0.02, z_m),
        look=ObjectLook(pattern="plain", level_dn=level_dn),
    )
    return plain_scenario(props=(bar,), **look)


def toned(from_tip_m: float, gain: float) -> Scenario:
    """Fingers that are of another tone from somewhere behind their tips on."""
    tone = FingerMark(from_tip_m=(from_tip_m, 0.3), across=(-2.0, 2.0), gain=gain)
    return plain_scenario(fingers=msgspec.structs.replace(PLAIN_FINGERS, marks=(tone,)))


# --- free view ---


@pytest.mark.parametrize(
    "scenario",
    [
        PLAIN,
        Scenario(name="usual", background=Background(kind="blobs"), duration_s=1.0),
        Scenario(name="printed", background=Background(kind="printed"), duration_s=1.0),
    ],
    ids=lambda scenario: scenario.name,
)
def test_in_free_view_both_fingers_show_their_ends(scenario: Scenario):
    found, ends = looked_at(scenario)
    assert abs(slide_of(found)) < 5e-5
    assert ends.sure and (ends.seen >= 2).all()
    np.testing.assert_array_equal(ends.might, [3, 3])


@pytest.mark.parametrize("blur_px", [0.4, 1.8])
def test_the_ends_are_seen_with_any_edge_filter_that_the_search_lines_hold(blur_px: float):
    using, image = meter(settings=MeasurementSettings(edges=EdgeSettings(blur_px=blur_px))), picture(PLAIN)
    assert using.ends(image, measure(image, nominal_cam_T_grip(), using=using)).sure


def test_one_finger_with_its_end_hidden_proves_nothing_and_the_other_one_is_seen():
    box = Prop(size_m=(0.06, 0.01, 0.04), centre_m=(0.038, -0.02, -0.012), look=ObjectLook(pattern="plain"))
    _, ends = looked_at(plain_scenario(props=(box,)))
    left, right = ends.seen.tolist()
    assert left == 3 and right < 2
    assert not ends.sure


# --- what only looks like the ends ---


@pytest.mark.parametrize("level_dn", [30.0, 230.0])
@pytest.mark.parametrize(("z_m", "size_z_m"), [(-0.010, 0.03), (-0.018, 0.04)])
def test_a_bar_before_the_tips_with_its_rim_parallel_to_them_proves_nothing(
    z_m: float, size_z_m: float, level_dn: float
):
    """Wherever along the fingers they are expected: one of these places has the tips on the bar's rim."""
    scenario = bar_before_the_tips(z_m, size_z_m, level_dn)
    assert outline_seen(simulator(scenario), 0).tips.max() < 0.7, "it hides them"
    for slide_m in np.linspace(-0.03, 0.012, 15).tolist():
        _, ends = looked_at(scenario, slide_m)
        assert not ends.sure and ends.seen.max() < 2


@pytest.mark.parametrize("scenario", [PLAIN, Scenario(name="usual", duration_s=1.0)], ids=["plain", "usual"])
@pytest.mark.parametrize("slide_m", [-9e-3, -4.5e-3, 3e-3, 9e-3])
def test_a_pose_that_slid_along_the_fingers_is_not_proven(scenario: Scenario, slide_m: float):
    """Most edges agree there; the fingers go on beyond where it has their ends, or end before."""
    found, ends = looked_at(scenario, slide_m)
    assert found.trusted and abs(slide_of(found)) > 2.5e-3, "measured there, or nearly"
    assert not ends.sure and ends.seen.max() < 2


@pytest.mark.parametrize("mirror_m", [7.5e-4, 1.5e-3])
def test_ends_in_a_mirror_are_none_since_sides_of_the_fingers_go_on_beyond_them(mirror_m: float):
    """The tips' image in a glossy table lies where a knock along the fingers has taken the tips away from."""
    mirror = Prop(shape="mirrored_fingers", centre_m=(0.0, 0.0, mirror_m))
    gripper = box_gripper(sharp=False)
    evidence = EndsEvidence(gripper, along_fingers(gripper)[1])
    found, ends = looked_at(plain_scenario(props=(mirror,)), 2.0 * mirror_m)
    assert slide_of(found) == pytest.approx(2.0 * mirror_m, abs=2e-4)
    assert ends.longer == {0, 1} and ends.seen.min() == 0 and ends.seen.sum() <= 1
    assert evidence.misread(found, ends) == 1.0
    assert evidence.misread(found, replace(ends, longer=frozenset())) == pytest.approx(MISREAD_PROBABILITY**2)
    # A finger that shows a corner isn't doubted for what goes on beside it.
    cornered = replace(ends, seen=np.array([2, 2]), strictly=np.array([2, 2]))
    assert evidence.misread(found, cornered) == pytest.approx(MISREAD_PROBABILITY**4)


@pytest.mark.parametrize("gain", [0.7, 2.0])
@pytest.mark.parametrize("from_tip_m", [0.004, 0.009])
def test_where_a_tone_of_the_fingers_begins_is_not_their_end(from_tip_m: float, gain: float):
    """The slid pose shows corners there, and its tip edges; that the edges along the fingers go on gives it away."""
    scenario = toned(from_tip_m, gain)
    found, ends = looked_at(scenario, -from_tip_m)
    assert found.trusted and abs(slide_of(found) + from_tip_m) < 1e-3
    assert found.corners.usable.sum() >= 2, "corners are seen"
    assert not ends.sure and ends.seen.max() < 2
    assert looked_at(scenario)[1].sure, "the true ends are"


@pytest.mark.parametrize(("z_m", "size_z_m", "rim_m"), [(-0.010, 0.03, -0.0143), (-0.012, 0.02, -0.0109)])
def test_corners_that_a_rim_makes_with_the_fingers_are_none(z_m: float, size_z_m: float, rim_m: float):
    """It cuts both fingers and goes on beside them: a corner a finger is seen there, and none counts."""
    found, ends = looked_at(bar_before_the_tips(z_m, size_z_m, 120.0), rim_m)
    assert abs(slide_of(found) - rim_m) < 1e-3 and found.corners.usable.sum() == 2
    np.testing.assert_array_equal(ends.seen, 0)


def test_the_prediction_that_is_kept_between_frames_is_the_one_that_is_looked_at():
    """The same meter on the true pose, on a slid one, and on the true one again."""
    using, image = meter(), picture(toned(0.006, 0.5))
    for slide_m, sure in ((0.0, True), (-6e-3, False), (0.0, True)):
        found = measure(image, slid(slide_m), using=using)
        assert using.ends(image, found).sure is sure
        assert using.ends(image, found).sure is sure, "and once more with what was kept"


def test_before_a_background_full_of_lines_most_corners_at_the_ends_count():
    """A line that happens to lie on a finger's continuation, or beside it, is seldom long and strong enough."""
    using, counted = meter(), []
    scenario = make_scenario("clutter", duration_s=8.0, fps=4.0)
    for index in range(24):
        image = picture(scenario, index)
        found = measure(image, using=using)
        counted.append(using.ends(image, found).seen.sum())
    assert np.mean(counted) > 3.3


# --- counting ---


def test_ends_are_sure_when_two_fingers_show_four_corners_or_the_only_one_two():
    def sure(seen: list[int], might: list[int]) -> bool:
        return FingerEndsSeen(np.array(seen), np.array(might), np.array(seen)).sure

    assert sure([2, 2], [3, 3]) and sure([3, 1], [3, 3]) and sure([2, 2, 0], [3, 3, 3]) and sure([2, 1, 1], [3, 3, 3])
    assert not sure([2, 1], [3, 3]) and not sure([1, 1], [3, 3]) and not sure([4, 0], [4, 4]), "one finger may be bent"
    assert sure([2], [4]) and sure([2, 0], [3, 1]) and not sure([1, 0], [3, 1]), "the view has no more"
    assert not sure([1, 1], [1, 1]) and not sure([0, 0], [0, 0]), "none can be proven"


# --- grippers ---


def test_edges_along_the_fingers_are_those_of_the_way_that_most_of_them_go():
    gripper = box_gripper()
    direction, flags = along_fingers(gripper)
    assert np.abs(direction) == pytest.approx([0.0, 0.0, 1.0])
    along = {name for name, flag in zip(gripper.edge_ids, flags, strict=True) if flag}
    assert along == {name for name in gripper.edge_ids if name.endswith("_along")}
    boxes = gripper_from_dict(two_fingers_model())
    way = np.diff(boxes.points_grip_m()[boxes.edge_points], axis=1)[:, 0]
    np.testing.assert_array_equal(along_fingers(boxes)[1], np.abs(way[:, 2]) > 0.01)


def test_fingers_that_taper_two_ways_have_the_direction_of_their_middle():
    """Of the edges of a pyramid, 23 degrees from its middle each, no two are within 30 degrees of each other."""
    lean = float(np.tan(np.radians(17.0)))
    corners = {"a": (-1, -1), "b": (1, -1), "c": (1, 1), "d": (-1, 1)}
    value = {"name": "pyramids", "fingers": {"left": {}, "right": {}}, "points": {}, "edges": {}}
    for finger, x_m in (("left", -0.03), ("right", 0.03)):
        for name, way in corners.items():
            for end, z_m in (("tip", 0.0), ("root", -0.04)):
                at = [x_m + way[0] * (0.003 - lean * z_m), way[1] * (0.003 - lean * z_m), z_m]
                value["points"][f"{finger}_{name}_{end}"] = {"finger": finger, "xyz_m": at}
            ends = {"from": f"{finger}_{name}_tip", "to": f"{finger}_{name}_root"}
            value["edges"][f"{finger}_{name}"] = ends
        for one, other in zip("abcd", "bcda", strict=True):
            ends = {"from": f"{finger}_{one}_tip", "to": f"{finger}_{other}_tip"}
            value["edges"][f"{finger}_{one}{other}"] = ends
    gripper = gripper_from_dict(value)
    direction, along = along_fingers(gripper)
    np.testing.assert_allclose(np.abs(direction), [0.0, 0.0, 1.0], atol=1e-9)
    assert [name for name, flag in zip(gripper.edge_ids, along, strict=True) if not flag] == [
        name for name in gripper.edge_ids if len(name.rpartition("_")[2]) == 2
    ]


@pytest.mark.parametrize("cube", [read_gripper(CUBE), gripper_from_dict(cube_model())], ids=["visp_cube", "cube"])
def test_a_gripper_without_a_direction_has_all_its_corners_for_ends(cube: Gripper):
    direction, along = along_fingers(cube)
    assert along.all() and not direction.any()
    pose = np.eye(4)
    turn = np.deg2rad([35.0, 25.0, 10.0])
    for axis, angle in enumerate(turn):
        c, s = np.cos(angle), np.sin(angle)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        about = np.eye(4)
        about[[i, i, j, j], [i, j, i, j]] = [c, -s, s, c]
        pose = about @ pose
    middle = cube.points_grip_m().mean(axis=0)
    pose[:3, 3] = np.array([0.0, 0.0, 0.35]) - pose[:3, :3] @ middle
    image = paper_rig(cube, pose).simulator(PLAIN, 1).render(0)
    using = meter(cube)
    found = using.measure(image, pose, cube.jaw_nominal_m, 0.9, NARROW)
    ends = using.ends(image, found)
    visible, usable = found.prediction.corners.visible, found.corners.usable
    assert usable.sum() >= 5
    assert ends.might.tolist() == [visible.sum()] and ends.seen.tolist() == [usable.sum()]
    assert ends.sure


@pytest.mark.parametrize("displaced", [False, True])
@pytest.mark.parametrize("again", [False, True])
@pytest.mark.parametrize("along", [None, 1e-3])
def test_what_proves_a_pose_is_what_the_page_of_bounds_says(displaced: bool, again: bool, along: float | None):
    """Of two fingers with two corners each, for every number of these that is seen, and seen strictly."""
    risk, might = 1e-5, np.array([2, 2])
    for a, b, sa, sb in itertools.product(range(3), repeat=4):
        if sa > a or sb > b:
            continue
        misread = 0.1 ** (a + b)
        ends = FingerEndsSeen(np.array([a, b]), might, np.array([sa, sb]))
        found = proof(ends, misread, risk, displaced, again, along)
        corners, each, expected = a + b, a > 0 and b > 0, not displaced or along is not None
        whole = int(a > 0 and sa == a) + int(b > 0 and sb == b)
        proven = each and corners == 4
        proven |= sa + sb > 0 and ((expected and corners >= 3) or (again and each))
        left = misread * 0.1**whole * (1.0 if along is None else along)
        proven |= each and (whole > 0 or not displaced) and left < 1.0001 * risk
        assert found.proven == proven
        assert found.misread == pytest.approx(misread * 0.1**whole if proven else misread)
    assert proof(None, 0.1, risk, displaced, again, along) == (False, 0.1)
