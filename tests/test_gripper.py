"""The gripper model: jaw motion, visibility against rays through boxes, polarity, order."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial import ConvexHull
from support.box_models import Model, cube_model, two_fingers_model
from support.grippers import gripper_from_dict

from gripmon.cli import main
from gripmon.daemon.config import builtin_config, read_gripper
from gripmon.model.gripper import Gripper
from gripmon.simulate.solids import finger_solids

SHIPPED = sorted((Path(__file__).parent.parent / "configs" / "grippers").glob("*.yaml"))


# --- jaw motion ---


def test_an_axis_moves_its_finger_in_proportion_to_the_opening():
    gripper = gripper_from_dict(two_fingers_model())
    left = np.array([name.startswith("left") for name in gripper.point_ids])
    at_rest = np.array([p["xyz_m"] for p in two_fingers_model()["points"].values()])
    np.testing.assert_array_equal(gripper.points_grip_m(), at_rest)
    for opening_m in (0.01, 0.017, 0.03, 0.05):
        moved = gripper.points_grip_m(opening_m) - at_rest
        np.testing.assert_allclose(moved[left], np.tile([-0.5 * (opening_m - 0.03), 0.0, 0.0], (8, 1)), atol=1e-15)


def test_a_table_moves_its_finger_between_its_rows_and_changes_its_depth():
    gripper = gripper_from_dict(two_fingers_model())
    right = np.array([name.startswith("right") for name in gripper.point_ids])
    at_rest = gripper.points_grip_m()[right]
    for opening_m, expected in (
        (0.01, [-0.010, 0.0, 0.002]),
        (0.015, [-0.0075, 0.0, 0.0015]),  # a quarter of the way from the first row to the second
        (0.03, [0.0, 0.0, 0.0]),
        (0.045, [0.0075, 0.0, -0.003]),
        (0.05, [0.010, 0.0, -0.004]),
    ):
        np.testing.assert_allclose(
            gripper.points_grip_m(opening_m)[right] - at_rest, np.tile(expected, (8, 1)), atol=1e-15
        )


@pytest.mark.parametrize("opening_m", [0.013, 0.022, 0.034, 0.048])
def test_point_motion_is_the_derivative_by_the_opening(opening_m: float):
    gripper = gripper_from_dict(two_fingers_model())
    step_m = 1e-6
    ahead, behind = gripper.points_grip_m(opening_m + step_m), gripper.points_grip_m(opening_m - step_m)
    np.testing.assert_allclose(gripper.point_motion(opening_m), (ahead - behind) / (2 * step_m), atol=1e-8)
    assert np.abs(gripper.point_motion(opening_m)).max() == pytest.approx(0.5)


def test_point_motion_is_one_sided_at_the_ends_of_the_jaw_and_nothing_without_a_jaw():
    gripper = gripper_from_dict(two_fingers_model())
    right = gripper.point_ids.index("right_000")
    np.testing.assert_allclose(gripper.point_motion(0.01)[right], [0.5, 0.0, -0.1], atol=1e-9)
    np.testing.assert_allclose(gripper.point_motion(0.05)[right], [0.5, 0.0, -0.2], atol=1e-9)
    assert not gripper_from_dict(cube_model()).point_motion(0.0).any()


@pytest.mark.parametrize("opening_m", [0.0099, 0.0501, float("nan")])
def test_an_opening_beyond_the_jaw_has_no_points(opening_m: float):
    gripper = gripper_from_dict(two_fingers_model())
    with pytest.raises(ValueError, match=r"outside 0\.01 to 0\.05 m"):
        gripper.points_grip_m(opening_m)


def test_without_a_jaw_any_reported_opening_leaves_the_points_alone():
    gripper = gripper_from_dict(cube_model())
    assert not gripper.has_jaw
    np.testing.assert_array_equal(gripper.points_grip_m(0.03), gripper.points_grip_m())


# --- visibility, against rays through solid boxes ---


def _seen(eye: np.ndarray, target: np.ndarray, low: np.ndarray, high: np.ndarray) -> bool:
    """Whether the straight way from the eye to a point on a box's surface stays out of that box (slab method)."""
    way = target - eye
    with np.errstate(divide="ignore"):
        enter, leave = (low - eye) / way, (high - eye) / way
    first, last = np.minimum(enter, leave).max(), np.maximum(enter, leave).min()
    return not (min(last, 1.0) - first > 1e-9)


