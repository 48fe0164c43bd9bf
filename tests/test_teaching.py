"""Teaching against independent truth: the renderer's bevelled solids, whose edges the taught model has never seen."""

from __future__ import annotations

import re
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from support.meters import box_gripper, moved
from support.simulated import nominal_cam_T_grip
from support.taught_scenes import (
    CAMERA,
    OPENING_M,
    RIG,
    arrays,
    bevelled,
    error,
    image_of,
    measured,
    reference,
    scene,
    taught_from,
)

from gripmon.model.geometry import invert
from gripmon.model.gripper import Gripper, contents_of
from gripmon.simulate.solids import finger_solids
from gripmon.teach.accuracy import forecast_frame
from gripmon.teach.measure import teach
from gripmon.teach.play import with_play
from gripmon.teach.views import TeachingImage, TeachingRefused, Viewer
from gripmon.teach.visibility import Rig
from gripmon.track.edges.taught import sight_axes

POSE = nominal_cam_T_grip()
PX_PER_M = 8000.0  # at the gripper, to a tenth
BEVEL_M = 3e-4
OUTLINES = tuple(
    f"{finger}_{edge}" for finger in "LR" for edge in ("tip_in", "tip_near", "in_far_along", "out_near_along")
)
CREASES = ("L_in_near_along", "R_in_near_along")


def other_views(count: int, levels: tuple[float, ...], seed: int = 3) -> list[tuple[np.ndarray, float, np.ndarray]]:
    """Poses some 1 mm and 0.5 degrees away, openings some millimetres, and the images of bevelled fingers there."""
    rng = np.random.default_rng(seed)
    views = []
    for k in range(count):
        pose = moved(POSE, np.concatenate([rng.normal(0.0, 6e-4, 3), np.radians(rng.normal(0.0, 0.3, 3))]))
        opening_m = OPENING_M + rng.uniform(-0.005, 0.005)
        views.append((pose, opening_m, image_of(BEVEL_M, scene(levels[k % len(levels)], opening_m), pose)))
    return views


def test_sharp_edges_are_taught_no_offset():
    """At the true pose of a clean image: less than two hundredths of a pixel, at every edge in view."""
    taught = taught_from(image_of(0.0))
    assert set(taught.edges) == {*OUTLINES, *CREASES} and not taught.untaught and not taught.notes
    offsets_px = PX_PER_M * np.array([edge.offset_m for edge in taught.edges.values()])
    assert np.abs(offsets_px).max() < 0.02
    assert np.abs(PX_PER_M * np.array([edge.depth_m for edge in taught.edges.values()])).max() < 0.15
    assert {name for name, edge in taught.edges.items() if edge.crease} == set(CREASES)
    assert taught.closure_px < 0.02


def silhouette_offsets_m(width_m: float) -> dict[str, tuple[float, float]]:
    """Where the silhouette of the bevelled solid lies beside each outline of the sharp model, across the line of sight,
    and how much deeper: of all vertices of the solid next to the edge the outermost.
    """
    gripper, solids = box_gripper(), finger_solids(bevelled(width_m))
    points = gripper.points_grip_m(None)
    across, depth = sight_axes(gripper, points, POSE)
    eye = invert(POSE)[:3, 3]
    out = {}
    for name in OUTLINES:
        edge = gripper.edge_ids.index(name)
        start, end = points[gripper.edge_points[edge]]
        vertices = solids[gripper.edge_finger[edge]].vertices_m
        along = (end - start) / np.linalg.norm(end - start)
        beside = np.linalg.norm(np.cross(vertices - start, along), axis=1) < 2.0 * width_m
        side = np.sign((vertices.mean(axis=0) - eye) @ across[edge])
        offsets_m = (vertices[beside] - eye) @ across[edge]
        rim = int(np.argmin(side * offsets_m))
        out[name] = float(offsets_m[rim]), float((vertices[beside][rim] - start) @ depth[edge])
    return out


def test_taught_offsets_are_those_of_the_bevelled_solid():
    """The silhouette by the solid's vertices, which only the renderer knows.  Beside two outlines the bevel itself
    shows: they are seen between its two sides.
    """
    taught, truth = taught_from(image_of(BEVEL_M)), silhouette_offsets_m(BEVEL_M)
    assert max(abs(offset_m) for offset_m, _ in truth.values()) > 8e-5
    for name, (offset_m, depth_m) in truth.items():
        edge = taught.edges[name]
        beside = name in ("L_out_near_along", "R_out_near_along")
        assert np.mean(edge.offset_m) == pytest.approx(offset_m, abs=8e-5 if beside else 6e-6), name
        assert abs(edge.depth_m - depth_m) < 2.0 * edge.depth_sigma_m, name


