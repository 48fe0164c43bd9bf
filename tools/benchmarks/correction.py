"""The corrected transform beside the live ones, raw and smoothed, against the truth.

Streams of :mod:`benchmarks.noise_model` in which the camera steps, creeps, swings or vibrates by turning about its
bracket; the live average gets every frame as the monitor gives it.  Both see the same errors.  Printed are errors of
the TCP's position and of the rotation, change points found, missed and false, and whether the stated covariance is
honest (NEES: 6 if it is).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks import kit
from benchmarks.kit import Report
from benchmarks.noise_model import NoiseModel
from benchmarks.scene import config_for
from gripmon.analyse.correction import correct
from gripmon.analyse.vectors import to_poses
from gripmon.daemon.config import Config
from gripmon.judge.smoothing import PoseAverage
from gripmon.model.geometry import from_record
from gripmon.model.records import Array
from gripmon.simulate.disturbance import law
from gripmon.simulate.scenario import Bump

FPS = 60.0
_START_NS = 1_700_000_000_000_000_000
_INSIDE_95 = 12.592
"""Chi-square of six degrees of freedom that one value in twenty exceeds."""
_NEAR_FRAMES = 20
"""A change point so near a step is that step's."""

Way = Callable[[Array], Array]


@dataclass(frozen=True)
class Scenario:
    """``way(time_s)`` (n,): shift of the TCP along camera y, m; ``steps_s``: when it changes at once."""

    name: str
    regimes: tuple[str, ...]
    way: Way
    steps_s: tuple[float, ...] = ()
    gap_s: tuple[float, float] | None = None
    wild: float = 0.0
    seconds: float = 90.0


def _steps(*steps: tuple[float, float]) -> Way:
    """Of so many mm at so many seconds."""
    return lambda t: 1e-3 * sum(mm * (t >= at_s) for mm, at_s in steps)


def _creep(mm_per_min: float) -> Way:
    return lambda t: 1e-3 * mm_per_min / 60.0 * np.maximum(t - 20.0, 0.0)


def _still(t: Array) -> Array:
    return np.zeros_like(t)


def _knock(t: Array) -> Array:
    return 5e-4 * np.array([law(Bump(at_s=45.0), s) for s in t.tolist()])


def _thermal(t: Array) -> Array:
    return 3e-4 * (1.0 - np.exp(-np.maximum(t - 10.0, 0.0) / 25.0))


def _hum(t: Array) -> Array:
    return 5e-5 * np.sin(2.0 * np.pi * 14.0 * t) * ((t > 20.0) & (t < 70.0))


def _creep_and_step(t: Array) -> Array:
    return _creep(0.1)(t) + _steps((0.15, 50.0))(t)


_BOTH = ("quiet", "working")
_FIVE = ((0.3, 12.0), (-0.2, 30.5), (0.08, 31.5), (1.0, 55.0), (-0.1, 70.0))
SCENARIOS = (
    Scenario("nothing", (*_BOTH, "rough"), _still),
    *(Scenario(f"step of {mm:g} mm", _BOTH, _steps((mm, 45.0)), (45.0,)) for mm in (0.02, 0.05, 0.5, 4.5)),
    Scenario("step of 0.5 mm", ("rough",), _steps((0.5, 45.0)), (45.0,)),
    Scenario("five steps", _BOTH, _steps(*_FIVE), tuple(at_s for _, at_s in _FIVE)),
    Scenario("0.5 mm and back after 1 s", _BOTH, _steps((0.5, 40.0), (-0.5, 41.0)), (40.0, 41.0)),
    Scenario("knock of 0.5 mm, rings down", _BOTH, _knock, (45.0,)),
    *(Scenario(f"creep of {v:g} mm/min", _BOTH, _creep(v)) for v in (0.01, 0.1, 1.0)),
    Scenario("thermal, 0.3 mm in 25 s", _BOTH, _thermal),
    Scenario("creep of 0.1 mm/min and a step", ("working",), _creep_and_step, (50.0,)),
    Scenario("vibration of 50 µm, 14 Hz", _BOTH, _hum),
    Scenario("hidden for 5 s, step meanwhile", _BOTH, _steps((0.3, 42.0)), (42.0,), (40.0, 45.0)),
    Scenario("hidden for 5 s", ("working",), _still, (), (40.0, 45.0)),
    Scenario("1 % of the frames wrong", ("working",), _still, wild=0.01),
    Scenario("start-up, 4 s", _BOTH, _still, seconds=4.0),
    Scenario("step of 0.2 mm 1 s after the start", ("quiet",), _steps((0.2, 1.0)), (1.0,), seconds=5.0),
)


