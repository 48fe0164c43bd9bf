"""The self-viewing paper's two series of twenty image pairs, its tables beside ours.

A pair is what it is in the paper: a reference calibration, a disturbance of the camera, an estimate from the image
after it, and the comparison of the tool centre point (TCP) in the camera frame with what it really is.  But

- in place of the paper's off-line calibration (plane coincidence constraint, PCC) stands the true pose of the first
  image; in place of the second such calibration, which the estimate is held against, that of the second image.  The
  printed figures contain the errors of both calibrations, ours don't;
- the camera's intrinsics and the jaw opening, the same in both images, are the true ones.

As in the paper, the corners that were *measured* in the first image serve as the model: each is projected back onto
the plane that the reference calibration gives it (equation 8, from its known height in the gripper frame), and the
update starts from these points, so that what shifts a corner in both images alike cancels.  Weights of equation (17)
and of the recalibration come from the covariances of both measurements.  The edges are sampled at every pixel; all
other settings are the monitor's defaults.  A pair in which a variant doesn't find enough corners in both images counts
as missed.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from benchmarks import kit, rendered
from benchmarks.kit import Report, Target
from gripmon.daemon.config import builtin_config, load_config
from gripmon.judge.recalibrate import RecalibrationRefused, recalibrate
from gripmon.model.camera import Camera
from gripmon.model.geometry import invert, perturb
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Image
from gripmon.simulate import Simulator, make_scenario
from gripmon.simulate.scenario import Background
from gripmon.track.differential import DegenerateGeometry, differential_update
from gripmon.track.edges import FingertipMeter, Measurement, MeasurementSettings, Patience
from gripmon.track.edges.settings import SamplingSettings

PRINTED = {
    "series1": {
        "3P-U": (0.23, 0.08, 0.38, 0.29, 0.09, 0.54),
        "4P-U": (0.02, 0.00, 0.04, 0.03, 0.01, 0.07),
        "5P-U": (0.02, 0.01, 0.05, 0.04, 0.02, 0.09),
        "4P-R": (0.07, 0.01, 0.15, 0.10, 0.01, 0.29),
        "5P-R": (0.07, 0.01, 0.17, 0.09, 0.02, 0.29),
    },
    "series2": {
        "3P-U": (0.22, 0.08, 0.54, 0.26, 0.09, 0.64),
        "4P-U": (0.02, 0.01, 0.21, 0.03, 0.02, 0.27),
        "5P-U": (0.02, 0.01, 0.24, 0.04, 0.02, 0.31),
        "4P-R": (0.09, 0.02, 0.07, 0.13, 0.03, 0.13),
        "5P-R": (0.09, 0.02, 0.09, 0.10, 0.03, 0.17),
    },
}
"""The paper's tables: mean error in camera x, y, z, then the largest, mm."""
VARIANTS = ("3P-U", "4P-U", "5P-U", "all-U", "4P-R", "5P-R", "edges")
"""The paper's variants, all corners, and all edge points at once instead of corners."""
REQUIRED, REQUIRED_SHARE, ZERO_PRINTED_MM = "4P-U", 0.25, 0.003
"""The variant whose cells must be at most a quarter of the printed ones, and below this where 0.00 is printed."""

_TITLES = {
    "series1": "Series 1, TCP moves along camera x by 1.5 ± 0.3 mm",
    "series2": "Series 2, TCP moves along camera y by 4.5 ± 0.2 mm",
}
_CELLS = ("mean x", "mean y", "mean z", "max x", "max y", "max z")
_RENDERED = "rendered series2, true jaw"
_ITERATIONS = 5
"""Linearisations of an update from the reference, some degrees away: as many as change anything."""
_SETTINGS = MeasurementSettings(sampling=SamplingSettings(samples=960))
"""A pair is not a stream of frames: edges are sampled at every pixel, for which 960 profiles suffice."""
_EVERYWHERE, _USUAL_SHARE = Patience(when_doubtful=True, when_lost=True), 0.9
_NEEDED = {"3P": 3, "4P": 4, "5P": 5, "all": 3}


class Shot(NamedTuple):
    """An image, the pose (4, 4) that is true for it, and the jaw opening."""

    image: Image
    cam_T_grip: Array
    jaw_opening_m: float


