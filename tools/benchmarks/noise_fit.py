"""Fits :mod:`benchmarks.noise_model` to the series of :mod:`benchmarks.noise_measured`, and compares the two.

Second moments first: the variances of the level and of the parts by non-negative least squares on all that describes
them: half the mean squared difference at many lags, variances of window means and of their differences.  (A vector
autoregression of order 8 has no memory beyond some tens of frames, and windows of a thousand frames are what a drift
test lives on; fitted to what such parts leave over, it was unstable from order 3 on.)
Then the tails: how much the innovations' strength differs between scenes and within them, and Student's degrees of
freedom, so that large changes are at least as frequent as in the measured series.

    python -m benchmarks.noise_fit DIR        DIR: where noise_measured put its series
"""

from __future__ import annotations

import argparse
import itertools
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from scipy.optimize import nnls

from benchmarks import machine
from benchmarks.noise_measured import FPS, REGIMES, SEED, SIZE, VIBRATION_HZ, VIBRATION_M, Series
from benchmarks.noise_model import FOLDER, Array, MeasuredScene, NoiseModel, Part, VibrationModel
from benchmarks.noise_statistics import LAGS, Statistics, mean, statistics, whitened
from benchmarks.scene import config_for
from gripmon.model.geometry import from_record, perturbation_between
from gripmon.simulate.disturbance import about_pivot, full_motion
from gripmon.simulate.scenario import MountMotion, Scenario

TIMES = (0.0, 0.7, 1.5, 3.0, 6.0, 12.0, 24.0, 48.0, 96.0, 200.0, 500.0)
"""Correlation times on offer, frames, beginning with white noise; those that aren't needed get no variance."""
_SLOW = 10.0
_STAND_FRAMES = {"quiet": 1200.0, "working": 1500.0, "rough": 1500.0}
"""How long a scene lasts: 20 s before each background where the robot stands; elsewhere, as long as it was measured."""
_MOVE_FRAMES = {"quiet": 36, "working": 60, "rough": 60}


@dataclass(frozen=True)
class _Moments:
    """Variances by axis: ``level`` (6,), ``parts`` (k, 6) with correlation times ``frames`` (k,)."""

    level: Array
    frames: Array
    parts: Array


def fit(
    regime: str, series: Series, level_dof: float, provenance: dict[str, Any], tail_scenes: int = 200
) -> NoiseModel:
    """All numbers of a regime; levels are Student's with this many degrees of freedom, and tails are compared on this
    many simulated scenes.
    """
    z, factors = whitened(series)
    measured = statistics(z)
    moments = _moments(measured)
    level = np.nanmean(z, axis=1)
    about_level = z - level[:, None]
    slow = _correlation(about_level.reshape(-1, 6))
    fast = _correlation(np.diff(z, axis=1).reshape(-1, 6))
    scale_sd, scale_white, scale_frames = _scale(factors)
    model = NoiseModel(
        regime=regime,
        frames_per_s=FPS,
        level_correlation=_rows(_correlation(level)),
        level_variance=tuple(_short(moments.level)),
        parts=tuple(
            Part(frames, tuple(_short(variance)), _rows(slow if frames > _SLOW else fast))
            for frames, variance in zip(moments.frames.tolist(), moments.parts, strict=True)
        ),
        level_dof=level_dof,
        dof=200.0,
        scene_log_sd=0.1,
        burst_log_sd=_bursts(z),
        burst_frames=32.0,
        scene_frames=_STAND_FRAMES[regime],
        move_frames=_MOVE_FRAMES[regime],
        scenes=_scenes(about_level, factors),
        scale_log_sd=scale_sd,
        scale_white=scale_white,
        scale_frames=scale_frames,
        vibration=_vibration() if regime == "rough" else None,
        measured=measured.as_dict(),
        provenance=provenance,
    )
    return _with_tails(model, measured, tail_scenes)


def _moments(measured: Statistics) -> _Moments:
    """Non-negative least squares by axis, every equation in units of its measured value; those in which the model is
    the milder one count more and more.
    """
    factor = np.exp(-1.0 / np.maximum(TIMES, 1e-3))
    structure = np.array([*(1.0 - factor[:, None] ** LAGS), np.zeros_like(LAGS)]).T
    means = np.array([_mean_variance(factor, n) for n in measured.windows])
    steps = np.array([_step_variance(factor, n) for n in measured.windows])
    equations = np.concatenate([structure[: len(measured.structure)], means, steps[: len(measured.step_variance)]])
    found = []
    for axis in range(6):
        target = np.concatenate(
            [measured.structure[:, axis], measured.mean_variance[:, axis], measured.step_variance[:, axis]]
        )
        scaled, weight = equations / target[:, None], np.ones(len(target))
        for _ in range(40):
            variance, _ = nnls(scaled * weight[:, None], weight)
            weight = np.where(scaled @ variance < 1.0, np.minimum(1.3 * weight, 100.0), weight)
        found.append(variance)
    columns = np.array(found).T
    used = columns[:-1].max(axis=1) > 0.0
    return _Moments(columns[-1], np.array(TIMES)[used], columns[:-1][used])


