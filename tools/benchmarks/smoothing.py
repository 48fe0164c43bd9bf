"""``tools/bench smoothing``: the smoothed transform beside the raw one, on streams of the three noise regimes.

Errors of frames and what they report are those of :mod:`benchmarks.noise_model`.  In quiet time the camera doesn't move
(in ``rough`` its mount vibrates, and the error is that against where it is at the time).  Then the camera steps, is
knocked so that it rings down as in the simulator's ``bump``, or creeps, along camera y at the TCP by turning about its
bracket; no one tells the average.  Raw errors are those of the same frames.
"""

from __future__ import annotations

import argparse
import copy
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

from benchmarks import options

_DESCRIPTION = """\
Root mean square error of the TCP, raw and smoothed, and the normalised error squared (NEES, 6 if the covariance is
honest): in quiet time, after steps and knocks, and in creep, no one telling the average that anything happened."""

_LEARNING_FRAMES = 3600
_EVENT_FRAMES = 180
_STEPS_MM = (0.02, 0.05, 0.1, 0.5, 4.5)
_BUMPS_MM = (0.1, 0.5, 4.5)
_CREEPS_MM_PER_MIN = (0.01, 0.1, 1.0)
WINDOWS = ((0, 1), (1, 10), (10, 60), (60, 180))
"""Frames after an event that are looked at together; the first may be an outlier and is not believed alone."""


@dataclass(frozen=True)
class Quiet:
    """Root mean square errors in camera x, y, z of the TCP, µm, and about these axes, µrad; mean NEES."""

    regime: str
    raw: tuple[float, ...]
    smoothed: tuple[float, ...]
    raw_nees: float
    smoothed_nees: float


@dataclass(frozen=True)
class Event:
    """``ratio``: root mean square error of the TCP's position, each axis in units of the raw one's, for
    :data:`WINDOWS`; ``nees``: mean of the smoothed one's, likewise.
    """

    regime: str
    what: str
    ratio: tuple[float, ...]
    nees: tuple[float, ...]


