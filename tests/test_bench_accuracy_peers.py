"""The peers of ``tools/bench accuracy``, the tags that it prints, and its Cramér-Rao bound."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from gripmon.model.geometry import perturb
from gripmon.simulate import Simulator

pytestmark = pytest.mark.usefixtures("tools_importable")


def scene(name: str, number: int, frames: int = 6) -> Any:
    from benchmarks.conditions import CONDITIONS
    from benchmarks.scenes import make_scene

    return make_scene(next(c for c in CONDITIONS if c.name == name), 1, number, frames)


@pytest.mark.slow("10 s: peers of a benchmark, no part of what is installed")
@pytest.mark.parametrize(("name", "bound_m"), [("cornerSubPix", 2e-4), ("rapid", 1.5e-3), ("aruco", 1e-3)])
def test_peers_follow_a_gripper_that_shows_well(name: str, bound_m: float):
    from benchmarks.peers import PEERS

    for number in range(3):
        sequence = scene("clean", number, 4)
        peer = PEERS[name](sequence)
        for index, shot in enumerate(sequence.shots()):
            image = sequence.tagged(index, shot) if peer.tagged else shot.frame.image
            pose = peer.cam_T_grip(image, shot.jaw_opening_m)
            assert pose is not None
            assert np.linalg.norm(pose[:3, 3] - shot.cam_T_grip[:3, 3]) < bound_m


@pytest.mark.slow("10 s: peers of a benchmark, no part of what is installed")
@pytest.mark.parametrize("number", [0, 1, 2])
def test_printed_tags_are_where_the_model_says(number: int):
    """Their black corners as an independent detector finds them, on three grippers; and nothing else changes."""
    pytest.importorskip("pyapriltags")
    from benchmarks import tags

    sequence = scene("standing", number)
    shot = next(iter(sequence.shots()))
    image = sequence.tagged(0, shot)
    found = tags._AprilTags()(image)
    expected = tags.FingerTags(sequence.gripper).black_points_grip_m(shot.jaw_opening_m)
    assert set(found) == set(expected) == {0, 1}
    for name, points in expected.items():
        uv = sequence.camera.project(points @ shot.cam_T_grip[:3, :3].T + shot.cam_T_grip[:3, 3])
        assert np.abs(found[name] - uv).max() < 0.4
        assert np.abs((found[name] - uv).mean(axis=0)).max() < 0.1
    changed = np.argwhere(image != shot.frame.image)
    assert len(changed) < 0.05 * image.size
    tracker = tags.TagTracker(sequence.camera, tags.FingerTags(sequence.gripper), "apriltag")
    pose = tracker.cam_T_grip(image, shot.jaw_opening_m)
    assert np.linalg.norm(pose[:3, 3] - shot.cam_T_grip[:3, 3]) < 2e-4


@pytest.mark.slow("10 s: peers of a benchmark, no part of what is installed")
def test_slopes_of_the_bound_tell_what_small_motions_do():
    """Against pictures of the gripper placed elsewhere outright; even light, so that its shades don't depend on it."""
    from dataclasses import replace

    from benchmarks import bound

    standing = scene("standing", 1)
    own = standing.simulator
    even = msgspec.structs.replace(own.scenario, fingers=msgspec.structs.replace(own.scenario.fingers, ambient=1.0))
    simulator = Simulator(own.camera, own.gripper, own.nominal_cam_T_grip, even, own.seed)
    standing = replace(standing, simulator=simulator)
    near = bound.edge_pixels(standing)
    slopes, variance = bound.slopes(standing, near), bound.variance(standing, near)
    xi = np.array([6e-6, -4e-6, 2e-5, 1e-4, -5e-5, 8e-5])
    moved = Simulator(own.camera, own.gripper, perturb(own.nominal_cam_T_grip, xi), even, own.seed)
    clean = simulator.light(0)[near].astype(float)
    really = moved.light(0)[near] - clean
    assert np.linalg.norm(really) > 50.0
    assert np.linalg.norm(slopes[:, :6] @ xi - really) < 0.05 * np.linalg.norm(really)
    # Weighted least squares on the pixels themselves reaches the bound: sampled, with the simulator's own noise.
    information = bound.fisher_information(slopes, variance)
    known = information[:6, :6]
    weighted = slopes[:, :6].T / variance
    estimates = [np.linalg.solve(known, weighted @ (simulator.render(i)[near] - clean)) for i in range(60)]
    best = bound.bound_of(information)
    assert np.std(estimates, axis=0) == pytest.approx(best.jaw_known, rel=0.35)
    assert (best.jaw_unknown >= best.jaw_known).all()


def test_repeatability_of_known_spreads():
    from benchmarks.accuracy_runs import Track
    from benchmarks.bound import Bound, repeatability

    rng = np.random.default_rng(1)
    n = 4000
    error = np.zeros((2 * n, 6))
    error[:, :3] = rng.normal(0.0, 1.0, (2 * n, 3)) * [2e-6, 3e-6, 4e-6]
    error[n:] += 5e-6  # a systematic error of a scene doesn't count
    ones = np.ones(2 * n)
    track = Track(
        np.repeat([0, 1], n), np.tile(np.arange(n), 2), ones > 0, ones > 0, error, error[:, :3], ones, ones, ones
    )
    out = repeatability(track, [Bound(np.full(6, 1e-6), np.full(6, 2e-6))] * 2)
    assert out["ratio"] == pytest.approx([2.0, 3.0, 4.0], rel=0.05)
    assert out["spread_um"] == pytest.approx([2.0, 3.0, 4.0], rel=0.05)
    assert out["bound_um"] == pytest.approx([1.0] * 3) and out["bound_jaw_unknown_um"] == pytest.approx([2.0] * 3)
