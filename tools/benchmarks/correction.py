"""``tools/bench correction``: the corrected transform beside the live ones, raw and smoothed, against the truth.

Streams of :mod:`benchmarks.noise_model` in which the camera steps, creeps, swings or vibrates by turning about its
bracket; the live average gets every frame as the monitor gives it.  Both see the same errors.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks import options

_DESCRIPTION = """\
Error of the TCP's position and of the rotation, live (raw, smoothed) and corrected afterwards from the whole
recording, scenario by scenario; change points found, missed and false; and whether the stated covariance is honest."""

FPS = 60.0
_START_NS = 1_700_000_000_000_000_000


@dataclass(frozen=True)
class Scenario:
    """``way(time_s, rng)`` (n,): shift of the TCP along camera y and x, m; ``steps_s``: when it changes at once."""

    name: str
    regime: str
    way: Callable[[Any, Any], Any]
    steps_s: tuple[float, ...] = ()
    gap_s: tuple[float, float] | None = None
    wild: float = 0.0
    seconds: float = 90.0


def scenarios() -> list[Scenario]:
    """All of them, with the motion in each."""
    import numpy as np

    from gripmon.simulate.disturbance import law
    from gripmon.simulate.scenario import Bump

    def still(t: Any, rng: Any) -> Any:
        return np.zeros_like(t)

    def step(mm: float, *at_s: float) -> Callable[[Any, Any], Any]:
        return lambda t, rng: 1e-3 * mm * sum((t >= s).astype(float) for s in at_s)

    def there_and_back(t: Any, rng: Any) -> Any:
        return 5e-4 * ((t >= 40.0) & (t < 41.0))

    def several(t: Any, rng: Any) -> Any:
        return sum(
            mm * 1e-3 * (t >= s) for mm, s in ((0.3, 12.0), (-0.2, 30.5), (0.08, 31.5), (1.0, 55.0), (-0.1, 70.0))
        )

    def knock(t: Any, rng: Any) -> Any:
        return 5e-4 * np.array([law(Bump(at_s=45.0), s) for s in t.tolist()])

    def line(mm_per_min: float) -> Callable[[Any, Any], Any]:
        return lambda t, rng: 1e-3 * mm_per_min / 60.0 * np.maximum(t - 20.0, 0.0)

    def thermal(t: Any, rng: Any) -> Any:
        return 3e-4 * (1.0 - np.exp(-np.maximum(t - 10.0, 0.0) / 25.0))

    def hum(t: Any, rng: Any) -> Any:
        return 5e-5 * np.sin(2.0 * np.pi * 14.0 * t) * ((t > 20.0) & (t < 70.0))

    def creep_and_step(t: Any, rng: Any) -> Any:
        return line(0.1)(t, rng) + step(0.15, 50.0)(t, rng)

    out = [Scenario("nothing", r, still) for r in ("quiet", "working", "rough")]
    out += [Scenario(f"step of {mm:g} mm", "quiet", step(mm, 45.0), (45.0,)) for mm in (0.02, 0.05, 0.5, 4.5)]
    out += [Scenario(f"step of {mm:g} mm", "working", step(mm, 45.0), (45.0,)) for mm in (0.02, 0.05, 0.5, 4.5)]
    out += [Scenario("step of 0.5 mm", "rough", step(0.5, 45.0), (45.0,))]
    out += [Scenario("five steps", r, several, (12.0, 30.5, 31.5, 55.0, 70.0)) for r in ("quiet", "working")]
    out += [Scenario("0.5 mm and back after 1 s", r, there_and_back, (40.0, 41.0)) for r in ("quiet", "working")]
    out += [Scenario("knock of 0.5 mm, rings down", r, knock, (45.0,)) for r in ("quiet", "working")]
    out += [Scenario(f"creep of {v:g} mm/min", r, line(v)) for r in ("quiet", "working") for v in (0.01, 0.1, 1.0)]
    out += [Scenario("thermal, 0.3 mm in 25 s", r, thermal) for r in ("quiet", "working")]
    out += [Scenario("creep of 0.1 mm/min and a step", "working", creep_and_step, (50.0,))]
    out += [Scenario("vibration of 50 µm, 14 Hz", r, hum) for r in ("quiet", "working")]
    out += [
        Scenario("hidden for 5 s, step meanwhile", r, step(0.3, 42.0), (42.0,), (40.0, 45.0))
        for r in ("quiet", "working")
    ]
    out += [Scenario("hidden for 5 s", "working", still, (), (40.0, 45.0))]
    out += [Scenario("1 % of the frames wrong", "working", still, wild=0.01)]
    out += [Scenario("start-up, 4 s", r, still, seconds=4.0) for r in ("quiet", "working")]
    out += [Scenario("step of 0.2 mm 1 s after the start", "quiet", step(0.2, 1.0), (1.0,), seconds=5.0)]
    return out


@dataclass(frozen=True)
class Row:
    """``rms_um``, ``p95_um``: TCP's position error; ``rms_urad``: rotation; (raw, smoothed, corrected) each.  ``nees``
    (mean, 6 if honest; raw's and corrected's) and the part within the 95 % region.  Change points in all streams.
    """

    scenario: str
    regime: str
    streams: int
    rms_um: tuple[float, float, float]
    p95_um: tuple[float, float, float]
    rms_urad: tuple[float, float, float]
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


def measure(scenario: Scenario, streams: int, seed: int, progress: Callable[[], object] = lambda: None) -> Row:
    """One scenario on several streams."""
    import numpy as np

    from benchmarks.noise_model import NoiseModel

    rng = np.random.default_rng(seed)
    count = round(scenario.seconds * FPS)
    noise = NoiseModel.load(scenario.regime).streams(streams, rng).next(count)
    parts = []
    for k in range(streams):
        vibrates = 0.0 if noise.motion is None else noise.motion[:, k]
        parts.append(_one(scenario, noise.error[:, k], vibrates, noise.covariance[:, k], rng))
        progress()
    errors = [np.concatenate([p.errors[i] for p in parts]) for i in range(3)]
    position = [1e6 * np.linalg.norm(e[:, :3], axis=1) for e in errors]
    turn = [1e6 * np.linalg.norm(e[:, 3:], axis=1) for e in errors]
    nees = [np.concatenate([p.nees[i] for p in parts]) for i in range(2)]
    off = [o for p in parts for o in p.off]
    return Row(
        scenario.name,
        scenario.regime,
        streams,
        tuple(_rms(v) for v in position),
        tuple(float(np.nanquantile(v, 0.95)) for v in position),
        tuple(_rms(v) for v in turn),
        (float(np.nanmean(nees[0])), float(nees[1].mean())),
        float((nees[1] < 12.592).mean()),
        len(scenario.steps_s) * streams,
        len(off),
        sum(p.false for p in parts),
        float(np.mean(np.abs(off))) if off else 0.0,
    )


def _rms(values: Any) -> float:
    import numpy as np

    return float(np.sqrt(np.nanmean(values**2)))


@dataclass(frozen=True)
class _Run:
    errors: tuple[Any, Any, Any]
    nees: tuple[Any, Any]
    off: list[int]
    false: int


def stream(scenario: Scenario, error: Any, vibrates: Any, rng: Any) -> tuple[Any, Any, Any, Any]:
    """Stamps (n,), true and measured poses (n, 4, 4), and which frames are measured (n,)."""
    import numpy as np

    from benchmarks.noise_model import NoiseModel
    from benchmarks.scene import config_for
    from gripmon.analyse.vectors import to_poses
    from gripmon.model.geometry import from_record

    nominal_T = from_record(config_for((768, 576)).reference.cam_T_grip)
    rough = NoiseModel.load("rough").vibration
    assert rough is not None
    time_s = np.arange(len(error)) / FPS
    way = np.outer(scenario.way(time_s, rng), np.array(rough.per_m)[:, 1]) + vibrates
    wrong = rng.random(len(error)) < scenario.wild
    seen = error + wrong[:, None] * 30.0 * error.std(axis=0) * rng.choice([-1.0, 1.0], (len(error), 6))
    true_T = to_poses(nominal_T, way)
    # The error is applied after the motion.
    measured_T = np.array([to_poses(t, s[None])[0] for t, s in zip(true_T, seen, strict=True)])
    measured = np.ones(len(error), bool)
    if scenario.gap_s is not None:
        measured &= ~((time_s >= scenario.gap_s[0]) & (time_s < scenario.gap_s[1]))
    return _START_NS + np.round(1e9 * time_s).astype(np.int64), true_T, measured_T, measured


def _one(scenario: Scenario, error: Any, vibrates: Any, covariance: Any, rng: Any) -> _Run:
    import numpy as np

    from gripmon.analyse.correction import correct

    stamp_ns, true_T, measured_T, measured = stream(scenario, error, vibrates, rng)
    live_T, raw_T = live(measured_T, covariance, measured)
    correction = correct(stamp_ns, measured_T, covariance, measured)
    errors = tuple(errors_of(true_T, T) for T in (raw_T, live_T, correction.cam_T_grip))
    raw_nees = np.where(measured, nees_of(errors[0], covariance), np.nan)
    off, false = matched(scenario, [p.index for p in correction.change_points])
    return _Run(errors, (raw_nees, nees_of(errors[2], correction.covariance)), off, false)


def live(measured_T: Any, covariance: Any, measured: Any) -> tuple[Any, Any]:
    """The smoothed and the raw transform of each frame (n, 4, 4), held where nothing is measured."""
    import numpy as np

    from benchmarks.scene import config_for
    from gripmon.judge.smoothing import PoseAverage

    average = PoseAverage(config_for((768, 576)).settings.monitor.smoothing)
    smoothed_T, raw_T = np.empty_like(measured_T), measured_T.copy()
    for k in range(len(measured_T)):
        average.wander(1.0 / FPS)
        if measured[k]:
            average.add(measured_T[k], covariance[k])
        elif k:
            raw_T[k] = raw_T[k - 1]
        smoothed_T[k] = average.cam_T_grip
    return smoothed_T, raw_T


def errors_of(true_T: Any, T: Any) -> Any:
    """(n, 6) as the covariance has them: from the estimate to the truth."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(true_T[:, :3, :3] @ np.swapaxes(T[:, :3, :3], -1, -2)).as_rotvec()
    return np.concatenate([true_T[:, :3, 3] - T[:, :3, 3], turn], axis=1)