def _inward(box: np.ndarray, edge_middle: np.ndarray) -> list[np.ndarray]:
    """The two steps from the middle of a box's edge onto its two faces."""
    low, high = box
    steps = []
    for axis in range(3):
        at_low, at_high = np.isclose(edge_middle[axis], low[axis]), np.isclose(edge_middle[axis], high[axis])
        if at_low or at_high:
            step = np.zeros(3)
            step[axis] = 1e-5 if at_low else -1e-5
            steps.append(step)
    assert len(steps) == 2
    return steps


def _box_of(gripper: Gripper, finger: int, points: np.ndarray) -> np.ndarray:
    own = points[gripper.point_finger == finger]
    return np.stack([own.min(axis=0), own.max(axis=0)])


@pytest.mark.parametrize(
    ("model", "openings_m"),
    [(cube_model(), [None]), (two_fingers_model(), [0.01, 0.03, 0.05])],
    ids=["cube", "fingers"],
)
def test_visible_edges_creases_and_corners_are_those_that_rays_find(model: Model, openings_m: list[float | None]):
    gripper = gripper_from_dict(model)
    rng = np.random.default_rng(3)
    counts = np.zeros(3, dtype=int)  # hidden edges, outlines, creases
    for trial in range(120):
        points = gripper.points_grip_m(openings_m[trial % len(openings_m)])
        eye = rng.normal(size=3)
        eye *= rng.uniform(0.08, 0.3) / np.linalg.norm(eye)
        view, corners = gripper.edge_view(points, eye), gripper.corners_visible(points, eye)
        for edge, (start, end) in enumerate(gripper.edge_points):
            box = _box_of(gripper, gripper.edge_finger[edge], points)
            if np.abs(box - eye).min() < 1e-3:
                continue  # A face seen from its own plane is neither here nor there.
            middle = 0.5 * (points[start] + points[end])
            steps = _inward(box, middle)
            # Onto a face a little: that point is seen exactly if the face is.
            faces_seen = [_seen(eye, middle + step, *box) for step in steps]
            counts[sum(faces_seen)] += 1
            assert view.visible[edge] == any(faces_seen)
            assert view.crease[edge] == all(faces_seen)
            inside = view.inside_point_m[edge]
            assert np.isfinite(inside).all() == (sum(faces_seen) == 1)
            if sum(faces_seen) == 1:
                # The point lies on that face of the edge which is seen, inside its outline.
                onto, beside = steps[faces_seen.index(True)], steps[faces_seen.index(False)]
                assert (inside - middle) @ onto > 0.0
                assert abs((inside - middle) @ beside) < 1e-12
                assert (box[0] - 1e-12 <= inside).all() and (inside <= box[1] + 1e-12).all()
        for corner, point in enumerate(gripper.corner_points):
            box = _box_of(gripper, gripper.point_finger[point], points)
            if np.abs(box - eye).min() >= 1e-3:
                assert corners[corner] == _seen(eye, points[point], *box)
    assert (counts > 150).all(), "all three kinds occurred"


def test_a_skewed_face_is_the_triangles_of_the_convex_solid():
    """Against the convex hull, whose facets know nothing of the file's faces."""
    rng = np.random.default_rng(4)
    for name in ("cube_000", "cube_101", "cube_110"):
        model = cube_model()
        point = model["points"][name]
        # Outwards, across two of its faces: their solid stays convex with the right one of both cuts.
        point["xyz_m"] = [1.15 * v if axis else v for axis, v in enumerate(point["xyz_m"])]
        gripper = gripper_from_dict(model)
        points = gripper.points_grip_m()
        assert len(gripper.faces) == 8 and len(gripper.notes) == 2
        assert all(" mm off a plane: taken as 2 triangles" in note for note in gripper.notes)
        (solid,) = finger_solids(gripper)  # which refuses what isn't closed, flat and convex
        assert len(solid.loops) == 8
        hull = ConvexHull(points)
        for eye in rng.normal(0.0, 0.1, (60, 3)):
            height = hull.equations[:, :3] @ eye + hull.equations[:, 3]
            if np.abs(height).min() < 1e-4 or (height < 0.0).all():
                continue
            seen = [
                any(height[k] > 0.0 for k, facet in enumerate(hull.simplices) if {start, end} <= set(facet))
                for start, end in gripper.edge_points
            ]
            np.testing.assert_array_equal(gripper.edge_view(points, eye).visible, seen)