def _mean_variance(factor: Array, n: int) -> Array:
    """Variance of the mean of n frames: of first-order autoregressions with variance 1, and of a level."""
    k = np.arange(1, n)
    parts = (n + 2.0 * ((n - k) * factor[:, None] ** k).sum(axis=1)) / n**2
    return np.array([*parts, 1.0])


def _step_variance(factor: Array, n: int) -> Array:
    """Half the mean squared difference of neighbouring windows' means."""
    both = _mean_variance(factor, 2 * n)
    out: Array = 2.0 * (_mean_variance(factor, n) - both)
    return out


def _correlation(values: Array) -> Array:
    """(6, 6) about zero; rows that aren't known are left out."""
    known = values[np.isfinite(values[:, 0])]
    second = known.T @ known
    size = np.sqrt(second.diagonal())
    out: Array = second / np.outer(size, size)
    return out


def level_freedom(series: Series) -> float:
    """Student's degrees of freedom for scenes' levels, from their kurtosis, 3 + 6 / (n - 4), by the axis with the
    largest.
    """
    level = np.nanmean(whitened(series)[0], axis=1)
    kurtosis = float(np.max(np.mean(level**4, axis=0) / np.mean(level**2, axis=0) ** 2))
    return 200.0 if kurtosis <= 3.0 else round(min(4.0 + 6.0 / (kurtosis - 3.0), 200.0), 1)


def _bursts(z: Array) -> float:
    """Spread of the logarithm of the frame-to-frame changes' size from block to block within a scene."""
    steps, block = np.diff(z, axis=1), 32
    blocks = steps.shape[1] // block
    squares = mean(steps[:, : blocks * block].reshape(len(z), blocks, block * 6) ** 2, (2,))
    logs = 0.5 * np.log(squares)
    # The scatter of a block of this many changes.
    own = 0.5 / (block * 6 / 2.0)
    within = float(np.nanvar(logs - np.nanmean(logs, axis=1, keepdims=True)))
    return round(float(np.sqrt(max(within - own, 0.0))), 4)


def _scale(factors: Array) -> tuple[float, float, float]:
    """Standard deviation of the log scale of reported covariances within a scene, the share of it that is new in every
    frame, and the correlation time of the rest.
    """
    logs = np.log(np.einsum("...ii->...i", factors)).mean(axis=-1)
    logs = logs - np.nanmean(logs, axis=1, keepdims=True)
    variance = float(np.nanmean(logs**2))
    known = {k: float(np.nanmean(logs[:, k:] * logs[:, :-k])) / variance for k in (2, 16)}
    if known[2] < 0.05:
        return round(variance**0.5, 4), 1.0, 1.0
    frames = 14.0 / max(float(np.log(known[2] / max(known[16], 1e-3))), 0.05)
    share = min(known[2] * float(np.exp(2.0 / frames)), 1.0)
    return round(variance**0.5, 4), round(1.0 - share, 4), round(frames, 2)


def _scenes(about_level: Array, factors: Array) -> tuple[MeasuredScene, ...]:
    """Each scene's factor in the frame whose scale is the scene's median, and the size of its errors."""
    logs = np.log(np.einsum("...ii->...i", factors)).mean(axis=-1)
    middle = np.nanargmin(np.abs(logs - np.nanmedian(logs, axis=1, keepdims=True)), axis=1)
    size = np.sqrt(mean(about_level**2, (1,)))
    size /= np.sqrt(np.mean(size**2, axis=0))
    lower = np.tril_indices(6)
    return tuple(
        MeasuredScene(tuple(_short(factors[k, frame][lower])), tuple(_short(size[k])))
        for k, frame in enumerate(middle.tolist())
    )


def _vibration() -> VibrationModel:
    """The lines as :mod:`benchmarks.noise_measured` draws them; the perturbation is linear in so small shifts."""
    nominal_T = from_record(config_for(SIZE).reference.cam_T_grip)
    pivot_m, small_m = np.array(Scenario().pivot_cam_m), 1e-5
    columns = []
    for shift in ((small_m, 0.0), (0.0, small_m)):
        turn, along = full_motion(MountMotion(tcp_shift_m=shift), pivot_m, nominal_T[:3, 3])
        columns.append(perturbation_between(nominal_T, about_pivot(turn, along, pivot_m) @ nominal_T) / small_m)
    return VibrationModel(2, VIBRATION_HZ, VIBRATION_M, _rows(np.array(columns).T))