def test_the_bias_of_bevels_cancels_when_the_camera_and_the_jaws_move():
    """One image to learn from: in others the error falls to less than a twentieth, on the same table."""
    known = arrays(taught_from(image_of(BEVEL_M)))
    before, after = [], []
    for pose, opening_m, image in other_views(6, (180.0,)):
        before.append(error(measured(image, None, pose, opening_m), pose))
        found = measured(image, known, pose, opening_m)
        after.append(error(found, pose))
        assert found.trusted
        assert after[-1] @ np.linalg.solve(found.covariance[:6, :6], after[-1]) < 22.5
    rms = [np.sqrt(np.square(e)[:, :3].sum(axis=1).mean()) for e in (np.array(before), np.array(after))]
    assert rms[0] > 5e-4
    assert rms[1] < rms[0] / 20.0


def test_several_backgrounds_are_averaged_and_their_scatter_is_the_uncertainty():
    """A table darker and brighter than the fingers moves outlines beside which a bevel shows, and those alone."""
    taught = taught_from(*(image_of(BEVEL_M, scene(level)) for level in (60.0, 120.0, 180.0, 230.0)))
    sigma_m = {name: np.mean(edge.sigma_m) for name, edge in taught.edges.items()}
    loose = {"L_out_near_along", "R_out_near_along"}
    assert min(sigma_m[name] for name in loose) > 3.0 * max(s for name, s in sigma_m.items() if name not in loose)
    known, ratios, nees = arrays(taught), [], []
    for pose, opening_m, image in other_views(6, (60.0, 120.0, 180.0, 230.0), seed=4):
        found = measured(image, known, pose, opening_m)
        after, before = error(found, pose), error(measured(image, None, pose, opening_m), pose)
        ratios.append(np.linalg.norm(after[:3]) / np.linalg.norm(before[:3]))
        nees.append(after @ np.linalg.solve(found.covariance[:6, :6], after))
    assert np.median(ratios) < 0.15
    assert max(nees) < 22.5


def test_from_one_background_the_uncertainty_covers_others():
    known = arrays(taught_from(image_of(BEVEL_M, scene(180.0))))
    nees = []
    for pose, opening_m, image in other_views(4, (60.0, 230.0), seed=5):
        found = measured(image, known, pose, opening_m)
        after = error(found, pose)
        nees.append(after @ np.linalg.solve(found.covariance[:6, :6], after))
    assert max(nees) < 22.5


def test_what_was_taught_before_bright_tables_holds_before_a_dark_one():
    """Fingers of 25 to 85 grey levels: beside each outline the other side is the brighter one now."""
    taught = taught_from(*(image_of(0.0, scene(level)) for level in (180.0, 210.0, 235.0)))
    assert {taught.edges[name].brighter for name in OUTLINES} == {"any"}
    found = measured(image_of(0.0, scene(5.0)), arrays(taught), POSE)
    ids = box_gripper().edge_ids
    assert min(found.consensus.edge_share[ids.index(name)] for name in OUTLINES) > 0.8
    assert np.linalg.norm(error(found, POSE)[:3]) < 2e-5


# --- refused ---


def test_an_image_without_the_gripper_is_refused():
    empty = np.full((576, 768), 128, np.uint8)
    empty[::7] += 20
    said = r"^the gripper isn't found: only \d+ % of the straight outlines in view are seen as lines \(not .*; at"
    with pytest.raises(TeachingRefused, match=said):
        taught_from(empty)


@pytest.mark.parametrize("shift_mm", [(0.5, 0.0, 0.0), (0.0, -3.0, 2.0)])
def test_a_reference_that_is_off_is_refused_and_the_measured_pose_is_named(shift_mm: tuple[float, float, float]):
    """It stands in the text ready to be copied, and is the truth to some micrometres, some tens along the axis."""
    off = moved(POSE, np.array([*(1e-3 * np.array(shift_mm)), 0.0, 0.0, 0.0]))
    with pytest.raises(TeachingRefused, match="off the reference, by") as refused:
        taught_from(image_of(0.0), using=reference(off, 2e-5, 2e-4))
    named = re.search(r"translation_m: \[(.*?)\]", refused.value.notes[-1])
    assert named is not None
    away_m = np.abs(np.subtract([float(v) for v in named[1].split(",")], POSE[:3, 3]))
    assert away_m[:2].max() < 1e-5 and away_m[2] < 4e-5