@dataclass(frozen=True)
class Series:
    """Images before and after a disturbance in turn.  ``name`` as in the paper's tables, ``scene`` in words."""

    name: str
    scene: str
    camera: Camera
    gripper: Gripper
    count: int
    shots: Callable[[], Iterator[Shot]]


@dataclass(frozen=True)
class Row:
    """One line of a table: errors of the TCP over the pairs that were ``estimated`` out of ``pairs``, mm; means in
    camera x, y, z, then maxima; None where no pair was.
    """

    series: str
    scene: str
    variant: str
    error_mm: tuple[float, ...] | None
    estimated: int
    pairs: int

    @property
    def printed_mm(self) -> tuple[float, ...] | None:
        return PRINTED[self.series].get(self.variant)

    @property
    def limit_mm(self) -> tuple[float, ...] | None:
        """What is required of each cell."""
        if self.variant != REQUIRED or self.printed_mm is None:
            return None
        return tuple(REQUIRED_SHARE * p if p > 0.0 else ZERO_PRINTED_MM for p in self.printed_mm)


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=kit.count, default=1, metavar="N", help="of everything random (default 1)")


def run(arguments: argparse.Namespace, report: Report) -> None:
    rows = tables(arguments.seed)
    report.values |= {"seed": arguments.seed, "rows": rows}
    show(rows, report)


def show(rows: list[Row], report: Report) -> None:
    """The tables in the paper's layout, ours and the printed figure in parentheses, mm; what is required of them."""
    for title in dict.fromkeys((row.series, row.scene) for row in rows):
        lines = [_line(row) for row in rows if (row.series, row.scene) == title]
        report.say(f"**{_TITLES[title[0]]}; {title[1]}**", kit.table(["ours (printed), mm", *_CELLS, "pairs"], lines))
    report.reach(target for row in rows if (target := _target(row)) is not None)


def _line(row: Row) -> list[str]:
    cells = ["—"] * 6 if row.error_mm is None else [f"{e:.4f}" for e in row.error_mm]
    if row.limit_mm is not None and row.error_mm is not None:
        over = [e > limit for e, limit in zip(row.error_mm, row.limit_mm, strict=True)]
        cells = [f"**{cell}**" if too_large else cell for cell, too_large in zip(cells, over, strict=True)]
    if row.printed_mm is not None:
        cells = [f"{cell} ({p:.2f})" for cell, p in zip(cells, row.printed_mm, strict=True)]
    return [row.variant, *cells, f"{row.estimated} of {row.pairs}"]


def _target(row: Row) -> Target | None:
    if row.limit_mm is None:
        return None
    name = f"{row.series}, {row.scene}, {row.variant}: every cell at most a quarter of the printed one"
    if row.estimated < row.pairs or row.error_mm is None:
        return Target(name, f"{row.pairs - row.estimated} of {row.pairs} pairs without an estimate", False)
    cells = zip(_CELLS, row.error_mm, row.limit_mm, strict=True)
    over = [f"{cell} {e:.4f} > {limit:.4f} mm" for cell, e, limit in cells if e > limit]
    return Target(name, ", ".join(over) or "all are", not over)


def tables(seed: int = 1) -> list[Row]:
    """All lines of all tables."""
    every, rows = all_series(seed), []
    with kit.bar("pair", sum(series.count for series in every)) as bar:
        for series in every:
            errors_mm: dict[str, list[Array]] = {variant: [] for variant in VARIANTS}
            shots = series.shots()
            for before, after in zip(shots, shots, strict=True):
                pair = MeasuredPair.measured(series.camera, series.gripper, before, after)
                for variant, errors in errors_mm.items():
                    cam_T_grip = None if pair is None else pair.estimate(variant)
                    if cam_T_grip is not None:
                        errors.append(1e3 * np.abs(cam_T_grip[:3, 3] - after.cam_T_grip[:3, 3]))
                bar.update()
            for variant, errors in errors_mm.items():
                cells = (*np.mean(errors, axis=0).tolist(), *np.max(errors, axis=0).tolist()) if errors else None
                rows.append(Row(series.name, series.scene, variant, cells, len(errors), series.count))
    return rows


