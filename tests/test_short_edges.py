"""Edges of 8 to 16 px: what is sampled of them, what that is worth, and what a monitor makes of tips made of them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import ndtr
from support.meters import box_gripper, measure, meter
from support.simulated import PAPER_LENS, nominal_cam_T_grip, plain_scenario
from support.watched import pose_of, reference_of, watch

from gripmon.model.camera import make_camera
from gripmon.model.geometry import perturbation_between
from gripmon.model.gripper import Gripper
from gripmon.model.records import Verdict
from gripmon.monitor import Monitor, MonitorSettings
from gripmon.simulate import Scenario, make_scenario, paper_rig
from gripmon.simulate.scenario import FingerLook, FingerMark, ObjectLook, Prop
from gripmon.track.edges import prediction_kernel
from gripmon.track.edges.prediction import BORDER_PX, ROWS, independent_part, lay_out
from gripmon.track.edges.profiles import find_candidates, profile_offsets_px, read_profiles
from gripmon.track.edges.roles import along_fingers
from gripmon.track.edges.settings import EdgeSettings, SamplingSettings
from gripmon.track.look import FingerStrips
from gripmon.track.look.strips import FIRST_FRAMES

pytestmark = pytest.mark.usefixtures("tools_importable")

MARGIN_PX = SamplingSettings().end_margin_px


def fingers(tip: str) -> tuple[Gripper, Gripper]:
    """Straight edges of 8 to 13 px at the tips, and the solids that the simulator draws: half round, of facets of some
    1.4 mm; or narrow, three facets of 1.45 mm.
    """
    from benchmarks.rounded import facetted_m, facetted_model, outline_m, solids

    outline = outline_m(0.010, 0.005, 1.4e-3) if tip == "half round" else facetted_m(1.45e-3)
    return facetted_model(outline), solids(outline)


TIPS = ["half round", "three facets"]


# --- what is sampled, and what that is worth ---


def test_edges_of_eight_pixels_and_more_have_the_profiles_that_they_need_to_be_seen():
    model, _ = fingers("half round")
    camera, pose = make_camera(PAPER_LENS), nominal_cam_T_grip()
    layout = lay_out(camera, model, pose, model.jaw_nominal_m, SamplingSettings())
    counts = np.bincount(layout.edge, minlength=len(model.edge_ids))
    points_px = camera.project(model.points_grip_m() @ pose[:3, :3].T + pose[:3, 3])
    length_px = np.linalg.norm(np.diff(points_px[model.edge_points], axis=1)[:, 0], axis=1)
    short = length_px < 16.0
    assert np.count_nonzero(short & (length_px > 8.0)) >= 14
    assert (counts[short & (length_px > 8.0)] >= 5).all() and not counts[length_px < 7.9].any()
    assert (counts[short] <= length_px[short] - MARGIN_PX + 1.0).all(), "no closer than a pixel"


@pytest.mark.parametrize("turn_rad", [0.0, 0.5])
def test_an_edge_that_the_border_cuts_is_sampled_up_to_it(turn_rad: float):
    """As far as whole search lines lie in the image, by a dense walk along the edge; no margin is left at the cut."""
    camera, model, settings = make_camera(PAPER_LENS), box_gripper(), SamplingSettings()
    pose = nominal_cam_T_grip()
    pose[:3, :3] = Rotation.from_rotvec([0.0, 0.0, turn_rad]).as_matrix() @ pose[:3, :3]
    tips_px = camera.project(model.points_grip_m()[model.corner_points] @ pose[:3, :3].T + pose[:3, 3])
    pose[1, 3] += (camera.height_px - 40.0 - tips_px[:, 1].max()) * pose[2, 3] / camera.fy_px
    layout = lay_out(camera, model, pose, model.jaw_nominal_m, settings)
    last_px, cut = np.array([camera.width_px - 1.0, camera.height_px - 1.0]), 0
    for edge in layout.edges.tolist():
        ends_m = model.points_grip_m()[model.edge_points[edge]] @ pose[:3, :3].T + pose[:3, 3]
        dense = np.linspace(0.0, 1.0, 4001)
        uv_px = camera.project(ends_m[0] + dense[:, None] * (ends_m[1] - ends_m[0]))
        way = np.gradient(uv_px, axis=0)
        to_px = settings.reach_px * way[:, ::-1] * (-1.0, 1.0) / np.linalg.norm(way, axis=1)[:, None]
        whole = np.all(
            [
                ((uv + 1e-9 >= BORDER_PX) & (uv <= last_px - BORDER_PX)).all(axis=1)
                for uv in (uv_px - to_px, uv_px + to_px)
            ],
            axis=0,
        )
        at = layout.fraction[layout.edge == edge]
        for end, sampled in ((0, at.min()), (-1, at.max())):
            if not whole[end]:
                border = dense[whole][end]
                left_px = abs(sampled - border) * np.linalg.norm(np.diff(uv_px, axis=0), axis=1).sum()
                assert left_px < 0.1
                cut += 1
    assert cut >= 3


@pytest.mark.parametrize(("length_px", "count"), [(4.0, 5), (8.0, 9), (16.0, 6)])
def test_the_mean_of_profiles_that_share_pixels_scatters_as_if_they_were_fewer(length_px: float, count: int):
    """Noise of 4 grey levels on a step of 40; without noise they would all be the same."""
    rng = np.random.default_rng(3)
    offsets_px, noise_dn = profile_offsets_px(7.0), 4.0
    v, u = np.mgrid[0:48, 0:48].astype(float)
    means, singles = [], []
    for _ in range(700):
        angle = rng.uniform(0.0, 2.0 * np.pi)
        normal, middle = np.array([np.cos(angle), np.sin(angle)]), 23.5 + rng.uniform(-0.5, 0.5, 2)
        away_px = (u - middle[0]) * normal[0] + (v - middle[1]) * normal[1]
        image = (80.0 + 40.0 * ndtr(away_px / 0.6) + rng.normal(0.0, noise_dn, u.shape)).astype(np.float32) / 255.0
        along_px = np.linspace(-0.5 * length_px, 0.5 * length_px, count)
        uv_px = middle + along_px[:, None] * np.array([normal[1], -normal[0]])
        rows_px = np.arange(-1, 2).astype(np.float32)
        assert len(rows_px) == ROWS
        maps = prediction_kernel.maps(uv_px, np.tile(normal, (count, 1)), offsets_px.astype(np.float32), rows_px)
        profiles, noise = read_profiles(image, *maps), noise_dn / 255.0 / np.sqrt(ROWS)
        found = find_candidates(profiles, np.ones(count, dtype=bool), noise, 1.0, EdgeSettings())
        near = np.abs(found.offset_px) < 0.8
        if (np.bincount(found.sample[near], minlength=count) == 1).all():
            means.append(found.offset_px[near].mean())
            singles.append(found.offset_px[near])
    assert len(means) > 450
    part = independent_part(uv_px, np.zeros(count, dtype=np.intp), 1, float(ROWS))[0]
    assert np.var(means) / np.var(singles) == pytest.approx(1.0 / (part * count), rel=0.2)


# --- a monitor ---


@pytest.mark.parametrize("tip", TIPS)
def test_tips_of_short_edges_are_measured_as_exactly_as_is_said(tip: str):
    """Before another background for each of six short sequences."""
    model, solids = fingers(tip)
    camera, pose, nees, valid, frames = make_camera(PAPER_LENS), nominal_cam_T_grip(), [], 0, 0
    scenario = make_scenario("clutter", duration_s=0.4, fps=15.0)
    for seed in range(6):
        simulator = paper_rig(solids, pose).simulator(scenario, seed)
        indices = range(simulator.frame_count)
        monitor = Monitor(camera, model, MonitorSettings(), reference_of(pose))
        seen = watch(
            tuple(simulator.frame(i) for i in indices), tuple(simulator.truth(i) for i in indices), monitor
        )  # fmt: skip
        for record, truth in list(zip(seen.records, seen.truths, strict=True))[1:]:
            frames += 1
            if record.cam_T_grip is None:
                continue
            away = perturbation_between(pose_of(record.cam_T_grip), truth.cam_T_grip)
            nees.append(away @ np.linalg.solve(np.reshape(record.covariance, (6, 6)), away))
            assert record.protection is not None
            assert np.linalg.norm(away[:3]) <= record.protection.position_m
            valid += record.verdict is Verdict.VALID
    assert frames == 30 and valid / frames > VALID[tip]
    assert np.mean(nees) < 3.0 * 6.0 and np.median(nees) < 2.0 * 5.35, "chi-square of six: mean and median"


VALID = {"half round": 0.2, "three facets": 0.35}


def test_what_shows_along_fingers_is_learnt_where_their_sides_are_made_of_several_edges():
    """The first straight piece behind the tip is 11 px long; a strip along the finger needs 16."""
    model, solids = fingers("half round")
    along = along_fingers(model)[1]
    first = [e for e in np.flatnonzero(along) if model.edge_ids[e] in ("left_edge1", "left_edge2")]
    assert first, "facets that run along the finger"
    simulator = paper_rig(solids).simulator(Scenario(fps=2.0, duration_s=4.0), 1)
    strips = FingerStrips(make_camera(PAPER_LENS), model, along)
    for i in range(FIRST_FRAMES):
        truth = simulator.truth(i)
        strips.learn(simulator.render(i), truth.cam_T_grip, truth.jaw_opening_m, truth.time_s)
    assert strips.ready


# --- what only looks like such tips ---


def slid(slide_m: float) -> np.ndarray:
    pose = nominal_cam_T_grip()
    pose[:3, 3] += slide_m * pose[:3, 2]
    return pose


@pytest.mark.parametrize("tip", TIPS)
@pytest.mark.parametrize(("z_m", "size_z_m"), [(-0.010, 0.03), (-0.018, 0.04)])
def test_a_rim_parallel_to_short_edges_is_no_end_of_the_fingers(tip: str, z_m: float, size_z_m: float):
    """A bar before the tips, and the fit starts from everywhere along the fingers."""
    model, solids = fingers(tip)
    look = ObjectLook(pattern="plain", level_dn=30.0)
    bar = Prop(size_m=(0.2, 0.01, size_z_m), centre_m=(0.0, -0.02, z_m), look=look)
    assert not proven_elsewhere(model, solids, plain_scenario(props=(bar,)), np.linspace(-0.03, 0.012, 29).tolist())


@pytest.mark.parametrize("tip", TIPS)
@pytest.mark.parametrize(("from_tip_m", "to_m"), [(0.0008, 0.02), (0.003, 0.0033)])
@pytest.mark.parametrize("gain", [0.4, 2.2])
def test_a_shadow_parallel_to_short_edges_is_no_end_of_the_fingers(
    tip: str, from_tip_m: float, to_m: float, gain: float
):
    """Its border, or a line, lies across both fingers 6 to 22 px behind their tips, and the fit starts there."""
    model, solids = fingers(tip)
    mark = FingerMark(from_tip_m=(from_tip_m, to_m), across=(-2.0, 2.0), gain=gain)
    scenario = plain_scenario(fingers=FingerLook(texture=0.0, carriers=False, marks=(mark,)))
    starts_m = [-share * at for at in (from_tip_m, to_m) if at < 0.01 for share in (0.8, 1.0, 1.2)]
    assert not proven_elsewhere(model, solids, scenario, starts_m)


def proven_elsewhere(model: Gripper, solids: Gripper, scenario: Scenario, slides_m: list[float]) -> list[float]:
    """From which starts the ends of the fingers are surely seen more than 0.2 mm from where they are."""
    nominal, using = nominal_cam_T_grip(), meter(model)
    image = paper_rig(solids, nominal).simulator(scenario, 1).render(0)
    out = []
    for slide_m in slides_m:
        found = measure(image, slid(slide_m), using=using, jaw_opening_m=model.jaw_nominal_m)
        if np.linalg.norm(found.cam_T_grip[:3, 3] - nominal[:3, 3]) > 2e-4 and using.ends(image, found).sure:
            out.append(slide_m)
    return out
