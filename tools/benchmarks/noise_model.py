"""Streams of the monitor's errors at estimator level, as on simulated images: ten million frames in minutes.

In units of the reported covariance (``z = L^-1 error`` with ``covariance = L L'``) the error is a sum of a level, that
of a background that stands still, drawn again when the robot moves on to the next scene; and of parts, each a
first-order vector autoregression with its own correlation time, times the size that the errors had in one of the
measured scenes.  Their innovations are Student's, times a strength that comes in bursts.  The reported covariance is
that of the same measured scene, times a scale that wanders; a vibration of the mount is added as what it is, a motion.
All numbers were fitted to the monitor's errors on simulated images and are kept in ``data/`` beside this file; commit
a6567942 has the programs, ``noise_measured`` and ``noise_fit``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

Array = NDArray[np.float64]
Rows = tuple[tuple[float, ...], ...]

FOLDER = Path(__file__).resolve().parent / "data"
REGIMES = ("quiet", "working", "rough")


class VibrationModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``count`` lines: frequency evenly drawn, amplitude at the TCP evenly over its logarithm, in any direction across
    the optical axis; ``per_m`` (6, 2): perturbation of the transform for one metre along camera x and y.
    """

    count: int
    frequency_hz: tuple[float, float]
    amplitude_m: tuple[float, float]
    per_m: Rows


class Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``frames``: correlation time, 0 for white noise; ``variance`` (6,) and ``correlation`` (6, 6) of the axes."""

    frames: float
    variance: tuple[float, ...]
    correlation: Rows


class MeasuredScene(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``factor`` (21,): lower triangle, row by row, of a typical reported covariance's Cholesky factor; ``strength``
    (6,): root mean square of the errors about their level, in units of that of all scenes.
    """

    factor: tuple[float, ...]
    strength: tuple[float, ...]


class NoiseModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One regime.  All but ``scenes[].factor`` and ``vibration`` are in units of the reported covariance.

    Level: ``level_variance`` (6,) with ``level_correlation`` (6, 6), Student's with ``level_dof`` degrees of freedom;
    innovations of the ``parts`` with ``dof``.  Strength of innovations: ``scene_log_sd`` from scene to scene beyond
    what the measured scenes differ by, ``burst_log_sd`` within one with the correlation time ``burst_frames``.  A scene
    lasts ``scene_frames`` on average, and the change to the next one ``move_frames``.  Logarithm of the covariance's
    scale: standard deviation ``scale_log_sd``, of which the share ``scale_white`` is new in each frame and the rest has
    the correlation time ``scale_frames``.  ``measured``: statistics of what it was fitted to, in the same units:
    half the mean squared difference of frames by lag, variances of windows' means and steps, their kurtosis and tails.
    """

    regime: str
    frames_per_s: float
    level_correlation: Rows
    level_variance: tuple[float, ...]
    level_dof: float
    parts: tuple[Part, ...]
    dof: float
    scene_log_sd: float
    burst_log_sd: float
    burst_frames: float
    scene_frames: float
    move_frames: int
    scenes: tuple[MeasuredScene, ...]
    scale_log_sd: float
    scale_white: float
    scale_frames: float
    vibration: VibrationModel | None
    measured: dict[str, Any]
    provenance: dict[str, Any]

    @classmethod
    def load(cls, regime: str) -> NoiseModel:
        """The model of ``quiet``, ``working`` or ``rough``."""
        if regime not in REGIMES:
            raise ValueError(f"there is no noise regime '{regime}'; one of {', '.join(REGIMES)}")
        return msgspec.json.decode((FOLDER / f"noise_{regime}.json").read_bytes(), type=cls)

    def streams(self, count: int, rng: np.random.Generator) -> Streams:
        """``count`` independent streams, each from a stationary start."""
        return Streams(self, count, rng)


@dataclass(frozen=True)
class Noise:
    """Some frames of all streams.  ``error`` (frames, streams, 6): perturbation from the truth to the estimate;
    ``motion``: that from the nominal calibration to the truth (None where nothing vibrates); m and rad, camera axes.
    ``factor`` (frames, streams, 6, 6): lower Cholesky factor of the reported covariance.
    """

    error: Array
    motion: Array | None
    factor: Array

    @property
    def shift(self) -> Array:
        """What the monitor sees against a reference at the nominal calibration: error and motion together."""
        return self.error if self.motion is None else self.error + self.motion

    @cached_property
    def covariance(self) -> Array:
        """(frames, streams, 6, 6) as reported."""
        return self.factor @ np.swapaxes(self.factor, -1, -2)


class Streams:
    """A generator of noise; :meth:`next` goes on where the last call ended."""

    def __init__(self, model: NoiseModel, count: int, rng: np.random.Generator) -> None:
        self._model, self._count, self._rng = model, count, rng
        shape = (count, 6)
        self._level_mixing = np.linalg.cholesky(np.array(model.level_correlation))
        self._parts = [_Recursion(part.frames, shape) for part in model.parts]
        self._part_mixing = [
            np.linalg.cholesky(np.array(part.correlation)).T * np.sqrt(np.array(part.variance)) for part in model.parts
        ]
        self._level_sd = np.sqrt(np.array(model.level_variance))
        self._burst = _Recursion(model.burst_frames, (count,))
        self._scale = _Recursion(model.scale_frames, (count,))
        self._looks = np.array([(*scene.factor, *scene.strength) for scene in model.scenes])
        self._scenes = _Scenes(model.scene_frames, model.move_frames, count, rng)
        self._age = 0
        self._lines = None if model.vibration is None else _Lines(model.vibration, model.frames_per_s, count, rng)
        # From a start at zero the slowest part needs some of its correlation times to become stationary.
        for _ in range(4):
            self.next(max(round(max(model.burst_frames, *(part.frames for part in model.parts))), 1))
        self._age = 0

    def next(self, frames: int) -> Noise:
        """The next frames."""
        model, rng, count = self._model, self._rng, self._count
        begins = self._scenes.begins(frames)
        strength = self._strength(begins, frames)
        triangle, size = np.split(self._scenes.passing("look", self._draw_looks, begins), [21], axis=-1)
        z = np.zeros((frames, count, 6))
        for part, mixing in zip(self._parts, self._part_mixing, strict=True):
            z += part.run(_student(rng, model.dof, (frames, count, 6)) * strength) @ mixing
        z *= size
        z += self._scenes.passing("level", self._draw_levels, begins)
        factor = np.zeros((frames, count, 6, 6))
        rows, columns = np.tril_indices(6)
        factor[..., rows, columns] = triangle * self._scales(frames)[..., None]
        error = (factor @ z[..., None])[..., 0]
        motion = None if self._lines is None else self._lines.at(self._age, frames)
        self._age += frames
        return Noise(error, motion, factor)

    def _draw_levels(self, number: int) -> Array:
        normal = self._rng.normal(size=(number, 6)) @ self._level_mixing.T * self._level_sd
        return normal * _student_scale(self._rng, self._model.level_dof, (number, 1))

    def _draw_looks(self, number: int) -> Array:
        out: Array = self._looks[self._rng.integers(len(self._looks), size=number)]
        return out

    def _strength(self, begins: NDArray[np.bool_], frames: int) -> Array:
        """(frames, streams, 1) factor on all innovations, mean square 1."""
        model = self._model
        log = model.burst_log_sd * self._burst.run(self._rng.normal(size=(frames, self._count)))
        log += self._scenes.held("strength", lambda n: model.scene_log_sd * self._rng.normal(size=n), begins)
        return np.exp(log - (model.burst_log_sd**2 + model.scene_log_sd**2))[..., None]

    def _scales(self, frames: int) -> Array:
        """(frames, streams) factor on the reported standard deviations."""
        model, shape = self._model, (frames, self._count)
        slow = self._scale.run(self._rng.normal(size=shape))
        white = self._rng.normal(size=shape)
        log = np.sqrt(1.0 - model.scale_white) * slow + np.sqrt(model.scale_white) * white
        return np.exp(model.scale_log_sd * log)


class _Scenes:
    """When each stream's scene changes, at random once in ``scene_frames`` frames, and what is drawn again then."""

    def __init__(self, scene_frames: float, move_frames: int, count: int, rng: np.random.Generator) -> None:
        self._rate, self._count, self._rng = 1.0 / scene_frames, count, rng
        self._kernel = np.full(move_frames, 1.0 / move_frames)
        self._held: dict[str, Array] = {}
        self._passing: dict[str, Array] = {}

    def begins(self, frames: int) -> NDArray[np.bool_]:
        return self._rng.random((frames, self._count)) < self._rate

    def held(self, name: str, draw: Any, begins: NDArray[np.bool_]) -> Array:
        """(frames, streams, ...) values that hold from a scene's beginning to the next one's."""
        last = self._held.get(name)
        if last is None:
            last = draw(self._count)
        frames = len(begins)
        drawn = draw(int(np.count_nonzero(begins)))
        pool = np.concatenate([last, drawn])
        # Which of the pool: the stream's old value, or the newest one drawn for it.
        which = np.zeros(begins.shape, dtype=np.intp)
        which[begins] = np.arange(self._count, len(pool))
        which[0] = np.where(begins[0], which[0], np.arange(self._count))
        row = np.where(which > 0, np.arange(frames)[:, None], 0)
        row[0] = 0
        np.maximum.accumulate(row, axis=0, out=row)
        out: Array = pool[np.take_along_axis(which, row, axis=0)]
        self._held[name] = out[-1]
        return out

    def _smooth(self, name: str, values: Array) -> Array:
        if len(self._kernel) == 1:
            return values
        state = self._passing.get(name)
        if state is None:
            # As if the first values had held forever.
            left = np.arange(len(self._kernel) - 1, 0, -1) / len(self._kernel)
            state = left.reshape(-1, *[1] * (values.ndim - 1)) * values[0]
        out, self._passing[name] = lfilter(self._kernel, [1.0], values, axis=0, zi=state)
        return np.asarray(out)

    def passing(self, name: str, draw: Any, begins: NDArray[np.bool_]) -> Array:
        """The same, but passing over from one value to the next within ``move_frames``."""
        return self._smooth(name, self.held(name, draw, begins))