@pytest.mark.parametrize(("shift_m", "bevel_m"), [((5e-4, 0.0, 0.0), BEVEL_M), ((0.0, -3e-3, 2e-3), 1e-4)])
def test_the_pose_that_is_named_states_what_bevels_do_to_it(shift_m: tuple[float, float, float], bevel_m: float):
    off = moved(POSE, np.array([*shift_m, 0.0, 0.0, 0.0]))
    with pytest.raises(TeachingRefused, match="off the reference, by") as refused:
        taught_from(image_of(bevel_m), using=reference(off, 2e-5, 2e-4))
    (note,) = refused.value.notes
    named = re.search(r"translation_m: \[(.*?)\].*position_sigma_m: (.*?), rotation_sigma_rad: (.*?)}", note)
    assert named is not None
    away_m = np.subtract([float(v) for v in named[1].split(",")], POSE[:3, 3])
    assert np.linalg.norm(away_m) < 3.0 * float(named[2]) and float(named[2]) > 1e-4


def test_a_wide_enough_standard_deviation_lets_the_reference_be_off():
    """A third of a millimetre: then it is by definition where the gripper stands."""
    off = moved(POSE, np.array([2e-4, -2e-4, 0.0, 0.0, 0.0, 0.0]))
    taught = taught_from(image_of(0.0), using=reference(off))
    found = measured(image_of(0.0), arrays(taught, off), off)
    assert np.linalg.norm(error(found, off)[:3]) < 5e-6


@pytest.mark.parametrize(("bevel_m", "shift_m"), [(0.0, 4e-4), (1e-4, -4e-4), (BEVEL_M, 0.0)])
def test_what_the_images_show_off_the_reference_is_in_every_bound(bevel_m: float, shift_m: float):
    """A mount that has moved along the optical axis since the calibration, less than the uncertainty due to bevels;
    bevels alone cost less than their width.
    """
    off = moved(POSE, np.array([0.0, 0.0, -shift_m, 0.0, 0.0, 0.0]))
    taught = taught_from(image_of(bevel_m), using=reference(off, 5e-5, 5e-4))
    offset_m = np.linalg.norm(taught.reference_offset[:3])
    assert taught.reference_offset[2] == pytest.approx(shift_m, abs=1.2 * bevel_m + 2e-5)
    edges = arrays(taught, off)
    bounds_m = [
        forecast_frame(RIG._replace(taught=known), off, OPENING_M).absolute.position_m
        for known in (replace(edges, reference_offset=np.zeros(6)), edges)
    ]
    assert bounds_m[1] - bounds_m[0] == pytest.approx(offset_m, rel=0.05)
    assert bounds_m[1] < RIG.settings.policy.alert_limit_m


def test_an_opening_that_the_image_contradicts_is_refused():
    with pytest.raises(
        TeachingRefused, match=r"shows a jaw opening of 0\.03(39|40)\d\d m, 0\.034900 m is reported; at most"
    ):
        taught_from(image_of(0.0), using=reference(None, 2e-5, 2e-4), opening_m=0.0349)


PLAY = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [1.2e-4, -0.6e-4, 0.5e-4, 1e-3, -1e-3, 0.0],
        [-1.2e-4, 0.6e-4, -0.5e-4, -1e-3, 1e-3, 0.0],
        [0.5e-4, 1.1e-4, 0.0, 0.0, 2e-3, 1e-3],
        [-0.5e-4, -1.1e-4, 0.0, 0.0, -2e-3, -1e-3],
    ]
)
"""(5, 6) m and rad: edges move by up to 1.4 px, as on real mounts; none on average."""


def with_some_play(bevel_m: float) -> list[np.ndarray]:
    levels = (150.0, 165.0, 180.0, 195.0, 210.0)
    return [image_of(bevel_m, scene(dn), moved(POSE, xi)) for dn, xi in zip(levels, PLAY, strict=True)]