def nees_of(error: Any, covariance: Any) -> Any:
    import numpy as np

    return (error * np.linalg.solve(covariance, error[..., None])[..., 0]).sum(axis=-1)


def matched(scenario: Scenario, indices: list[int]) -> tuple[list[int], int]:
    """Frames between each found step and the true one, and how many belong to none."""
    off, left = [], list(indices)
    for at_s in scenario.steps_s:
        true = -(-at_s * FPS // 1)
        if scenario.gap_s is not None:
            true = round(scenario.gap_s[1] * FPS)
        nearest = min(left, key=lambda k: abs(k - true), default=None)
        if nearest is not None and abs(nearest - true) <= 20:
            off.append(int(nearest - true))
            left.remove(nearest)
    return off, len(left)


def markdown(rows: list[Row]) -> str:
    """The table."""
    head = "| scenario | TCP rms, µm: raw, smoothed, corrected | 95 %, µm | rotation rms, µrad | NEES: raw, corrected "
    lines = [
        head + "| within 95 % | steps: found, false, off | better |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for r in rows:
        rms, p95, turn = (", ".join(f"{v:.3g}" for v in values) for values in (r.rms_um, r.p95_um, r.rms_urad))
        steps = f"{r.found} of {r.steps}, {r.false}" + (f", {r.off_frames:.1f}" if r.found else "")
        lines.append(
            f"| {r.regime}: {r.scenario} | {rms} | {p95} | {turn} | {r.nees[0]:.1f}, {r.nees[1]:.1f} "
            f"| {100.0 * r.within_95:.0f} % | {steps} | {'yes' if r.better else 'NO'} |"
        )
    return "\n".join(lines)


def draw(path: Path, seed: int) -> None:
    """Truth, live and corrected along camera y, of two scenarios."""
    import matplotlib.pyplot as plt
    import numpy as np

    from benchmarks.noise_model import NoiseModel
    from gripmon.analyse.correction import correct

    wanted = [s for s in scenarios() if s.regime == "working" and s.name in ("five steps", "creep of 0.1 mm/min")]
    figure, axes = plt.subplots(len(wanted), 1, figsize=(10, 7), constrained_layout=True)
    for scenario, axis in zip(wanted, axes, strict=True):
        rng = np.random.default_rng(seed)
        noise = NoiseModel.load(scenario.regime).streams(1, rng).next(round(scenario.seconds * FPS))
        covariance = noise.covariance[:, 0]
        stamp_ns, true_T, measured_T, measured = stream(scenario, noise.error[:, 0], 0.0, rng)
        correction = correct(stamp_ns, measured_T, covariance, measured)
        smoothed_T, raw_T = live(measured_T, covariance, measured)
        time_s, start_m = 1e-9 * (stamp_ns - stamp_ns[0]), true_T[0, 1, 3]
        shifts = [1e6 * (T[:, 1, 3] - start_m) for T in (raw_T, smoothed_T, true_T, correction.cam_T_grip)]
        sigma = 2e6 * np.sqrt(correction.covariance[:, 1, 1])
        axis.plot(time_s, shifts[0], color="0.8", lw=0.5, label="raw (live)")
        axis.plot(time_s, shifts[1], color="tab:orange", lw=0.9, label="smoothed (live)")
        axis.plot(time_s, shifts[2], color="black", lw=2.5, alpha=0.4, label="truth")
        axis.fill_between(time_s, shifts[3] - sigma, shifts[3] + sigma, color="tab:blue", alpha=0.25, lw=0)
        axis.plot(time_s, shifts[3], color="tab:blue", lw=1.2, label="corrected, ±2σ")
        axis.set(title=f"{scenario.regime}: {scenario.name}", xlabel="s", ylabel="TCP along camera y, µm")
        axis.legend(loc="best", fontsize=8)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def add_parser(commands: Any) -> None:
    """Add the benchmark to ``tools/bench``."""
    parser = options.add_command(
        commands,
        "correction",
        run,
        "the retroactively corrected transform beside the live ones",
        _DESCRIPTION,
        seed=True,
        as_json="write all rows",
    )
    parser.add_argument(
        "--streams", type=options.positive, default=8, metavar="N", help="of each scenario (default %(default)s)"
    )
    parser.add_argument("--only", default="", metavar="TEXT", help="scenarios whose regime: name contains it")
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="draw two scenarios instead of measuring")


def run(arguments: argparse.Namespace) -> int:
    """Handle ``tools/bench correction``."""
    from tqdm import tqdm

    from benchmarks import machine

    if arguments.picture is not None:
        draw(arguments.picture, arguments.seed)
        return 0
    about, rows = machine.description(), []
    wanted = [s for s in scenarios() if arguments.only in f"{s.regime}: {s.name}"]
    if not wanted:
        print(f"correction: --only {arguments.only}: no scenario is called so", file=sys.stderr)
        return 2
    with tqdm(total=len(wanted) * arguments.streams, unit="run", file=sys.stderr, disable=None) as bar:
        rows += [measure(scenario, arguments.streams, arguments.seed, bar.update) for scenario in wanted]
    print(f"gripmon {about['commit']}, {about['date']}, {about['cpu']}; {arguments.streams} streams a scenario\n")
    document = {"machine": about, "rows": [asdict(r) for r in rows]}
    options.deliver(arguments, "correction", markdown(rows), document)
    return 0