def test_check_says_which_faces_are_skewed(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    values = yaml.safe_load(SHIPPED[1].read_text())
    name = values["faces"][0]["points"][0]
    values["points"][name]["xyz_m"][0] += 0.003
    (tmp_path / "gripper.yaml").write_text(yaml.safe_dump(values, sort_keys=False))
    demo = yaml.safe_load(builtin_config("demo.yaml").read_text())
    (tmp_path / "config.yaml").write_text(yaml.safe_dump({**demo, "gripper": "gripper.yaml"}, sort_keys=False))
    assert main(["check", str(tmp_path / "config.yaml"), "--verbose"]) == 0
    assert " mm off a plane: taken as 2 triangles; if it is flat, one of its points is wrong" in capsys.readouterr().out


def test_edges_without_faces_are_visible_and_of_the_kind_that_the_file_says():
    model = cube_model()
    model.pop("faces")
    names = list(model["edges"])
    model["edges"][names[4]]["kind"] = "crease"
    gripper = gripper_from_dict(model)
    view = gripper.edge_view(gripper.points_grip_m(), np.array([0.0, 0.0, 0.2]))
    assert view.visible.all()
    assert np.flatnonzero(view.crease).tolist() == [4]
    assert np.isnan(view.inside_point_m).all()
    assert gripper.corners_visible(gripper.points_grip_m(), np.array([0.0, 0.0, 0.2])).all()


def test_an_edge_with_one_face_is_seen_with_that_face():
    model = cube_model()
    top = next(f for f in model["faces"] if all(name.endswith("1") for name in f["points"]))
    model["faces"] = [top]
    gripper = gripper_from_dict(model)
    points = gripper.points_grip_m()
    edge = gripper.edge_ids.index("cube_001-cube_011")
    assert gripper.edge_view(points, np.array([0.01, 0.0, 0.2])).visible[edge]
    assert not gripper.edge_view(points, np.array([0.01, 0.0, -0.2])).visible[edge]
    assert not gripper.edge_view(points, np.array([0.01, 0.0, 0.2])).crease[edge]


def test_a_face_may_begin_with_points_on_a_straight_line():
    model = cube_model()
    top = next(f for f in model["faces"] if all(name.endswith("1") for name in f["points"]))
    first, second = (model["points"][name]["xyz_m"] for name in top["points"][:2])
    middle = [0.5 * (a + b) for a, b in zip(first, second, strict=True)]
    model["points"]["between"] = {"finger": "cube", "xyz_m": middle}
    plain = gripper_from_dict(cube_model())
    top["points"].insert(1, "between")
    gripper = gripper_from_dict(model)
    rng = np.random.default_rng(5)
    for eye in rng.normal(size=(40, 3)):
        np.testing.assert_array_equal(
            gripper.edge_view(gripper.points_grip_m(), eye).visible, plain.edge_view(plain.points_grip_m(), eye).visible
        )


# --- polarity, adjacency ---


def test_polarity_counts_the_right_hand_of_somebody_walking_the_edge_as_positive():
    model = cube_model()
    names = list(model["edges"])
    for name, brighter in zip(names, ("left", "right", "any"), strict=False):
        model["edges"][name]["brighter"] = brighter
    assert gripper_from_dict(model).edge_polarity.tolist() == [-1, 1, 0] + [0] * 9


@pytest.mark.parametrize("path", SHIPPED, ids=lambda p: p.stem)
def test_shipped_files_keep_their_order_and_their_bevels(path: Path):
    written = yaml.safe_load(path.read_text())
    gripper = read_gripper(path)
    assert gripper.point_ids == tuple(written["points"])
    assert gripper.edge_ids == tuple(written["edges"])
    assert gripper.corner_ids == tuple(n for n, p in written["points"].items() if p.get("corner"))
    np.testing.assert_array_equal(gripper.edge_bevel_m, [e.get("bevel_m", 0.0) for e in written["edges"].values()])
    named = [(gripper.point_ids[i], gripper.point_ids[j]) for i, j in gripper.edge_points]
    assert named == [(e["from"], e["to"]) for e in written["edges"].values()]


def test_an_inferred_gripper_keeps_where_it_comes_from(tmp_path: Path):
    """A provenance's time is written without quotes, and is text all the same."""
    model = yaml.safe_load(SHIPPED[0].read_text())
    at = "2026-03-01T10:20:30+00:00"
    origin = {"gripmon": "1", "time": "AT", "command": "gripmon calibrate plane", "versions": {}, "inputs": []}
    path = tmp_path / "inferred.yaml"
    path.write_text(yaml.safe_dump(model | {"provenance": origin}).replace("AT", at))
    provenance = read_gripper(path).model.provenance
    assert provenance is not None and provenance.time == at
