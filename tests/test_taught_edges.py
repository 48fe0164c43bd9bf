"""What was taught, in use: predicted samples, widths, layouts; and the statistics behind it, by sampling."""

from __future__ import annotations

import numpy as np
import pytest
from support.meters import box_gripper, moved
from support.simulated import nominal_cam_T_grip
from support.taught_scenes import CAMERA, OPENING_M, arrays, bevelled, image_of, measured, taught_from

from gripmon.model.geometry import invert
from gripmon.simulate.solids import finger_solids
from gripmon.teach.lines import EdgePoints, find_line, pool, slopes
from gripmon.track.edges.prediction import Prediction, lay_out, predict
from gripmon.track.edges.profiles import profile_offsets_px
from gripmon.track.edges.settings import SamplingSettings
from gripmon.track.edges.taught import TaughtEdge, TaughtEdges, sight_axes

POSE = nominal_cam_T_grip()
GRIPPER = box_gripper()
OFFSETS_PX = profile_offsets_px(7.0)
EDGE = GRIPPER.edge_ids.index("L_tip_near")


def taught_edge(**values: object) -> TaughtEdge:
    plain = {"share": (0.1, 0.9), "offset_m": (1e-4, 2e-4), "sigma_m": (1e-6, 1e-6), "crease": False}
    return TaughtEdge(**{**plain, **values})  # type: ignore[arg-type]


def predicted(edges: dict[str, TaughtEdge] | None, pose: np.ndarray, opening_m: float = OPENING_M) -> Prediction:
    taught = None if edges is None else TaughtEdges.of(edges, GRIPPER, POSE, OPENING_M)
    layout = lay_out(CAMERA, GRIPPER, pose, opening_m, SamplingSettings(), taught)
    return predict(CAMERA, GRIPPER, layout, pose, opening_m, OFFSETS_PX, True, taught)


@pytest.mark.parametrize("turn_rad", [(0.0, 0.0, 0.0), (0.03, -0.02, 0.2), (-0.02, 0.05, -0.1)])
def test_samples_lie_where_the_shifted_edge_projects(turn_rad: tuple[float, float, float]):
    """The edge moved as a line in space by offset and depth, and projected by the camera."""
    pose = moved(POSE, np.array([1e-3, -2e-3, 4e-3, *turn_rad]))
    found = predicted({"L_tip_near": taught_edge(depth_m=3e-4)}, pose)
    points = GRIPPER.points_grip_m(OPENING_M)
    start, end = points[GRIPPER.edge_points[EDGE]]
    sight, along = start - invert(POSE)[:3, 3], end - start
    across = np.cross(sight, along) / np.linalg.norm(np.cross(sight, along))
    depth = np.cross(along, across) / np.linalg.norm(along)
    mine = found.layout.edge == EDGE
    fraction = found.layout.fraction[mine, None]
    offset_m = 1e-4 + (fraction - 0.1) / 0.8 * 1e-4
    shifted = start + fraction * along + offset_m * across + 3e-4 * depth
    expected_px = CAMERA.project(shifted @ pose[:3, :3].T + pose[:3, 3])
    away_px = np.einsum("ni,ni->n", found.uv_px[mine] - expected_px, found.normal[mine])
    assert np.abs(away_px).max() < 0.02, "but for what one pixel more or less changes in the scale"
    plain = CAMERA.project((start + fraction * along) @ pose[:3, :3].T + pose[:3, 3])
    assert np.abs(np.einsum("ni,ni->n", found.uv_px[mine] - plain, found.normal[mine])).min() > 0.7


def test_what_is_measured_from_a_taught_line_is_the_models_own_motion():
    """Jacobian, lines and corners are the sharp model's, whatever was taught."""
    edges = {name: taught_edge() for name in ("L_tip_near", "L_tip_in", "R_tip_near")}
    nothing = {name: taught_edge(offset_m=(0.0, 0.0)) for name in edges}
    found, plain = predicted(edges, POSE), predicted(nothing, POSE)
    np.testing.assert_array_equal(found.jacobian, plain.jacobian)
    np.testing.assert_array_equal(found.line_origin, plain.line_origin)
    np.testing.assert_array_equal(found.corners.uv_px, plain.corners.uv_px)
    assert np.abs(found.uv_px - plain.uv_px).max() > 0.5