def all_series(seed: int) -> list[Series]:
    """The paper's two series from the simulator, on the plate and in the air, and the rendered second one if it is
    there: by an independent renderer, even frames before, odd ones after the disturbance.
    """
    config = load_config(builtin_config("demo.yaml"), check_source=False)

    def simulated(name: str, scene: str, **changes: object) -> Series:
        scenario = msgspec.structs.replace(make_scenario(name), **changes)
        shown: Simulator = config.scene.simulator(scenario, seed)

        def shots() -> Iterator[Shot]:
            for index in range(shown.frame_count // 2 * 2):
                truth = shown.truth(index)
                yield Shot(shown.render(index), truth.cam_T_grip, truth.jaw_opening_m)

        return Series(name, scene, shown.camera, shown.gripper, shown.frame_count // 2, shots)

    def of_renderer(sequence: rendered.Rendered) -> Series:
        def shots() -> Iterator[Shot]:
            return (Shot(np.asarray(s.frame.image), s.cam_T_grip, s.jaw_opening_m) for s in sequence.shots())

        count = len(sequence.frames) // 2
        name = "independent renderer, moving clutter"
        return Series("series2", name, sequence.camera, sequence.gripper, count, shots)

    out: list[Series] = []
    for name in ("series1", "series2"):
        out += [
            simulated(name, f"`gripmon simulate {name} --seed {seed}`: parked on the plate, as in the paper"),
            simulated(name, "the same poses in the air, moving clutter behind", background=Background(kind="speckle")),
        ]
    return out + [of_renderer(sequence) for sequence in rendered.sequences(_RENDERED)]


@dataclass(frozen=True)
class MeasuredPair:
    """Both images of a pair measured; ``reference_T`` is the calibration before the disturbance."""

    gripper: Gripper
    reference_T: Array
    jaw_opening_m: float
    before: Measurement
    after: Measurement

    @classmethod
    def measured(cls, camera: Camera, gripper: Gripper, before: Shot, after: Shot) -> MeasuredPair | None:
        """Both images are measured from the reference, of the second nothing else is known; None where the gripper
        isn't found in one.
        """
        meter = FingertipMeter(camera, gripper, _SETTINGS, jaw_sigma_m=0.0)
        first, second = (
            meter.measure(shot.image, before.cam_T_grip, shot.jaw_opening_m, _USUAL_SHARE, _EVERYWHERE)
            for shot in (before, after)
        )
        if not (first.trusted and second.trusted):
            return None
        return cls(gripper, before.cam_T_grip, before.jaw_opening_m, first, second)

    def estimate(self, variant: str) -> Array | None:
        """``cam_T_grip`` (4, 4) after the disturbance; None where there are too few corners."""
        if variant == "edges":
            # Like with like here, too: the motion between what was measured before and after.
            return self.after.cam_T_grip @ invert(self.before.cam_T_grip) @ self.reference_T
        corners, _, way = variant.partition("-")
        taken = self._taken(corners)
        if np.count_nonzero(taken) < _NEEDED[corners]:
            return None
        points_cam_m = self._model_cam_m()[taken]
        measured_xy = self.after.corners.xy[taken]
        before_xy, after_xy = (m.corners.joint_covariance_xy(taken) for m in (self.before, self.after))
        covariance_xy = before_xy + after_xy
        try:
            if way == "U":
                tcp_m = self.reference_T[:3, 3]
                update = differential_update(points_cam_m, measured_xy, covariance_xy, tcp_m, _ITERATIONS)
                return perturb(self.reference_T, update.xi)
            points_grip_m = (points_cam_m - self.reference_T[:3, 3]) @ self.reference_T[:3, :3]
            return recalibrate(points_grip_m, measured_xy, covariance_xy, self.reference_T).cam_T_grip
        except (DegenerateGeometry, RecalibrationRefused):
            return None

    def _taken(self, corners: str) -> NDArray[np.bool_]:
        usable = self.before.corners.usable & self.after.corners.usable
        return self.gripper.innermost_corners(usable, None if corners == "all" else _NEEDED[corners])

    def _model_cam_m(self) -> Array:
        """(c, 3) corners measured before, where their rays meet the planes of their known heights: equation (8)."""
        z_grip_m = self.gripper.points_grip_m(self.jaw_opening_m)[self.gripper.corner_points, 2]
        normal, tcp_m = self.reference_T[:3, 2], self.reference_T[:3, 3]
        rays = np.column_stack([self.before.corners.xy, np.ones(len(z_grip_m))])
        depth_m = (z_grip_m + normal @ tcp_m) / (rays @ normal)
        return rays * depth_m[:, None]