@dataclass(frozen=True)
class Row:
    """``rms_um``, ``p95_um``: TCP's position error; ``rms_urad``: rotation; (raw, smoothed, corrected) each.  ``nees``
    (mean, 6 if honest; raw's and corrected's) and the part within the 95 % region.  Change points in all streams.
    """

    scenario: str
    regime: str
    streams: int
    rms_um: tuple[float, ...]
    p95_um: tuple[float, ...]
    rms_urad: tuple[float, ...]
    nees: tuple[float, float]
    within_95: float
    steps: int
    found: int
    false: int
    off_frames: float

    @property
    def better(self) -> bool:
        """Than both live ones, in position and rotation."""
        return all(v[2] < min(v[:2]) for v in (self.rms_um, self.rms_urad))

    @property
    def cells(self) -> list[str]:
        errors = [", ".join(f"{v:.3g}" for v in values) for values in (self.rms_um, self.p95_um, self.rms_urad)]
        steps = f"{self.found} of {self.steps}, {self.false}" + (f", {self.off_frames:.1f}" if self.found else "")
        honest = f"{self.nees[0]:.1f}, {self.nees[1]:.1f}"
        inside = f"{100.0 * self.within_95:.0f} %"
        return [f"{self.regime}: {self.scenario}", *errors, honest, inside, steps, "yes" if self.better else "NO"]


_HEAD = (
    "scenario", "TCP rms, µm: raw, smoothed, corrected", "95 %, µm", "rotation rms, µrad", "NEES: raw, corrected",
    "within 95 %", "steps: found, false, off", "better",
)  # fmt: skip


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=kit.count, default=1, metavar="N", help="of everything random (default 1)")
    kit.numbers(parser, streams=(8, "of each scenario"))
    parser.add_argument("--only", default="", metavar="TEXT", help="scenarios whose regime: name contains it")


def run(arguments: argparse.Namespace, report: Report) -> None:
    wanted = [(s, regime) for s in SCENARIOS for regime in s.regimes if arguments.only in f"{regime}: {s.name}"]
    if not wanted:
        raise kit.Refused(f"--only {arguments.only}: no scenario is called so")
    rows = [measure(*each, arguments.streams, arguments.seed) for each in kit.progress(wanted, "scenario")]
    report.values["rows"] = rows
    report.say(f"{arguments.streams} streams a scenario, seed {arguments.seed}")
    report.say(kit.table(_HEAD, (row.cells for row in rows)))


class _Run(NamedTuple):
    """Of one stream: errors (n, 6) raw, smoothed, corrected; NEES (n,) raw and corrected; frames between each found
    step and the true one; how many belong to none.
    """

    errors: tuple[Array, ...]
    nees: tuple[Array, ...]
    off: list[int]
    false: int


