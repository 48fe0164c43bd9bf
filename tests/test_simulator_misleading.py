"""What misleads an edge tracker: marks on fingers, other tips than the model's, lines that run like the fingers'."""

from __future__ import annotations

import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest
from support.simulated import PLAIN_FINGERS, plain_scenario, simulator

from gripmon.simulate import Hidden
from gripmon.simulate.scenario import (
    FingerMark,
    FingerShape,
    GraspedObject,
    JawScript,
    Light,
    ObjectLook,
    Prop,
    Shadow,
)

sys.path.insert(0, str(Path(__file__).parent.parent / "tools"))

from benchmarks.outline_seen import outline_seen


def fingers(**changes: object):
    return msgspec.structs.replace(PLAIN_FINGERS, **changes)


def pixel(sim, point_grip_m: tuple[float, float, float], index: int = 0) -> np.ndarray:
    cam_T_grip = sim.truth(index).cam_T_grip
    return sim.camera.project((cam_T_grip[:3, :3] @ np.array(point_grip_m) + cam_T_grip[:3, 3])[None])[0]


def grey(image: np.ndarray, uv: np.ndarray) -> float:
    return float(image[round(uv[1]), round(uv[0])])


def crossing(image: np.ndarray, start: np.ndarray, end: np.ndarray) -> float:
    """Share of the way from start to end at which the grey value passes the middle between both ends'."""
    share = np.linspace(0.0, 1.0, 401)
    uv = start + share[:, None] * (end - start)
    u, v = np.floor(uv).astype(int).T
    a, b = (uv - np.floor(uv)).T
    values = (1 - b) * ((1 - a) * image[v, u] + a * image[v, u + 1])
    values += b * ((1 - a) * image[v + 1, u] + a * image[v + 1, u + 1])
    middle = 0.5 * (values[0] + values[-1])
    return float(share[np.flatnonzero(np.diff(np.sign(values - middle)))[0]])


def test_a_pad_ends_where_its_geometry_says() -> None:
    pad = FingerMark(from_tip_m=(0.004, 0.014), across=(-0.6, 0.6), gain=0.4)
    marked = simulator(plain_scenario(fingers=fingers(marks=(pad,))))
    plain = simulator(plain_scenario())
    image, without = marked.light(0), plain.light(0)
    # The left finger's near face: x from -27 to -17 mm, y = -8 mm, opening 34 mm.
    assert grey(image, pixel(marked, (-0.022, -0.008, -0.009))) == pytest.approx(
        0.4 * grey(without, pixel(plain, (-0.022, -0.008, -0.009))), rel=0.02
    )
    borders = {
        (-0.022, -0.008, -0.004): ((-0.022, -0.008, -0.002), (-0.022, -0.008, -0.006)),
        (-0.022, -0.008, -0.014): ((-0.022, -0.008, -0.012), (-0.022, -0.008, -0.016)),
        (-0.025, -0.008, -0.009): ((-0.0235, -0.008, -0.009), (-0.0265, -0.008, -0.009)),
    }
    for border, (start, end) in borders.items():
        a, b = pixel(marked, start), pixel(marked, end)
        expected = np.linalg.norm(pixel(marked, border) - a)
        assert crossing(image, a, b) * np.linalg.norm(b - a) == pytest.approx(expected, abs=0.35)


def test_marks_move_with_the_fingers() -> None:
    disc = FingerMark(shape="disc", from_tip_m=(0.006, 0.012), across=(0.0, 0.0), gain=2.0)
    jaw = JawScript(knots=((0.0, 0.034), (1.0, 0.02)))
    sim = simulator(plain_scenario(fingers=fingers(marks=(disc,)), jaw=jaw, fps=1.0))
    plain = simulator(plain_scenario(jaw=jaw, fps=1.0))
    for index, opening_m in ((0, 0.034), (1, 0.02)):
        brighter = sim.light(index) - plain.light(index) > 5.0
        v, u = np.nonzero(brighter[:, :384])
        centre = pixel(sim, (-0.5 * opening_m - 0.005, -0.008, -0.009), index)
        near = np.hypot(u - centre[0], v - centre[1]) < 35.0  # there is one on the inner face, too
        assert near.sum() > 300 and u[near].mean() == pytest.approx(centre[0], abs=1.5)


def test_a_worn_tip_is_shorter_and_a_rounded_one_loses_its_corners() -> None:
    plain = simulator(plain_scenario()).light(0)
    worn = simulator(plain_scenario(fingers=fingers(shape=FingerShape(wear_m=3e-4, worn_finger="left")))).light(0)
    changed = np.abs(worn - plain) > 3.0
    assert changed[:, :384].any() and not changed[:, 384:].any()
    sim = simulator(plain_scenario())
    start, end = (pixel(sim, (-0.022, -0.008, z)) for z in (0.004, -0.004))
    shares = [crossing(image, start, end) for image in (plain, worn)]
    assert (shares[1] - shares[0]) * 8e-3 == pytest.approx(3e-4, abs=6e-5)
    rounded = simulator(plain_scenario(fingers=fingers(shape=FingerShape(tip_bevel_m=1.5e-3)))).light(0)
    corner = np.round(pixel(sim, (-0.017, -0.008, 0.0)) + np.array([-3.0, 3.0])).astype(int)
    assert abs(rounded[corner[1], corner[0]] - plain[corner[1], corner[0]]) > 5.0


