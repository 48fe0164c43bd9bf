"""From still frames to a new reference: honest covariances by sampling, and every reason to refuse or to ask."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.simulated import BOX_FINGERS, nominal_cam_T_grip
from support.still_frames import CHANGING, LASTING, REFERENCE_T, TRUE_T, Scene, image, moved, reference

from gripmon.daemon.config import read_gripper
from gripmon.judge.recalibrate import Proposal, RecalibrationSettings, Recalibrator, Refusal, RefusalReason, StillFrame
from gripmon.judge.recalibrate.edges import fingers_disagree, leave_one_out, pool
from gripmon.judge.recalibrate.recalibrator import UNLIKELY_RESIDUALS_RISK
from gripmon.judge.recalibrate.stills import LASTING_SHARE as LASTING_PART
from gripmon.judge.recalibrate.stills import average, averaged_covariance, mean_corners
from gripmon.model.geometry import perturb, perturbation_between

SURE = RecalibrationSettings(sure_sigma_m=1e-4)
CUBE = Path(BOX_FINGERS).parent / "visp_cube.yaml"


def outcome(
    frames: list[StillFrame],
    settings: RecalibrationSettings = SURE,
    scene: Scene | None = None,
    most: int | None = None,
) -> Proposal | Refusal:
    recalibrator = Recalibrator(settings, (scene or Scene()).gripper, np.eye(6) * 1e-14, most)
    for frame in frames:
        recalibrator.add(frame)
    return recalibrator.outcome(reference())


def proposal(*arguments: object, **settings: object) -> Proposal:
    out = outcome(*arguments, **settings)  # type: ignore[arg-type]
    assert isinstance(out, Proposal), out
    return out


def refused(*arguments: object, **settings: object) -> Refusal:
    out = outcome(*arguments, **settings)  # type: ignore[arg-type]
    assert isinstance(out, Refusal), out
    return out


def test_a_knocked_camera_gets_a_new_reference_without_asking_anybody():
    out = proposal(Scene().frames(20))
    assert out.needs_person is None and not out.wait
    assert np.linalg.norm(out.cam_T_grip[:3, 3] - TRUE_T[:3, 3]) < 4e-5
    assert (out.inputs.frames, out.inputs.first_seq, out.inputs.last_seq) == (20, 0, 19)
    shown = [name for name, seen in zip(Scene().gripper.corner_ids, Scene()._visible(), strict=True) if seen]
    assert out.inputs.corners == tuple(shown) and len(shown) >= 6
    assert 0.1 < out.inputs.weighted_rms < 2.0
    assert out.inputs.step_m == pytest.approx(np.linalg.norm(TRUE_T[:3, 3] - REFERENCE_T[:3, 3]), abs=5e-5)
    assert out.inputs.step_rad == pytest.approx(np.linalg.norm([0.01, -0.02, 0.015]), abs=1e-3)


def test_the_covariance_is_that_of_the_error():
    """Frames share part of their error: averaging must not make it look smaller than it is."""
    nees, squares = [], []
    outcomes = [outcome(Scene().frames(20, seed)) for seed in range(60)]
    proposals = [out for out in outcomes if isinstance(out, Proposal)]
    assert len(proposals) >= 56, "one in fifty is refused for fingers that seem to disagree"
    for out in proposals:
        error = perturbation_between(out.cam_T_grip, TRUE_T)
        nees.append(error @ np.linalg.solve(out.covariance, error))
        squares.append(error[:3] @ error[:3] / np.trace(out.covariance[:3, :3]))
    # Twenty frames tell roughly which part of the error lasts: the covariance may be too large, but not too small.
    assert 2.5 < np.mean(nees) < 7.5
    assert 0.4 < np.mean(squares) < 1.25


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.8])
def test_frames_that_err_alike_count_as_fewer(correlation: float):
    """Averages of series whose neighbours are correlated: their scatter is what a single series says, or less."""
    rng = np.random.default_rng(2)
    means, said = [], []
    for _ in range(400):
        values = np.zeros(30)
        values[0] = rng.normal()
        for k in range(1, 30):
            values[k] = correlation * values[k - 1] + np.sqrt(1.0 - correlation**2) * rng.normal()
        means.append(values.mean())
        said.append(averaged_covariance(np.eye(1), values[:, None], 30)[0, 0] - LASTING_PART)
    assert np.var(means) < 1.25 * np.mean(said)


def test_a_few_frames_that_err_alike_count_as_one_in_nineteen_at_most():
    """Whatever the correlation that so few tell: (1 + 0.9) / (1 - 0.9)."""
    values = np.linspace(-1.0, 1.0, 40)[:, None]
    claimed = np.var(values, ddof=1).reshape(1, 1)
    found = averaged_covariance(claimed, values, 190)
    np.testing.assert_allclose(found, claimed * (LASTING_PART + 19.0 / 190.0), rtol=1e-9)


def test_the_first_three_frames_claims_hold_for_all():
    frames = [replace(Scene().frames(1)[0], seq=k) for k in range(20)]
    frames = [replace(f, covariance=(9.0, 3.0, 3.0, *[1.0] * 17)[k] * f.covariance) for k, f in enumerate(frames)]
    np.testing.assert_allclose(average(frames, 60).covariance, 5.0 * frames[-1].covariance, rtol=1e-6)


@pytest.mark.parametrize(("seen", "kept"), [(5, True), (3, False)])
def test_a_corner_has_to_be_seen_in_a_fifth_of_the_frames(seen: int, kept: bool):
    frames = Scene().frames(20)
    corner = int(np.flatnonzero(frames[0].usable)[0])
    for k, frame in enumerate(frames[seen:], start=seen):
        usable = frame.usable.copy()
        usable[corner] = False
        among = np.repeat(usable[frame.usable], 2)
        frames[k] = replace(frame, usable=usable, covariance_xy=frame.covariance_xy[np.ix_(among, among)])
    assert (corner in mean_corners(frames, TRUE_T).corner) == kept


def test_frames_that_show_the_gripper_elsewhere_do_not_pull_the_average():
    frames = Scene().frames(24)
    clean = average(frames, 60)
    frames[3], frames[17] = (moved(frames[k], np.array([2e-3, 0.0, 5e-3, 0.0, 0.0, 0.0])) for k in (3, 17))
    with_two = average(frames, 60)
    assert with_two.outlying == pytest.approx(2 / 24)
    assert np.linalg.norm(with_two.cam_T_grip[:3, 3] - clean.cam_T_grip[:3, 3]) < 3e-6


@pytest.mark.parametrize("off_px", [0.3, 30.0])
def test_a_corner_that_is_wrong_in_some_frames_does_not_pull_its_mean(off_px: float):
    """By tens of pixels, and by eight standard deviations, where five are enough to leave it out."""
    frames = Scene().frames(20)
    clean = mean_corners(frames, TRUE_T)
    for k in (2, 9, 10, 15):
        xy = frames[k].xy.copy()
        xy[int(clean.corner[1])] += off_px / 962.0
        frames[k] = replace(frames[k], xy=xy)
    pulled = mean_corners(frames, TRUE_T)
    assert 962.0 * np.abs(pulled.xy - clean.xy).max() < 0.05


def test_a_corner_that_is_wrong_in_all_frames_is_left_out():
    name = "L_in_far"
    out = proposal(Scene(off_px={name: (2.0, -3.0)}).frames(20))
    assert name not in out.inputs.corners and len(out.inputs.corners) >= 5
    assert np.linalg.norm(out.cam_T_grip[:3, 3] - TRUE_T[:3, 3]) < 4e-5


@pytest.mark.parametrize("most", [4, 5])
def test_only_the_corners_next_to_the_tcp_are_taken_where_that_is_asked_for(most: int):
    out = proposal(Scene().frames(20), most=most)
    assert len(out.inputs.corners) == most and {"L_in_near", "R_in_near"} <= set(out.inputs.corners)


def test_a_moving_jaw_is_no_obstacle():
    out = proposal(Scene(openings_m=(0.02, 0.03, 0.04, 0.03)).frames(40))
    assert out.needs_person is None and np.linalg.norm(out.cam_T_grip[:3, 3] - TRUE_T[:3, 3]) < 4e-5


def test_corners_that_are_in_no_plane():
    """A box as the gripper: seven corners of it show, its single finger needs no second one to be believed."""
    gripper = read_gripper(CUBE)
    true_T = perturb(nominal_cam_T_grip(tilt_deg=40.0, tcp_m=(0.04, -0.02, 0.5)), np.array([0, 0, 0, 0.1, 0.5, 0.0]))
    scene = Scene(gripper=gripper, true_T=true_T)
    settings = RecalibrationSettings(sure_sigma_m=1e-3, largest_sigma_m=2e-3, largest_step_m=1.0, largest_step_rad=3.0)
    out = proposal(scene.frames(20), settings, scene)
    assert len(out.inputs.corners) >= 6 and out.needs_person is None
    assert np.linalg.norm(out.cam_T_grip[:3, 3] - true_T[:3, 3]) < 6e-5


def near_a_line() -> Scene:
    """Only the front corners of the fingertips, and one a little beside their line."""
    gripper = Scene().gripper
    scene = Scene(corner_px=1.0, hidden=tuple(n for n in gripper.corner_ids if n.endswith("_far")))
    frames = scene.frames(1)
    assert np.count_nonzero(frames[0].usable) == 4
    return scene


def _bent_towards_the_line(frame: StillFrame) -> StillFrame:
    points = frame.points_grip_m.copy()
    points[int(np.flatnonzero(frame.usable)[0])] += [0.0, 0.002, 0.0]
    xy = np.where(frame.usable[:, None], image(points, TRUE_T), np.nan)
    return replace(frame, points_grip_m=points, xy=xy)


def everywhere_the_same(frame: StillFrame) -> StillFrame:
    return replace(frame, xy=np.where(frame.usable[:, None], 0.05, np.nan))


def drifting(frames: list[StillFrame]) -> list[StillFrame]:
    return [moved(f, np.array([0.0, 5e-6 * k, 0.0, 0.0, 0.0, 0.0])) for k, f in enumerate(frames)]


def half_elsewhere(frames: list[StillFrame]) -> list[StillFrame]:
    return [moved(f, np.array([1e-3 * (k % 3 == 0), 0.0, 0.0, 0.0, 0.0, 0.0])) for k, f in enumerate(frames)]


def all_moved(frames: list[StillFrame]) -> list[StillFrame]:
    return [moved(f, np.array([0.0, 0.0, 2e-3, 0.0, 0.0, 0.0])) for f in frames]


def far_plane() -> list[StillFrame]:
    """A fingertip plane far away: tilted one way or the other it looks the same within the noise, and the edges can't
    tell either.
    """
    true_T = nominal_cam_T_grip(tilt_deg=20.0, tcp_m=(0.0, 0.0, 1.5))
    vague = np.diag(np.square([1e-3] * 2 + [5e-3] + [0.4] * 3))
    scene = Scene(true_T=true_T, corner_px=0.2, lasting=0.0 * vague, changing=1e-6 * vague)
    return [replace(f, covariance=vague) for f in scene.frames(20)]


REFUSALS = {
    RefusalReason.OFF: lambda: (Scene().frames(20), RecalibrationSettings(mode="off")),
    RefusalReason.FEW_FRAMES: lambda: (Scene().frames(19), SURE),
    RefusalReason.NOT_STILL: lambda: (drifting(Scene().frames(30)), RecalibrationSettings()),
    RefusalReason.FEW_CORNERS: lambda: (
        Scene(hidden=tuple(n for n in Scene().gripper.corner_ids if n not in ("L_in_far", "R_in_far"))).frames(20),
        SURE,
    ),
    RefusalReason.ON_A_LINE: lambda: (near_a_line().frames(20), SURE),
    RefusalReason.NO_POSE: lambda: ([everywhere_the_same(f) for f in Scene().frames(20)], SURE),
    RefusalReason.RESIDUALS: lambda: (
        Scene(off_px={"L_in_near": (2.0, 3.0), "R_in_far": (-3.0, 2.0), "R_out_near": (0.0, -3.0)}).frames(20),
        SURE,
    ),
    RefusalReason.ILL_CONDITIONED: lambda: ([_bent_towards_the_line(f) for f in near_a_line().frames(20)], SURE),
    RefusalReason.CONTRADICTED: lambda: (all_moved(Scene().frames(20)), SURE),
    RefusalReason.AMBIGUOUS: lambda: (far_plane(), SURE),
    RefusalReason.FINGERS: lambda: (Scene(bend_m=(1e-4, 1e-4, 0.0)).frames(20), SURE),
    RefusalReason.UNCERTAIN: lambda: (Scene(lasting=900.0 * LASTING, corner_px=0.5).frames(20), SURE),
}


@pytest.mark.parametrize("reason", list(RefusalReason))
def test_every_reason_to_refuse_is_given_where_it_applies(reason: RefusalReason):
    frames, settings = REFUSALS[reason]()
    out = refused(frames, settings)
    assert out.reason is reason, out.text
    assert out.text and out.wait == (reason is RefusalReason.FEW_FRAMES)


def test_covariances_that_cannot_be_inverted_are_a_refusal_and_no_crash():
    frames = [replace(f, covariance_xy=np.zeros_like(f.covariance_xy)) for f in Scene().frames(20)]
    out = refused(frames)
    assert out.reason is RefusalReason.ILL_CONDITIONED and "can't be weighed" in out.text


@pytest.mark.parametrize("seen", ["none", "one in turn", "any"])
def test_frames_may_show_any_of_the_corners(seen: str):
    """Each frame its own selection, and frames without any: an answer comes of it, whatever it is."""
    rng = np.random.default_rng(5)
    frames = []
    for k, frame in enumerate(Scene().frames(30)):
        shown = np.flatnonzero(frame.usable)
        kept = {"none": shown[:0], "one in turn": shown[[k % len(shown)]], "any": shown[rng.random(len(shown)) < 0.6]}[
            seen
        ]
        usable = np.isin(np.arange(len(frame.usable)), kept)
        among = np.repeat(usable[frame.usable], 2)
        xy = np.where(usable[:, None], frame.xy, np.nan)
        frames.append(replace(frame, usable=usable, xy=xy, covariance_xy=frame.covariance_xy[np.ix_(among, among)]))
    out = outcome(frames)
    if seen == "any":
        assert isinstance(out, Proposal) and len(out.inputs.corners) >= 6
        assert np.linalg.norm(out.cam_T_grip[:3, 3] - TRUE_T[:3, 3]) < 4e-5
    else:
        assert isinstance(out, Refusal) and out.reason is RefusalReason.FEW_CORNERS


def test_a_third_of_the_frames_elsewhere_is_no_standing_camera():
    out = refused(half_elsewhere(Scene().frames(30)))
    assert out.reason is RefusalReason.NOT_STILL and "elsewhere" in out.text
    frames = Scene().frames(30)
    frames[4:10] = all_moved(frames[4:10])
    assert isinstance(outcome(frames), Proposal), "a fifth of them may be"


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"mode": "confirm"}, "has to be accepted"),
        ({"largest_step_m": 2e-3}, "a step of 3.7 mm, more than 2 mm"),
        ({"largest_step_rad": 0.01}, "a turn of 1.5 degrees, more than 0.573"),
        ({"sure_sigma_m": 1e-6}, "the TCP is uncertain by"),
    ],
    ids=["confirm", "step", "turn", "sigma"],
)
def test_what_only_a_person_may_accept(settings: dict[str, object], said: str):
    whole = {"sure_sigma_m": 1e-4, **settings}
    out = proposal(Scene().frames(20), RecalibrationSettings(**whole))  # type: ignore[arg-type]
    assert out.needs_person is not None and said in out.needs_person


def test_one_finger_alone_may_be_bent():
    scene = Scene(fingers=("left",))
    out = proposal(scene.frames(20), RecalibrationSettings(sure_sigma_m=1e-3, largest_sigma_m=1e-3))
    assert out.needs_person is not None and "only finger 'left' is seen" in out.needs_person


def test_more_frames_are_waited_for_only_where_they_help():
    def waits(lasting: np.ndarray, changing: np.ndarray, frames: int = 20) -> Proposal:
        scene = Scene(lasting=lasting, changing=changing, corner_px=0.2)
        return proposal(scene.frames(frames), RecalibrationSettings(sure_sigma_m=5e-5, most_frames=60))

    assert waits(1e-2 * LASTING, 60.0 * CHANGING).wait
    late = waits(1e-2 * LASTING, 60.0 * CHANGING, 60)
    assert not late.wait and late.needs_person is None
    steady = waits(60.0 * LASTING, 1e-2 * CHANGING)
    assert not steady.wait and steady.needs_person is not None, "what doesn't scatter isn't averaged away"


def test_what_waits_is_looked_at_again_after_some_frames():
    scene = Scene(lasting=1e-2 * LASTING, changing=60.0 * CHANGING, corner_px=0.2)
    recalibrator = Recalibrator(RecalibrationSettings(sure_sigma_m=5e-5), scene.gripper, np.eye(6) * 1e-14)
    answers = []
    for frame in scene.frames(60):
        recalibrator.add(frame)
        answers.append(recalibrator.outcome(reference()))
    assert all(isinstance(a, Refusal) and a.wait for a in answers[:19])
    waiting = [a for a in answers[19:] if a.wait]
    assert len(waiting) // 5 <= len({id(a) for a in waiting}) <= len(waiting) // 5 + 1
    done = next(a for a in answers[19:] if not a.wait)
    assert isinstance(done, Proposal) and done.needs_person is None and 20 < done.inputs.frames < 60
    recalibrator.forget()
    again = recalibrator.outcome(reference())
    assert isinstance(again, Refusal) and again.reason is RefusalReason.FEW_FRAMES


def test_the_newest_frames_count_and_forgetting_begins_anew():
    recalibrator = Recalibrator(RecalibrationSettings(frames=10, most_frames=15), Scene().gripper, np.eye(6) * 1e-14)
    frames = Scene().frames(20)
    for frame in all_moved(frames[:5]) + frames[5:]:
        recalibrator.add(frame)
    assert recalibrator.frames == 15
    out = recalibrator.outcome(reference())
    assert isinstance(out, Proposal) and out.inputs.first_seq == 5
    recalibrator.forget()
    assert recalibrator.frames == 0
    assert isinstance(recalibrator.outcome(reference()), Refusal)


def test_leaving_an_edge_out_moves_the_pose_as_a_fit_without_it():
    frames = Scene().frames(20)
    pooled = pool(frames, TRUE_T)
    rows, values, edges = [], [], []
    scale = np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
    for frame in frames:
        assert frame.edges is not None
        shift = perturbation_between(frame.cam_T_grip, TRUE_T)
        for k in range(len(frame.edges.edge)):
            # Each stretch as a square root of its information: the same normal equations.
            moment = scale * (frame.edges.moment[k] - frame.edges.information[k] @ shift)
            size, axes = np.linalg.eigh(frame.edges.information[k] * np.outer(scale, scale))
            root = np.sqrt(np.maximum(size, 0.0))[:, None] * axes.T
            rows.append(root)
            values.append(np.linalg.lstsq(root.T, moment, rcond=1e-9)[0])
            edges += [int(frame.edges.edge[k])] * 6
    matrix, right, edge = np.concatenate(rows), np.concatenate(values), np.array(edges)

    def fit(kept: np.ndarray) -> np.ndarray:
        return scale * np.linalg.lstsq(matrix[kept], right[kept], rcond=None)[0]

    whole = fit(np.ones(len(edge), dtype=bool))
    names = np.unique(edge)
    expected = (
        sum(np.outer(d, d) for d in (fit(edge != name) - whole for name in names)) * (len(names) - 1) / len(names)
    )
    np.testing.assert_allclose(
        leave_one_out(pooled) / np.outer(scale, scale), expected / np.outer(scale, scale), rtol=1e-3
    )


def test_without_edges_nothing_is_sure():
    frames = [replace(f, edges=None) for f in Scene().frames(20)]
    assert np.sqrt(leave_one_out(pool(frames, TRUE_T))[0, 0]) == 1.0
    out = refused(frames)
    assert out.reason is RefusalReason.UNCERTAIN


def test_fingers_of_one_gripper_disagree_as_seldom_as_is_said():
    """Errors of stretches and edges as they are assumed, but of whatever size: the chance is uniform."""
    rng = np.random.default_rng(3)
    pooled = pool(Scene().frames(4), TRUE_T)
    chances = []
    for _ in range(400):
        of_edge = rng.normal(size=100)[pooled.edge]
        residual_px = pooled.sigma_px * rng.normal(size=len(of_edge)) + pooled.shared_px * of_edge
        own = replace(pooled, residual_px=7.0 * residual_px)
        chance = fingers_disagree(own)
        assert chance is not None
        chances.append(chance)
    assert np.mean(np.array(chances) < 0.1) == pytest.approx(0.1, abs=0.06)
    assert np.mean(chances) == pytest.approx(0.5, abs=0.06)


@pytest.mark.parametrize("bend_m", [(1e-4, 0.0, 0.0), (0.0, 1e-4, 0.0), (0.0, 0.0, 3e-4)])
def test_a_finger_that_is_bent_by_a_tenth_of_a_millimetre_is_noticed(bend_m: tuple[float, float, float]):
    for seed in range(10):
        chance = fingers_disagree(pool(Scene(bend_m=bend_m).frames(20, seed), TRUE_T))
        assert chance is not None and chance < UNLIKELY_RESIDUALS_RISK
    assert fingers_disagree(pool(Scene(fingers=("left",)).frames(20), TRUE_T)) is None


@pytest.mark.parametrize(("chance", "refused_so"), [(0.03, False), (0.013, True)])
def test_fingers_that_show_as_one_gripper_by_a_chance_of_two_per_cent_are_refused(
    chance: float, refused_so: bool, monkeypatch: pytest.MonkeyPatch
):
    """How that chance is found is tested above."""
    monkeypatch.setattr("gripmon.judge.recalibrate.recalibrator.fingers_disagree", lambda pooled: chance)
    answer = outcome(Scene().frames(24))
    assert (isinstance(answer, Refusal) and answer.reason is RefusalReason.FINGERS) is refused_so
    assert isinstance(answer, Proposal) is not refused_so