def test_the_play_of_each_image_is_found_where_the_renderer_had_it():
    images = [TeachingImage(image, OPENING_M, f"{n}.png") for n, image in enumerate(with_some_play(BEVEL_M))]
    viewer = Viewer(RIG, reference(None, 1e-3, 1e-2), images)
    found, spread = with_play(viewer, [viewer.view(image, viewer.fitted(image)) for image in images])
    # Of five images: what one more deviates by, when its spread is known from these (Student).
    np.testing.assert_allclose(spread, PLAY.std(axis=0, ddof=1) * np.sqrt(4.0 / 2.0), rtol=0.1)
    corners_m = box_gripper().points_grip_m(OPENING_M)[box_gripper().corner_points]
    for image, truth in zip(found, PLAY, strict=True):
        seen, true = (
            CAMERA.project(corners_m @ p[:3, :3].T + p[:3, 3]) for p in (viewer.stands(image), moved(POSE, truth))
        )
        assert np.abs(seen - true).max() < 0.15


def test_images_with_play_teach_what_images_without_do():
    """None is left out, and the play is no scatter of the edges: with it each would count as 1 px uncertain."""
    using = reference(None, 1e-3, 1e-2)
    shaken = taught_from(*with_some_play(BEVEL_M), using=using)
    still = taught_from(*(image_of(BEVEL_M, scene(dn)) for dn in (150.0, 165.0, 180.0, 195.0, 210.0)), using=using)
    assert not shaken.left_out and set(shaken.edges) == set(still.edges)
    for name, edge in still.edges.items():
        off_px = PX_PER_M * (np.array(shaken.edges[name].offset_m) - edge.offset_m)
        assert np.abs(off_px).max() < 0.1
        assert max(shaken.edges[name].sigma_m) < 2.0 * max(edge.sigma_m) + 0.05 / PX_PER_M


def test_an_edge_that_lies_farther_beside_the_others_than_bevels_differ_is_named():
    """The reference is so uncertain that it isn't refused: a file whose outer border is 0.4 mm off."""
    model = msgspec.to_builtins(contents_of(box_gripper().model))
    for name, point in model["points"].items():
        if name in ("L_out_near", "L_out_near_back"):
            x, y, z = point["xyz_m"]
            point["xyz_m"] = (x + 4e-4, y, z)
    off = Gripper(msgspec.convert(model, type(box_gripper().model)))
    images = [TeachingImage(image_of(0.0, scene(dn)), OPENING_M, f"{dn}") for dn in (150.0, 165.0, 195.0, 210.0)]
    taught = teach(Rig(CAMERA, off, RIG.settings), reference(None, 1e-3, 1e-2), images)
    named = [note for note in taught.notes if "beside the other" in note]
    assert len(named) == 1 and named[0].startswith("L_out_near_along appears 0.3"), taught.notes
    assert not any("beside the other" in note for note in taught_from(image_of(0.0)).notes)


@pytest.mark.parametrize(("size_px", "play"), [(1.6, True), (2.6, False)])
def test_play_is_at_most_two_pixels(size_px: float, play: bool):
    """Half or twice the limit would decide otherwise."""
    far = image_of(0.0, None, moved(POSE, np.array([1.25 * size_px / PX_PER_M, 0.0, 0.0, 0.0, 0.0, 0.0])))
    others = [image_of(0.0, scene(dn)) for dn in (150.0, 165.0, 195.0, 210.0)]
    assert (4 not in taught_from(*others, far, using=reference(None, 1e-3, 1e-2)).left_out) == play


def test_images_between_which_the_camera_moved_are_refused():
    shifted = image_of(0.0, None, moved(POSE, np.array([6e-4, 0.0, 0.0, 0.0, 0.0, 0.0])))
    with pytest.raises(
        TeachingRefused, match=r"\d\.png: the gripper appears 2\.\d px from where it is in the other images; at most"
    ):
        taught_from(image_of(0.0), shifted, using=reference(None, 1e-3, 1e-2))


def test_an_image_that_contradicts_most_others_is_left_out():
    """What it would have added to the scatter, and to the mean, isn't there."""
    shifted = image_of(0.0, None, moved(POSE, np.array([4.2e-4, 0.0, 0.0, 0.0, 0.0, 0.0])))
    darker, brighter = image_of(0.0, scene(150.0)), image_of(0.0, scene(210.0))
    empty = np.full_like(darker, 128)
    using = reference(None, 1e-3, 1e-2)
    taught = taught_from(image_of(0.0), shifted, darker, empty, brighter, using=using)
    assert set(taught.left_out) == {1, 3} and taught.used("abcde") == ["a", "c", "e"]
    assert re.match(r"1\.png: the gripper appears \d\.\d px from where it is in the other images", taught.left_out[1])
    assert "3.png: measured with the taught edges the gripper isn't found" in taught.left_out[3]
    alone = taught_from(image_of(0.0), darker, brighter, using=using)
    assert taught.edges == alone.edges and not alone.left_out