def test_taught_creases_and_shifts_are_used_while_they_show_as_taught():
    crease, outline = "L_in_near_along", "R_tip_in"
    edges = {crease: taught_edge(crease=True), outline: taught_edge()}
    otherwise = {crease: taught_edge(), outline: taught_edge(crease=True)}
    found, other, plain = (predicted(e, POSE) for e in (edges, otherwise, None))
    used = [{GRIPPER.edge_ids[e] for e in p.layout.edges} for p in (found, other, plain)]
    assert used[0] == {*used[2], crease} and used[1] == used[2] and crease not in used[2]
    index = GRIPPER.edge_ids.index(outline)
    assert np.abs(found.uv_px[found.layout.edge == index][0] - other.uv_px[other.layout.edge == index][0]).max() > 0.5
    np.testing.assert_array_equal(other.uv_px, plain.uv_px)


def test_edges_that_were_not_taught_may_lie_as_far_off_as_those_that_were():
    found = predicted({"L_tip_near": taught_edge(offset_m=(1e-4, 2e-4))}, POSE)
    usual_m = np.sqrt(0.5 * (1.0 + 4.0)) * 1e-4
    other = GRIPPER.edge_ids.index("R_tip_in")
    assert found.edge_spread_m[other] == pytest.approx(usual_m) and found.edge_spread_m[EDGE] < 2e-6
    unseen = taught_edge(offset_m=(1e-3, 1e-3), seen=0.0)  # where the others have it, by how much doesn't count
    inner = taught_edge(offset_m=(5e-4, 5e-4), crease=True)  # inner edges lie farther off than outlines
    known = {"L_tip_near": taught_edge(offset_m=(1e-4, 2e-4)), "L_tip_in": unseen, "L_in_near_along": inner}
    again = predicted(known, POSE)
    assert again.edge_spread_m[other] == pytest.approx(usual_m)


def test_the_width_is_what_teaching_left():
    """At the reference the standard deviation, and as the line of sight turns the more of the depth's."""
    edges = {"L_tip_near": taught_edge(sigma_m=(3e-6, 4e-6), depth_sigma_m=2e-4)}
    taught = TaughtEdges.of(edges, GRIPPER, POSE, OPENING_M)
    points = GRIPPER.points_grip_m(OPENING_M)
    still = taught.spread_m(GRIPPER, points, POSE)[EDGE]
    assert still == pytest.approx(np.sqrt(0.5 * (9.0 + 16.0)) * 1e-6)
    start = points[GRIPPER.edge_points[EDGE, 0]] @ POSE[:3, :3].T + POSE[:3, 3]
    turn = np.array([0.05, 0.0, 0.0])  # about the camera's x axis, to which the edge is all but parallel
    turned = moved(POSE, np.array([0.0] * 3 + turn.tolist()))
    turned[:3, 3] += start - (points[GRIPPER.edge_points[EDGE, 0]] @ turned[:3, :3].T + turned[:3, 3])
    assert taught.spread_m(GRIPPER, points, turned)[EDGE] == pytest.approx(np.hypot(still, 0.05 * 2e-4), rel=0.05)
    np.testing.assert_allclose(predicted(edges, turned).edge_spread_m[EDGE], np.hypot(still, 1e-5), rtol=0.05)
    np.testing.assert_allclose(predicted(None, POSE).edge_spread_m, GRIPPER.edge_bevel_m / np.sqrt(12.0))


def test_taught_polarity_fills_in_where_the_gripper_file_says_any():
    image = image_of(0.0)
    taught = taught_from(image)
    wrong = {"left": "right", "right": "left"}
    edges = {}
    for name, edge in taught.edges.items():
        values = {field: getattr(edge, field) for field in edge.__struct_fields__}
        edges[name] = TaughtEdge(**{**values, "brighter": wrong.get(edge.brighter, "any")})
    good = measured(image, arrays(taught), POSE)
    bad = measured(image, TaughtEdges.of(edges, GRIPPER, POSE, OPENING_M), POSE)
    crease = GRIPPER.edge_ids.index("L_in_near_along")
    assert good.consensus.edge_seen[crease] and not bad.consensus.edge_seen[crease]


