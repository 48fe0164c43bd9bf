"""What hides what: the simulator's truth against its pictures, and its geometry against steps along the rays."""

from __future__ import annotations

import cv2
import msgspec
import numpy as np
from support.simulated import PLAIN_FINGERS, plain_scenario, simulator

from gripmon.simulate import Hidden
from gripmon.simulate.scenario import Cover, GraspedObject, JawScript
from gripmon.simulate.solids import PlacedSolid, box, hidden_by, paint_order, place


def test_what_is_hidden_leaves_no_trace_in_the_picture_and_what_is_visible_does() -> None:
    sections = {
        "jaw": JawScript(knots=((0.0, 0.034), (1.0, 0.026))),
        "grasped": GraspedObject(arrive_s=(0.0, 1.0)),
        "covers": (Cover(start_s=2.6, end_s=4.0, move_s=0.5),),
        "fps": 10.0,
    }
    looks = (PLAIN_FINGERS, msgspec.structs.replace(PLAIN_FINGERS, level_dn=200.0))
    dark, bright = (simulator(plain_scenario(fingers=look, **sections)) for look in looks)
    found = set()
    for index in (0, 15, 26, 27, 28, 35):
        changed = np.abs(dark.light(index) - bright.light(index))
        truth, state = dark.truth(index), dark._scene.at(dark.time_s(index))
        for k, hidden in enumerate(truth.hidden):
            if hidden is Hidden.SELF:
                continue
            # A point of the finger's inner face near the corner: a corner that touches the object is half hidden.
            point = state.points_grip_m[dark.gripper.corner_points[k]]
            inner = point * (1.0, 0.8, 1.0) + (0.0, 0.0, -0.002) if "_in_" in truth.corner_ids[k] else point
            uv = dark.camera.project((truth.cam_T_grip[:3, :3] @ inner + truth.cam_T_grip[:3, 3])[None])[0]
            u, v = np.round(uv).astype(int)
            change = changed[v - 1 : v + 2, u - 1 : u + 2].max()
            assert change > 5.0 if hidden is None else change < 0.02
            found.add(hidden)
    assert found == {None, Hidden.OBJECT, Hidden.COVER}


def random_box(rng: np.random.Generator, name: str) -> tuple[PlacedSolid, np.ndarray, np.ndarray]:
    half = rng.uniform(0.004, 0.02, 3)
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(rng.normal(0.0, 1.0, 3))[0]
    pose[:3, 3] = rng.uniform((-0.03, -0.03, 0.1), (0.03, 0.03, 0.2))
    return place(box(name, -half, half), pose), half, pose


def inside_box(points: np.ndarray, half: np.ndarray, pose: np.ndarray) -> np.ndarray:
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    return (np.abs(local) < half).all(axis=-1)


def test_hiding_agrees_with_steps_along_the_rays() -> None:
    rng = np.random.default_rng(3)
    outcomes = []
    for k in range(60):
        body, half, pose = random_box(rng, f"box {k}")
        points = rng.uniform((-0.05, -0.05, 0.1), (0.05, 0.05, 0.25), (40, 3))
        steps = np.linspace(0.0, 1.0, 4001)[:-1, None, None] * points
        stepped = inside_box(steps, half, pose).sum(axis=0)
        clear = (stepped == 0) | (stepped > 3)  # a ray that grazes an edge is decided by the step's length
        np.testing.assert_array_equal(hidden_by(body, points)[clear], (stepped > 0)[clear])
        outcomes += (stepped > 0).tolist()
    assert 0.05 < np.mean(outcomes) < 0.95


def test_boxes_are_painted_from_back_to_front() -> None:
    rng = np.random.default_rng(8)
    pairs = 0
    for _ in range(300):
        bodies = [random_box(rng, name) for name in ("a", "b")]
        cloud = rng.uniform(-1.2, 1.2, (3000, 3)) * bodies[0][1] @ bodies[0][2][:3, :3].T + bodies[0][2][:3, 3]
        if inside_box(cloud, 1.2 * bodies[1][1], bodies[1][2]).any():
            continue  # boxes that cross each other have no order
        order = [b.solid.name for b in paint_order([b[0] for b in bodies])]
        rays = np.stack(
            [*np.meshgrid(np.linspace(-0.3, 0.3, 30), np.linspace(-0.3, 0.3, 30)), np.ones((30, 30))], axis=-1
        )
        depths = np.linspace(0.06, 0.26, 250)
        hits = [inside_box(rays.reshape(-1, 1, 3) * depths[:, None], half, pose) for _, half, pose in bodies]
        both = hits[0].any(axis=1) & hits[1].any(axis=1)
        if both.any():
            pairs += 1
            nearest = [depths[h[both].argmax(axis=1)] for h in hits]
            in_front = "a" if (nearest[0] < nearest[1]).mean() > 0.5 else "b"
            assert order[-1] == in_front
    assert pairs > 20