def test_images_of_which_half_contradict_the_others_are_refused():
    away = [moved(POSE, np.array([x, 0.0, 0.0, 0.0, 0.0, 0.0])) for x in (4e-4, 8e-4)]
    images = [image_of(0.0), image_of(0.0, scene(150.0)), *(image_of(0.0, None, pose) for pose in away)]
    with pytest.raises(TeachingRefused, match=r"^\d\.png: the gripper appears .* left out before: 1 image$") as refused:
        taught_from(*images, using=reference(None, 1e-3, 1e-2))
    assert re.match(r"left out: \d\.png: the gripper appears", refused.value.notes[0]) and len(str(refused.value)) < 300


def test_images_of_which_half_have_another_jaw_opening_are_refused_as_that():
    """It was "finger left isn't seen", or that the gripper isn't found in one of them."""
    levels = (150.0, 180.0, 210.0)
    images = [image_of(0.0, scene(dn, opening_m)) for opening_m in (OPENING_M, OPENING_M + 0.01) for dn in levels]
    with pytest.raises(TeachingRefused, match=r"^3 of 6 images \(3\.png to 5\.png\) don't show the gripper") as refused:
        taught_from(*images)
    assert "the jaws or the camera stood elsewhere in them" in str(refused.value)
    assert "each image with its own jaw opening (jaw_opening_m in timestamps.csv" in str(refused.value)


def test_a_half_hidden_gripper_is_refused():
    image = image_of(0.0).copy()
    image[:, :430] = 128
    with pytest.raises(TeachingRefused, match=r"the straight outlines|finger left isn't seen"):
        taught_from(image)


def test_an_outline_that_something_hides_is_expected_where_the_others_put_it():
    image = image_of(0.0).copy()
    u, v = CAMERA.project(box_gripper().points_grip_m(None)[[0, 1]] @ POSE[:3, :3].T + POSE[:3, 3])[:2].mean(axis=0)
    image[int(v) - 45 : int(v) + 45, int(u) - 12 : int(u) + 60] = 128
    taught = taught_from(image)
    hidden = taught.edges["L_tip_in"]
    assert hidden.seen == 0.0 and {name for name, edge in taught.edges.items() if edge.seen == 0.0} == {"L_tip_in"}
    assert PX_PER_M * np.abs(hidden.offset_m).max() < 0.1
    found = measured(image_of(0.0), arrays(taught), POSE)
    assert found.consensus.edge_seen[box_gripper().edge_ids.index("L_tip_in")]


def test_a_crease_that_something_hides_is_not_taught_and_why_is_said():
    image = image_of(0.0).copy()
    points = box_gripper().points_grip_m(None)[[0, 4]]
    uv = CAMERA.project(
        (points[0] + np.linspace(0.0, 0.9, 300)[:, None] * (points[1] - points[0])) @ POSE[:3, :3].T + POSE[:3, 3]
    )
    for u, v in uv:
        image[round(v) : round(v) + 3, round(u) - 5 : round(u) + 6] = 60
    taught = taught_from(image)
    assert set(taught.untaught) == {"L_in_near_along"} and "L_in_near_along" not in taught.edges
    assert re.search("no line|visible along", taught.untaught["L_in_near_along"])
    found = measured(image_of(0.0), arrays(taught), POSE)
    assert box_gripper().edge_ids.index("L_in_near_along") not in found.prediction.layout.edges


def test_a_line_beside_an_outline_in_a_single_image_is_said():
    """A stripe on the table that runs along a finger, three pixels off."""
    image = image_of(0.0).copy()
    gripper = box_gripper()
    ends = gripper.points_grip_m(None)[gripper.edge_points[gripper.edge_ids.index("R_out_near_along")]]
    uv = CAMERA.project(
        (ends[0] + np.linspace(0.0, 1.0, 400)[:, None] * (ends[1] - ends[0])) @ POSE[:3, :3].T + POSE[:3, 3]
    )
    for u, v in uv[np.isfinite(uv).all(axis=1)]:
        if 0 < v < 575:
            image[round(v), round(u) + 4 : round(u) + 40] = 40
    taught = taught_from(image)
    assert (
        len(taught.notes) == 1 and "R_out_near_along" in taught.notes[0] and "different backgrounds" in taught.notes[0]
    )
