"""Errors of the monitor on simulated images of an unmoved camera, in three regimes of noise: what
:mod:`benchmarks.noise_model` is fitted to.

The demo's camera, gripper and calibration at 60 frames/s.  Every scene is a pure function of the regime, the seed and
the scene's number; it takes minutes a regime, so the series are kept in a folder outside the repository and only the
fitted model, a small file, is kept in it.

    python -m benchmarks.noise_measured DIR [--regime NAME] [--seed N]     measure (what is in DIR is not done again)
    python -m benchmarks.noise_model DIR                                   fit
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.drawn import finger_look, sensor
from benchmarks.scene import FPS, config_for
from gripmon.daemon.config import Config
from gripmon.model.geometry import from_record, perturbation_between
from gripmon.model.records import Array, Origin, Verdict
from gripmon.monitor import Monitor
from gripmon.simulate import Scenario, Simulator
from gripmon.simulate.scenario import (
    Background,
    JawScript,
    Light,
    LightStep,
    Sensor,
    Shadow,
    Vibration,
)

SIZE = (768, 576)
SEED = 1
_KINDS = ("blobs", "speckle", "stripes", "printed", "chequer", "discs")


@dataclass(frozen=True)
class Regime:
    """``changes`` draws a scene's sections of the scenario from a generator and its length, s; the first ``settling``
    frames of a scene, in which the monitor acquires, are left out.
    """

    name: str
    what: str
    scenes: int
    frames: int
    changes: Callable[[np.random.Generator, float], dict[str, Any]]
    settling: int = 15


@dataclass(frozen=True)
class Series:
    """Errors of one regime.

    ``error`` (scenes, frames, 6): perturbation from the truth to the estimate, m and rad, camera axes, NaN where
    nothing was measured; ``motion`` (the same shape): that from the nominal calibration to the truth, not zero where
    the mount vibrates, so that a frame's shift against the reference is their sum; ``covariance`` (scenes, frames, 6,
    6): as published; ``valid`` (scenes, frames): the verdict.
    """

    error: Array
    motion: Array
    covariance: Array
    valid: Array

    @classmethod
    def load(cls, path: Path) -> Series:
        with np.load(path) as arrays:
            return cls(*(arrays[name] for name in ("error", "motion", "covariance", "valid")))

    def valid_only(self) -> Series:
        """The same without the errors of frames that the monitor itself doubted."""
        error = np.where(self.valid.astype(bool)[..., None], self.error, np.nan)
        return Series(error, self.motion, self.covariance, self.valid)

    def save(self, path: Path) -> None:
        np.savez(path, error=self.error, motion=self.motion, covariance=self.covariance, valid=self.valid, fps=FPS)

    @classmethod
    def joined(cls, parts: list[Series]) -> Series:
        return cls(
            *(np.concatenate([getattr(p, n) for p in parts]) for n in ("error", "motion", "covariance", "valid"))
        )


def _background(rng: np.random.Generator, motion: str, speed_m_per_s: float) -> Background:
    return Background(
        kind=_KINDS[rng.integers(len(_KINDS))],  # type: ignore[arg-type]
        level_dn=float(rng.uniform(60.0, 180.0)),
        distance_m=float(rng.uniform(0.08, 0.25)),
        contrast=float(rng.uniform(0.4, 0.9)),
        boxes=int(rng.integers(10, 46)),
        cables=int(rng.integers(2, 15)),
        motion=motion,  # type: ignore[arg-type]
        speed_m_per_s=speed_m_per_s,
    )


def _look(rng: np.random.Generator) -> dict[str, Any]:
    return {"fingers": finger_look(rng), "sensor": sensor(rng)}


def _quiet(rng: np.random.Generator, _: float) -> dict[str, Any]:
    return {**_look(rng), "background": _background(rng, "still", 0.0)}


def _working(rng: np.random.Generator, duration_s: float) -> dict[str, Any]:
    motion = str(rng.choice(("wander", "stop_and_go", "linear")))
    shadows = tuple(
        Shadow(
            start_s=float(start_s),
            end_s=float(start_s + rng.uniform(1.5, 3.0)),
            depth=float(rng.uniform(0.2, 0.5)),
            angle_deg=float(rng.uniform(-90.0, 90.0)),
        )
        for start_s in np.arange(rng.uniform(1.0, 6.0), duration_s, 9.0)
    )
    return {
        **_look(rng),
        "background": _background(rng, motion, float(rng.uniform(0.04, 0.15))),
        "light": Light(flicker=0.02, flicker_hz=float(rng.uniform(99.5, 100.5)), shadows=shadows),
        "jaw": _cycles(rng, duration_s),
    }


def _cycles(rng: np.random.Generator, duration_s: float) -> JawScript:
    """Opens or closes within 0.6 to 1.2 s, rests for 1 to 4 s, and so on; reported exactly, as in the demo."""
    knots, t_s = [(0.0, 0.034)], 1.0
    while t_s < duration_s:
        t_s += float(rng.uniform(1.0, 4.0))
        knots.append((t_s, knots[-1][1]))
        t_s += float(rng.uniform(0.6, 1.2))
        knots.append((t_s, float(rng.uniform(0.024, 0.044))))
    return JawScript(knots=tuple(knots))


def _rough(rng: np.random.Generator, duration_s: float) -> dict[str, Any]:
    look = _look(rng)
    steps = tuple(
        LightStep(at_s=float(at_s), factor=float(np.exp(rng.uniform(-0.5, 0.5))))
        for at_s in np.arange(rng.uniform(2.0, 5.0), duration_s, 4.0)
    )
    vibrations = tuple(
        Vibration(frequency_hz=float(rng.uniform(*VIBRATION_HZ)), tcp_shift_m=vibration_m(rng)) for _ in range(2)
    )
    return {
        "fingers": look["fingers"],
        "sensor": Sensor(psf_sigma_px=look["sensor"].psf_sigma_px, jpeg_quality=int(rng.integers(70, 91))),
        "background": _background(rng, "stop_and_go", float(rng.uniform(0.08, 0.2))),
        "light": Light(
            flicker=float(rng.uniform(0.05, 0.2)),
            flicker_hz=float(rng.uniform(99.0, 101.0)),
            steps=steps,
            auto_exposure_s=0.3,
        ),
        "mount": vibrations,
    }


VIBRATION_M = (3e-6, 30e-6)
"""Smallest and largest amplitude of each of the two vibrations of a rough scene, at the TCP, camera x and y."""
VIBRATION_HZ = (8.0, 25.0)


def vibration_m(rng: np.random.Generator) -> tuple[float, float]:
    """An amplitude, evenly spread over its logarithm, in any direction."""
    size_m, angle = np.exp(rng.uniform(*np.log(VIBRATION_M))), rng.uniform(0.0, 2.0 * np.pi)
    return float(size_m * np.cos(angle)), float(size_m * np.sin(angle))


REGIMES = {
    regime.name: regime
    for regime in (
        Regime(
            "quiet", "the robot stands before a background that stands still, another one each scene", 48, 300, _quiet
        ),
        Regime("working", "robot and jaws move over clutter, light flickers by 2 %, shadows", 16, 1500, _working),
        Regime("rough", "mount vibrates, light flickers and steps, JPEG, stop and go", 14, 1500, _rough),
    )
}


def simulator(regime: Regime, seed: int, scene: int, config: Config) -> Simulator:
    """The simulator of a scene."""
    rng = np.random.default_rng([seed, list(REGIMES).index(regime.name), scene])
    duration_s = (regime.settling + regime.frames) / FPS
    sections = regime.changes(rng, duration_s)
    scenario = Scenario(name=f"{regime.name}-{scene}", duration_s=duration_s, fps=FPS, **sections)
    return config.scene.simulator(scenario, int(rng.integers(2**31)))


def measure(regime: Regime, seed: int, scene: int, step: Callable[[], object] = lambda: None) -> Series:
    """One scene, a series with one row; ``step`` is called after each frame."""
    config = config_for(SIZE)
    simulated = simulator(regime, seed, scene, config)
    monitor = Monitor(config.camera, config.gripper, config.settings.monitor, config.reference)
    nominal_T = from_record(config.reference.cam_T_grip)
    count = regime.frames
    series = Series(
        np.full((1, count, 6), np.nan), np.zeros((1, count, 6)), np.full((1, count, 6, 6), np.nan), np.zeros((1, count))
    )
    for index in range(regime.settling + count):
        record, true_T = monitor.process(simulated.frame(index)), simulated.truth(index).cam_T_grip
        step()
        k = index - regime.settling
        if k < 0:
            continue
        if monitor.reference.revision != config.reference.revision:
            raise RuntimeError(f"{regime.name}, scene {scene}: the monitor took a new reference")
        series.motion[0, k] = perturbation_between(nominal_T, true_T)
        if record.cam_T_grip is not None and record.source is Origin.UPDATE:
            series.error[0, k] = perturbation_between(true_T, from_record(record.cam_T_grip))
            series.covariance[0, k] = np.reshape(record.covariance, (6, 6))
            series.valid[0, k] = record.verdict is Verdict.VALID
    return series


def main() -> int:
    import cv2
    from tqdm import tqdm

    cv2.setNumThreads(1)
    parser = argparse.ArgumentParser(description="Measure the monitor's errors in three regimes of noise.")
    parser.add_argument("directory", type=Path, metavar="DIR", help="where the series are kept")
    parser.add_argument("--regime", choices=REGIMES, help="only this one")
    parser.add_argument("--seed", type=int, default=SEED, metavar="N", help=f"default {SEED}")
    arguments = parser.parse_args()
    folder: Path = arguments.directory
    folder.mkdir(parents=True, exist_ok=True)
    regimes = [r for r in REGIMES.values() if arguments.regime in (None, r.name)]
    # A scene of each in turn, so that there is something of all of them soon.
    work = sorted((scene / r.scenes, scene, r.name) for r in regimes for scene in range(r.scenes))
    for _, scene, name in tqdm(work, desc="scenes", unit="scene", file=sys.stderr, disable=None):
        path = folder / "scenes" / f"{name}-{arguments.seed}-{scene}.npz"
        path.parent.mkdir(exist_ok=True)
        if not path.exists():
            measure(REGIMES[name], arguments.seed, scene).save(path)
        done = [folder / "scenes" / f"{name}-{arguments.seed}-{k}.npz" for k in range(scene + 1)]
        Series.joined([Series.load(p) for p in done]).save(folder / f"{name}.npz")
    return 0


if __name__ == "__main__":
    sys.exit(main())