def test_a_bar_behind_the_tips_ends_at_its_offset_and_hides_nothing() -> None:
    bar = Prop(size_m=(0.15, 0.01, 0.01), centre_m=(0.0, 0.0, 0.02), look=ObjectLook(pattern="plain", level_dn=30.0))
    sim = simulator(plain_scenario(props=(bar,)))
    image = sim.light(0)
    start, end = pixel(sim, (0.0, -0.005, 0.010)), pixel(sim, (0.0, -0.005, 0.022))
    at = start + crossing(image, start, end) * (end - start)
    # Its lower border is that of the side that looks back at the camera: z = 15 mm, y from -5 to 5 mm.
    low, high = pixel(sim, (0.0, 0.005, 0.015)), pixel(sim, (0.0, -0.005, 0.015))
    assert min(low[1], high[1]) - 1.0 <= at[1] <= max(low[1], high[1]) + 1.0
    assert Hidden.OBJECT not in sim.truth(0).hidden
    seen = outline_seen(sim, 0)
    np.testing.assert_allclose([seen.tips, seen.edges], 1.0)


def test_a_bar_before_the_tips_hides_them_while_it_is_there() -> None:
    bar = Prop(size_m=(0.2, 0.02, 0.04), centre_m=(0.0, -0.025, -0.018), start_s=1.0, end_s=3.0)
    sim = simulator(plain_scenario(props=(bar,), fps=1.0))
    assert outline_seen(sim, 0).tips.min() == 1.0 and outline_seen(sim, 2).tips.max() == 0.0
    assert Hidden.OBJECT in sim.truth(2).hidden and Hidden.OBJECT not in sim.truth(3).hidden
    assert np.array_equal(sim.light(0), sim.light(4)) and not np.array_equal(sim.light(0), sim.light(2))


def test_copies_and_mirror_images_look_like_the_fingers() -> None:
    opening = JawScript(knots=((0.0, 0.03),))
    copies = simulator(plain_scenario(props=(Prop(shape="fingers", centre_m=(0.0, 0.0, 0.03)),), jaw=opening))
    plain = simulator(plain_scenario(jaw=opening))
    image, without = copies.light(0), plain.light(0)
    assert grey(image, pixel(copies, (-0.02, -0.008, 0.02))) == pytest.approx(
        grey(without, pixel(plain, (-0.02, -0.008, -0.01))), abs=1.0
    )
    mirror = simulator(plain_scenario(props=(Prop(shape="mirrored_fingers", centre_m=(0.0, 0.0, 0.005)),), jaw=opening))
    assert grey(mirror.light(0), pixel(mirror, (-0.02, -0.008, 0.02))) == pytest.approx(
        grey(without, pixel(plain, (-0.02, -0.008, -0.01))), abs=1.0
    )


@pytest.mark.parametrize(("pattern", "along"), [("lines_along_tips", 0), ("lines_along_fingers", 1)])
def test_lines_on_a_held_object_run_as_named(pattern: str, along: int) -> None:
    look = ObjectLook(pattern=pattern, pitch_m=0.004)  # type: ignore[arg-type]
    held = GraspedObject(size_m=(0.034, 0.03, 0.04), arrive_s=(0.0, 0.1), look=look)
    image = simulator(plain_scenario(grasped=held, fps=1.0)).light(1)
    sim = simulator(plain_scenario(grasped=held, fps=1.0))
    # The side towards the camera: y = -15 mm, z from -18 to 22 mm.
    places = [[(x, -0.015, z) for x in np.linspace(-0.014, 0.014, 15)] for z in np.linspace(-0.01, 0.018, 15)]
    greys = np.array([[grey(image, pixel(sim, place)) for place in row] for row in places])
    scatter = greys.std(axis=0).mean(), greys.std(axis=1).mean()
    assert scatter[along] > 4.0 * scatter[1 - along]


def test_a_sharp_shadow_stands_where_it_was_put() -> None:
    shadow = Shadow(start_s=0.0, end_s=1e5, width=0.3, softness=0.002, angle_deg=90.0, still_at=0.5, depth=0.6)
    sim = simulator(plain_scenario(light=Light(shadows=(shadow,)), fps=1.0))
    plain = simulator(plain_scenario(fps=1.0))
    ratio = sim.render(1)[:, 10] / np.maximum(plain.render(1)[:, 10].astype(float), 1.0)
    dark = np.flatnonzero(ratio < 0.7)
    assert len(dark) == pytest.approx(0.3 * 768, abs=4) and dark.mean() == pytest.approx(287.5, abs=2.0)
    assert np.count_nonzero((ratio > 0.45) & (ratio < 0.95)) <= 8
    assert np.array_equal(sim.render(1)[:, 10] < 100, sim.render(5)[:, 10] < 100)