def measure(
    regime: str, streams: int, seed: int, progress: Callable[[], object] = lambda: None
) -> tuple[Quiet, list[Event]]:
    """One regime; ``progress`` is called after each stream and each event's."""
    import numpy as np

    from benchmarks.noise_model import NoiseModel

    noise = NoiseModel.load(regime).streams(streams, np.random.default_rng(seed)).next(_LEARNING_FRAMES + _EVENT_FRAMES)
    motion = np.zeros_like(noise.error) if noise.motion is None else noise.motion
    learning = slice(0, _LEARNING_FRAMES)
    averages, errors = [], []
    for k in range(streams):
        average, run = _run(None, noise.error[learning, k], motion[learning, k], noise.covariance[learning, k])
        averages.append(average)
        errors.append(run)
        progress()
    late = slice(_LEARNING_FRAMES // 2, None)
    raw, raw_nees, smoothed, nees = (np.array([getattr(e, n)[late] for e in errors]) for n in _Errors.NAMES)
    quiet = Quiet(
        regime,
        tuple((1e6 * np.sqrt((raw**2).mean(axis=(0, 1)))).tolist()),
        tuple((1e6 * np.sqrt((smoothed**2).mean(axis=(0, 1)))).tolist()),
        float(raw_nees.mean()),
        float(nees.mean()),
    )
    after, events = slice(_LEARNING_FRAMES, None), []
    for what, way in _ways().items():
        errors = []
        for k, average in enumerate(averages):
            moved = motion[after, k] + way
            errors.append(_run(copy.deepcopy(average), noise.error[after, k], moved, noise.covariance[after, k])[1])
            progress()
        raw, _, smoothed, nees = (np.array([getattr(e, n) for e in errors]) for n in _Errors.NAMES)
        ratios = []
        for first, end in WINDOWS:
            unit = np.sqrt((raw[:, first:end, :3] ** 2).mean(axis=(0, 1)))
            ratios.append(float(np.sqrt(((smoothed[:, first:end, :3] / unit) ** 2).mean())))
        events.append(Event(regime, what, tuple(ratios), tuple(float(nees[:, a:b].mean()) for a, b in WINDOWS)))
    return quiet, events


@dataclass(frozen=True)
class _Errors:
    """Of one stream: errors (frames, 6) and their squared size in units of what was claimed (frames,)."""

    raw: Any
    raw_nees: Any
    smoothed: Any
    smoothed_nees: Any

    NAMES = ("raw", "raw_nees", "smoothed", "smoothed_nees")


def _run(average: Any, error: Any, motion: Any, covariance: Any) -> tuple[Any, _Errors]:
    """A stream through an average, a new one for None: the average as it is then, and errors against the truth."""
    import numpy as np

    from benchmarks.scene import FPS, config_for
    from gripmon.judge.smoothing import PoseAverage
    from gripmon.model.geometry import from_record, perturb, perturbation_between

    config = config_for((768, 576))
    settings = config.settings.monitor
    average = PoseAverage(settings.smoothing) if average is None else average
    floor = np.diag(np.square([settings.floor_m] * 3 + [settings.floor_rad] * 3))
    nominal_T = from_record(config.reference.cam_T_grip)
    smoothed, claimed = np.empty_like(error), np.empty_like(covariance)
    for k, (own, true, reported) in enumerate(zip(error, motion, covariance, strict=True)):
        average.wander(1.0 / FPS)
        average.add(perturb(nominal_T, true + own), reported)
        smoothed[k] = perturbation_between(perturb(nominal_T, true), average.cam_T_grip)
        claimed[k] = average.claimed_covariance + floor
    return average, _Errors(error, _nees(error, covariance), smoothed, _nees(smoothed, claimed))


def _nees(error: Any, covariance: Any) -> Any:
    import numpy as np

    return (error * np.linalg.solve(covariance, error[..., None])[..., 0]).sum(axis=-1)


def _ways() -> dict[str, Any]:
    """Motions of the camera by name, perturbations (frames, 6) of the transform."""
    import numpy as np

    from benchmarks.noise_model import NoiseModel
    from benchmarks.scene import FPS
    from gripmon.simulate.disturbance import law
    from gripmon.simulate.scenario import Bump

    vibration = NoiseModel.load("rough").vibration
    assert vibration is not None, "the rough regime has one"
    along_y = np.array(vibration.per_m)[:, 1]
    time_s = np.arange(_EVENT_FRAMES) / FPS
    bump = np.array([law(Bump(at_s=0.0), t) for t in time_s.tolist()])
    laws = {"nothing": np.zeros(_EVENT_FRAMES)}
    laws |= {f"step of {mm:g} mm": np.full(_EVENT_FRAMES, 1e-3 * mm) for mm in _STEPS_MM}
    laws |= {f"knock of {mm:g} mm, rings down": 1e-3 * mm * bump for mm in _BUMPS_MM}
    laws |= {f"creep of {mm:g} mm/min": 1e-3 * mm / 60.0 * time_s for mm in _CREEPS_MM_PER_MIN}
    return {name: np.outer(values, along_y) for name, values in laws.items()}


def markdown(quiet: list[Quiet], events: list[Event]) -> str:
    """Both tables."""
    lines = [
        "| quiet time | raw x, y, z (µm) | smoothed x, y, z (µm) | NEES raw | smoothed |",
        "| --- | --- | --- | --- | --- |",
    ]
    for row in quiet:
        raw, smoothed = (", ".join(f"{v:.1f}" for v in values[:3]) for values in (row.raw, row.smoothed))
        lines.append(f"| {row.regime} | {raw} | {smoothed} | {row.raw_nees:.1f} | {row.smoothed_nees:.1f} |")
    spans = [f"frame {a}" if b == a + 1 else f"{a} to {b - 1}" for a, b in WINDOWS]
    lines += [
        "",
        f"| smoothed over raw error (NEES) | {' | '.join(spans)} |",
        f"| --- |{' --- |' * len(spans)}",
    ]
    for event in events:
        cells = [f"{ratio:.2f} ({nees:.1f})" for ratio, nees in zip(event.ratio, event.nees, strict=True)]
        lines.append(f"| {event.regime}: {event.what} | {' | '.join(cells)} |")
    return "\n".join(lines)


def add_parser(commands: Any) -> None:
    """Add the benchmark to ``tools/bench``."""
    parser = options.add_command(
        commands,
        "smoothing",
        run,
        "the smoothed transform beside the raw one: quiet time, steps, creep",
        _DESCRIPTION,
        seed=True,
        as_json="write all rows",
    )
    parser.add_argument(
        "--streams", type=options.positive, default=32, metavar="N", help="of each regime (default %(default)s)"
    )


def run(arguments: argparse.Namespace) -> int:
    """Handle ``tools/bench smoothing``."""
    from tqdm import tqdm

    from benchmarks import machine
    from benchmarks.noise_model import REGIMES

    about = machine.description()
    quiet, events = [], []
    total = len(REGIMES) * arguments.streams * (1 + len(_ways()))
    with tqdm(total=total, desc="runs", unit="run", file=sys.stderr, disable=None) as bar:
        for regime in REGIMES:
            row, rows = measure(regime, arguments.streams, arguments.seed, bar.update)
            quiet.append(row)
            events += rows
    print(f"gripmon {about['commit']}, {about['date']}, {about['cpu']}; {arguments.streams} streams a regime\n")
    rows_by_kind = {"quiet": [asdict(r) for r in quiet], "events": [asdict(e) for e in events]}
    options.deliver(arguments, "smoothing", markdown(quiet, events), {"machine": about, **rows_by_kind})
    return 0