def measure(scenario: Scenario, regime: str, streams: int, seed: int) -> Row:
    """One scenario on several streams."""
    rng = np.random.default_rng(seed)
    noise = NoiseModel.load(regime).streams(streams, rng).next(round(scenario.seconds * FPS))
    vibrates = np.zeros_like(noise.error) if noise.motion is None else noise.motion
    runs = [_one(scenario, noise.error[:, k], vibrates[:, k], noise.covariance[:, k], rng) for k in range(streams)]
    errors = [np.concatenate([r.errors[i] for r in runs]) for i in range(3)]
    position, turn = ([1e6 * np.linalg.norm(e[:, part], axis=1) for e in errors] for part in (np.s_[:3], np.s_[3:]))
    raw_nees, nees = (np.concatenate([r.nees[i] for r in runs]) for i in range(2))
    off = [o for r in runs for o in r.off]
    return Row(
        scenario.name, regime, streams,
        tuple(float(kit.rms(v)) for v in position), tuple(float(np.nanquantile(v, 0.95)) for v in position),
        tuple(float(kit.rms(v)) for v in turn), (float(np.nanmean(raw_nees)), float(nees.mean())),
        float((nees < _INSIDE_95).mean()), len(scenario.steps_s) * streams, len(off), sum(r.false for r in runs),
        float(np.mean(np.abs(off))) if off else 0.0,
    )  # fmt: skip


def _one(scenario: Scenario, error: Array, vibrates: Array, covariance: Array, rng: np.random.Generator) -> _Run:
    nominal_T = from_record(_config().reference.cam_T_grip)
    time_s = np.arange(len(error)) / FPS
    rough = NoiseModel.load("rough").vibration
    assert rough is not None
    way = np.outer(scenario.way(time_s), np.array(rough.per_m)[:, 1]) + vibrates
    wrong = rng.random(len(error)) < scenario.wild
    seen = error + wrong[:, None] * 30.0 * error.std(axis=0) * rng.choice([-1.0, 1.0], (len(error), 6))
    true_T = to_poses(nominal_T, way)
    # The error is applied after the motion.
    measured_T = np.array([to_poses(t, s[None])[0] for t, s in zip(true_T, seen, strict=True)])
    measured = np.ones(len(error), bool)
    if scenario.gap_s is not None:
        measured &= ~((time_s >= scenario.gap_s[0]) & (time_s < scenario.gap_s[1]))
    stamp_ns = _START_NS + np.round(1e9 * time_s).astype(np.int64)
    smoothed_T, raw_T = live(measured_T, covariance, measured)
    correction = correct(stamp_ns, measured_T, covariance, measured)
    errors = tuple(_errors_of(true_T, T) for T in (raw_T, smoothed_T, correction.cam_T_grip))
    raw_nees = np.where(measured, kit.nees(errors[0], covariance), np.nan)
    off, false = matched(scenario, [p.index for p in correction.change_points])
    return _Run(errors, (raw_nees, kit.nees(errors[2], correction.covariance)), off, false)


@cache
def _config() -> Config:
    return config_for((768, 576))


def live(measured_T: Array, covariance: Array, measured: NDArray[np.bool_]) -> tuple[Array, Array]:
    """The smoothed and the raw transform of each frame (n, 4, 4), held where nothing is measured."""
    average = PoseAverage(_config().settings.monitor.smoothing)
    smoothed_T, raw_T = np.empty_like(measured_T), measured_T.copy()
    for k in range(len(measured_T)):
        average.wander(1.0 / FPS)
        if measured[k]:
            average.add(measured_T[k], covariance[k])
        elif k:
            raw_T[k] = raw_T[k - 1]
        smoothed_T[k] = average.cam_T_grip
    return smoothed_T, raw_T


def _errors_of(true_T: Array, T: Array) -> Array:
    """(n, 6) as the covariance has them: from the estimate to the truth."""
    turn = Rotation.from_matrix(true_T[:, :3, :3] @ np.swapaxes(T[:, :3, :3], -1, -2)).as_rotvec()
    return np.concatenate([true_T[:, :3, 3] - T[:, :3, 3], turn], axis=1)


def matched(scenario: Scenario, indices: list[int]) -> tuple[list[int], int]:
    """Frames between each found step and the true one, and how many belong to none."""
    off, left = [], list(indices)
    for at_s in scenario.steps_s:
        true = -(-at_s * FPS // 1)
        if scenario.gap_s is not None:
            true = round(scenario.gap_s[1] * FPS)
        nearest = min(left, key=lambda k: abs(k - true), default=None)
        if nearest is not None and abs(nearest - true) <= _NEAR_FRAMES:
            off.append(int(nearest - true))
            left.remove(nearest)
    return off, len(left)