def test_slopes_are_those_of_a_cut_edge():
    """The depth of the rims of the renderer's bevelled solid for each metre that they lie to the side."""
    width_m = 4e-4
    points = GRIPPER.points_grip_m(OPENING_M)
    axes = sight_axes(GRIPPER, points, POSE)
    crease = GRIPPER.edge_view(points, invert(POSE)[:3, 3]).crease
    solids, eye = finger_solids(bevelled(width_m)), invert(POSE)[:3, 3]
    checked = 0
    for edge in np.flatnonzero(GRIPPER.edge_view(points, eye).visible):
        start, end = points[GRIPPER.edge_points[edge]]
        along = (end - start) / np.linalg.norm(end - start)
        vertices = solids[GRIPPER.edge_finger[edge]].vertices_m
        beside = vertices[np.linalg.norm(np.cross(vertices - start, along), axis=1) < 1.5 * width_m]
        across, depth = (beside - eye) @ axes[0][edge], (beside - start) @ axes[1][edge]
        rim = int(np.argmin(np.abs(across)))
        if crease[edge] or abs(depth[rim] / across[rim]) > 4.9:
            continue
        offset_m = np.zeros(len(GRIPPER.edge_ids))
        offset_m[edge] = across[rim]
        assert slopes(GRIPPER, points, crease, axes, offset_m)[edge] == pytest.approx(depth[rim] / across[rim], rel=0.1)
        assert np.isnan(slopes(GRIPPER, points, crease, axes, -offset_m)[edge]), "no bevel lies outside"
        checked += 1
    assert checked >= 4


# --- all edges together ---

NOISE_M2 = np.tile((5e-6) ** 2 * np.eye(2), (12, 1, 1))
ROWS = np.random.default_rng(0).normal(size=(12, 2, 3))
KIND = np.zeros(12, dtype=np.intp)


def test_what_edges_have_of_their_own_is_kept():
    rng = np.random.default_rng(2)
    own_m = rng.normal(0.0, 1e-4, (12, 1)) + np.zeros((12, 2))
    pooled = pool(own_m, NOISE_M2, ROWS, KIND, np.eye(3) * 1e-6**2)
    np.testing.assert_allclose(pooled.ends_m, own_m, atol=3e-6)
    assert pooled.usual_own_m[0] == pytest.approx(1e-4, rel=0.5)


@pytest.mark.parametrize("own_m", [0.0, 5e-6, 5e-5])
def test_the_claimed_covariance_is_that_of_the_errors(own_m: float):
    """Edges with offsets of their own, a common motion, noise; errors in units of the claimed deviations."""
    rng, squares = np.random.default_rng(3), []
    for _ in range(60):
        shape = rng.multivariate_normal([0.0, 0.0], own_m**2 * np.array([[1.0, 0.5], [0.5, 1.0]]), 12)
        truth = ROWS @ rng.normal(0.0, 1e-4, 3) + shape
        pooled = pool(truth + rng.normal(0.0, 5e-6, (12, 2)), NOISE_M2, ROWS, KIND, np.eye(3) * 1e-4**2)
        wrong = pooled.ends_m - truth
        squares.append(np.mean(np.einsum("ei,eij,ej->e", wrong, np.linalg.inv(pooled.covariance_m2), wrong)))
    assert 1.0 < np.mean(squares) < 3.0, "two by the number of ends; less where estimating that there is nothing stops"


# --- one edge's line ---


def points_on(lines: list[tuple[float, float, float]], rng: np.random.Generator, profiles: int = 60) -> EdgePoints:
    """Edge points of one image: a stray in every profile, and lines (offset at both ends, part of the profiles)."""
    way = np.linspace(0.0, 1.0, profiles)
    parts = [(way, rng.uniform(-4.5, 4.5, profiles), np.arange(profiles))]
    for start_px, end_px, share in lines:
        shown = rng.random(profiles) < share
        offset_px = start_px + (end_px - start_px) * way + rng.normal(0.0, 0.05, profiles)
        parts.append((way[shown], offset_px[shown], np.arange(profiles)[shown]))
    way, offset_px, profile = (np.concatenate(part) for part in zip(*parts, strict=True))
    none = np.zeros(len(way), dtype=np.intp)
    return EdgePoints(way, offset_px, np.ones(len(way)), profile, none, np.array([profiles]))


def test_of_two_lines_the_expected_one_is_taken_and_the_other_named():
    points = points_on([(0.3, 0.2, 0.9), (3.2, 3.1, 0.95)], np.random.default_rng(5))
    near, far = find_line(points, np.zeros(2), 4.0), find_line(points, np.full(2, 3.0), 4.0)
    assert near is not None and far is not None
    np.testing.assert_allclose(near.ends_px, [0.3, 0.2], atol=0.08)
    np.testing.assert_allclose(far.ends_px, [3.2, 3.1], atol=0.08)
    assert near.rival_px == pytest.approx(2.9, abs=0.5) and far.rival_px == pytest.approx(-2.9, abs=0.5)
