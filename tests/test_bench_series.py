"""``tools/bench series`` in small: pairs of plain pictures, what cancels between them, and what a table says."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from support.simulated import plain_scenario, simulator

from gripmon.simulate.scenario import Pairs

METHOD = Path(__file__).resolve().parent.parent.parent / "shared" / "method.md"
VARIANTS = ("3P-U", "4P-U", "5P-U", "all-U", "4P-R", "5P-R", "edges")

pytestmark = pytest.mark.usefixtures("tools_importable")


def plain_pairs(tcp_shift_m: tuple[float, float], count: int = 2):
    """A series without texture, noise and clutter."""
    from benchmarks.pairs import SimulatedSeries

    scenario = plain_scenario(duration_s=20.0 * count, fps=0.1, pairs=Pairs(tcp_shift_m=tcp_shift_m))
    return SimulatedSeries("series2", "plain", simulator(scenario))


@pytest.mark.slow("5 s: a benchmark in small; the variants are tested with the differential update")
@pytest.mark.parametrize("tcp_shift_m", [(1.5e-3, 0.0), (0.0, 4.5e-3)], ids=["aside", "down"])
def test_every_variant_finds_the_true_tcp_in_plain_pictures(tcp_shift_m: tuple[float, float]):
    from benchmarks import pairs

    steps = []
    errors_mm = pairs.measure(plain_pairs(tcp_shift_m), VARIANTS, lambda: steps.append(1))
    assert len(steps) == 2
    for variant in VARIANTS:
        assert len(errors_mm[variant]) == 2, variant
        assert np.abs(errors_mm[variant]).max() < (0.02 if variant == "3P-U" else 0.01), variant


@pytest.mark.slow("5 s: a benchmark in small; the variants are tested with the differential update")
def test_what_shifts_a_corner_in_both_images_cancels():
    """Half a pixel at every corner, another way at each."""
    from benchmarks import pairs

    series = plain_pairs((0.0, 4.5e-3), 1)
    [(before, after)] = series.pairs()
    pair = pairs.MeasuredPair.measured(series.camera, series.gripper, before, after)
    assert pair is not None
    shift_xy = np.random.default_rng(1).normal(scale=0.5 / 962.0, size=pair.before.corners.xy.shape)

    def shifted(measurement):
        corners = dataclasses.replace(measurement.corners, xy=measurement.corners.xy + shift_xy)
        return dataclasses.replace(measurement, corners=corners)

    both = dataclasses.replace(pair, before=shifted(pair.before), after=shifted(pair.after))
    one = dataclasses.replace(pair, after=shifted(pair.after))
    for variant in ("4P-U", "5P-U", "4P-R"):
        here, there, wrong = (p.estimate(variant)[:3, 3] for p in (pair, both, one))
        assert np.abs(there - here).max() < 0.1 * np.abs(wrong - here).max()
        assert np.abs(wrong - here).max() > 2e-5


def test_too_few_corners_give_no_estimate():
    from benchmarks import pairs

    series = plain_pairs((1.5e-3, 0.0), 1)
    [(before, after)] = series.pairs()
    pair = pairs.MeasuredPair.measured(series.camera, series.gripper, before, after)
    few = np.zeros_like(pair.before.corners.usable)
    few[np.flatnonzero(pair.before.corners.usable)[:3]] = True
    pair = dataclasses.replace(
        pair, after=dataclasses.replace(pair.after, corners=dataclasses.replace(pair.after.corners, usable=few))
    )
    assert pair.estimate("4P-U") is None and pair.estimate("5P-R") is None
    assert pair.estimate("edges") is not None


# --- the tables ---


@pytest.mark.skipif(not METHOD.is_file(), reason="../shared/method.md is not there")
def test_printed_figures_are_those_of_the_paper():
    from benchmarks import series

    parts = METHOD.read_text().split("Series ")[1:3]
    for name, text in zip(("series1", "series2"), parts, strict=True):
        for variant, line in series.PRINTED[name].items():
            assert f"| {variant} | {' | '.join(f'{value:.2f}' for value in line)} |" in text