class _Recursion:
    """First-order autoregressions with variance 1 for innovations of variance 1; white for a correlation time of 0."""

    def __init__(self, frames: float, shape: tuple[int, ...]) -> None:
        self._factor = float(np.exp(-1.0 / frames)) if frames > 0.0 else 0.0
        self._state = np.zeros((1, *shape))

    def run(self, innovations: Array) -> Array:
        if not self._factor:
            return innovations
        gain = np.sqrt(1.0 - self._factor**2)
        out, self._state = lfilter([gain], [1.0, -self._factor], innovations, axis=0, zi=self._state)
        return np.asarray(out)


class _Lines:
    """Sinusoids of the mount, each stream's own."""

    def __init__(self, model: VibrationModel, frames_per_s: float, count: int, rng: np.random.Generator) -> None:
        shape = (model.count, count)
        self._radians_per_frame = 2.0 * np.pi * rng.uniform(*model.frequency_hz, shape) / frames_per_s
        self._phase = rng.uniform(0.0, 2.0 * np.pi, shape)
        angle = rng.uniform(0.0, 2.0 * np.pi, shape)
        size_m = np.exp(rng.uniform(*np.log(model.amplitude_m), shape))
        shift_m = size_m[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        self._amplitude = shift_m @ np.array(model.per_m).T

    def at(self, first: int, frames: int) -> Array:
        time = np.arange(first, first + frames)[:, None]
        return np.asarray(
            sum(
                np.sin(time * turn + phase)[..., None] * size
                for turn, phase, size in zip(self._radians_per_frame, self._phase, self._amplitude, strict=True)
            )
        )


def _student(rng: np.random.Generator, dof: float, shape: tuple[int, ...]) -> Array:
    """Student's distribution with variance 1; normal from a hundred degrees of freedom on."""
    if dof >= 100.0:
        return rng.normal(size=shape)
    return rng.standard_t(dof, size=shape) * np.sqrt((dof - 2.0) / dof)


def _student_scale(rng: np.random.Generator, dof: float, shape: tuple[int, ...]) -> Array:
    """What makes normal vectors Student's, with mean square 1."""
    if dof >= 100.0:
        return np.ones(shape)
    return np.asarray(np.sqrt((dof - 2.0) / rng.chisquare(dof, size=shape)))