def _with_tails(model: NoiseModel, measured: Statistics, scenes: int) -> NoiseModel:
    """The mildest tails of those on offer that are not milder than the measured ones, seen over all axes and scales."""
    best, smallest = model, np.inf
    for dof, wilder in itertools.product((200.0, 12.0, 8.0, 6.0, 5.0), (0.7, 1.0, 1.25, 1.5, 1.75)):
        tried = msgspec.structs.replace(
            model,
            dof=dof,
            burst_log_sd=round(wilder * model.burst_log_sd, 4),
        )
        shares = simulated(tried, scenes).tails / measured.tails
        # Too mild costs the contract, too wild only delay.
        logs = np.log(shares)
        loss = float(np.mean(np.where(logs < 0.0, 6.0 * logs**2, logs**2)))
        if loss < smallest:
            best, smallest = tried, loss
    return best


def simulated(model: NoiseModel, scenes: int, seed: int = 1) -> Statistics:
    """Statistics of the model's own streams, as long as the measured ones and like them each of one scene only."""
    single = msgspec.structs.replace(model, scene_frames=1e12)
    frames = model.provenance["frames_per_scene"]
    noise = single.streams(scenes, np.random.default_rng(seed)).next(frames)
    z = np.linalg.solve(noise.factor, noise.error[..., None])[..., 0]
    return statistics(np.swapaxes(z, 0, 1))


def table(model: NoiseModel, own: Statistics) -> str:
    """Measured statistics beside the model's own: mean over the axes, and the smallest and largest ratio of any."""
    measured = Statistics.from_dict(model.measured)
    times = ", ".join(f"{part.frames:g}" for part in model.parts)
    tails = f"Student's {model.dof:g} degrees of freedom, {model.level_dof:g} for levels, bursts {model.burst_log_sd}"
    lines = [
        f"**{model.regime}**: parts with correlation times of {times} frames, {tails}",
        "",
        "| frames | mean's variance | ratio | step's variance | ratio | kurtosis | model's | 99.9 % | model's |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for k, n in enumerate(measured.windows):
        cells = [
            str(n),
            f"{measured.mean_variance[k].mean():.3f}",
            _ratio(own.mean_variance[k] / measured.mean_variance[k]),
        ]
        if k < len(measured.step_variance):
            ratio = own.step_variance[k] / measured.step_variance[k]
            cells += [f"{measured.step_variance[k].mean():.4f}", _ratio(ratio)]
            cells += [f"{measured.kurtosis[k]:.1f}", f"{own.kurtosis[k]:.1f}"]
            cells += [f"{measured.tails[k, -1]:.2f}", f"{own.tails[k, -1]:.2f}"]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _ratio(values: Array) -> str:
    return f"{values.mean():.2f} ({values.min():.2f}–{values.max():.2f})"


def _short(values: Array) -> list[float]:
    return [float(f"{v:.5g}") for v in np.asarray(values).ravel()]


def _rows(matrix: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(_short(row)) for row in matrix)


def main() -> int:
    parser = argparse.ArgumentParser(description="Fit the noise models to measured series.")
    parser.add_argument("directory", type=Path, metavar="DIR", help="where benchmarks.noise_measured put its series")
    folder: Path = parser.parse_args().directory
    FOLDER.mkdir(exist_ok=True)
    # Single frames that the monitor itself holds for doubtful don't reach its drift test.
    measured = {regime: Series.load(folder / f"{regime}.npz").valid_only() for regime in REGIMES}
    # A level is the same thing in all regimes, and the quiet one has the most scenes.
    level_dof = level_freedom(measured["quiet"])
    for regime, about in REGIMES.items():
        series = measured[regime]
        provenance = {
            "what": about.what,
            "measured_by": f"python -m benchmarks.noise_measured DIR --seed {SEED}",
            "scenes": series.error.shape[0],
            "frames_per_scene": series.error.shape[1],
            "measured_frames": int(np.isfinite(series.error[..., 0]).sum()),
            "commit": machine.description()["commit"],
        }
        model = fit(regime, series, level_dof, provenance)
        (FOLDER / f"noise_{regime}.json").write_bytes(msgspec.json.format(msgspec.json.encode(model), indent=1) + b"\n")
        print(table(model, simulated(model, 600, seed=2)), end="\n\n", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
