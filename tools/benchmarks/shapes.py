"""Fingers of any shape, from CAD, while the camera moves.

Makes gripper files from meshes, as `gripmon gripper from-cad --bevel 0` does, and tracks pictures of them: another
piece of background behind the fingers in each frame, the camera wandering on a smooth way by as much as the row says
along and about each axis, the jaws by 1 mm.  Valid: share of the frames from the second on (the first has none before
it that confirms it).  Misleading: valid and off by more than the alert limit; beyond: valid and off by more than its
own bound.  Error: median distance of the TCP from the truth, over that of sharp boxes that show as much of themselves.
Last the tapered fingers with pads of `tools/bench integrity`, whose file is made by `gripmon gripper from-images` and
taught by `gripmon teach`, through a change of the lamp, a grasp and a knock of 2 mm: 180 frames.
Then sets of 5 to 12 drawn stills of fingers with narrow faces: is the outline that `gripper from-images` writes right
(95 % of it within a pixel of the true one) or refused?  Takes some fifteen minutes.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks import faced, kit
from benchmarks.drawn import reference_record
from benchmarks.kit import Report
from benchmarks.meshes import MeshCamera, box_fingers, curved_fingers, rounded_fingers, wandering, write_meshes
from gripmon.model.camera import Camera, make_camera
from gripmon.model.records import Array, Frame, FrameRecord, Origin, Verdict
from gripmon.monitor import Monitor, MonitorSettings
from gripmon.simulate import PAPER_LENS, paper_cam_T_grip
from gripmon.teach.cad import gripper_from_cad

VALID, RATIO = 0.98, 2.0
"""To reach: share of valid frames, and error over the sharp boxes'."""
NEWCOMER, NEWCOMER_VALID = "tapered, with pads, from images", 0.90
"""Row, and share of valid frames to reach through a working day."""
FACED = "fingers with faces, from images"
"""Row group: sets of stills."""
MOTIONS = {"0.2 mm, 0.2°": (2e-4, 3.5e-3), "2 mm, 1°": (2e-3, 1.75e-2)}
"""How far the camera wanders: m and rad."""
LENGTH_M = 0.035
SHOWN_PX = 25.0
"""What of a finger shows that the image's border cuts."""
_EXACT = np.diag(np.square([2e-6] * 3 + [1e-4] * 3))
_HEAD = ("shape", "camera moves by", "valid", "misleading", "beyond", "error, µm", "over the box's", "")


@dataclass(frozen=True)
class Shape:
    """Fingers and how they show: ``meshes``, ``beside`` which row's error is compared, ``fingers`` how many of them,
    ``tone`` two tones, ``cut`` by the image's border.
    """

    name: str
    meshes: Callable[[], list[Any]]
    beside: str
    fingers: int = 2
    tone: tuple[float, float] | None = None
    cut: bool = False


def _rounded(mm: float) -> Callable[[], list[Any]]:
    return partial(rounded_fingers, 1e-3 * mm)


_BOX, _CUT, _ONE = "sharp box", "sharp box, cut by the border", "sharp box, one finger"
SHAPES = (
    Shape(_BOX, box_fingers, _BOX),
    *(Shape(f"rounded by {r} mm", _rounded(r), _BOX) for r in (2, 4, 8)),
    Shape("curved finger", curved_fingers, _BOX),
    Shape("sharp box, two tones", box_fingers, _BOX, tone=(-0.012, 0.5)),
    Shape("rounded by 4 mm, two tones", _rounded(4), _BOX, tone=(-0.012, 0.5)),
    Shape(_CUT, box_fingers, _CUT, cut=True),
    Shape("rounded by 2 mm, cut", _rounded(2), _CUT, cut=True),
    Shape("rounded by 4 mm, cut", _rounded(4), _CUT, cut=True),
    Shape(_ONE, box_fingers, _ONE, fingers=1),
    Shape("rounded by 4 mm, one finger", _rounded(4), _ONE, fingers=1),
    Shape("sharp box, one finger, two tones", box_fingers, _ONE, fingers=1, tone=(-0.004, 0.6)),
)
"""All rows, those that others are compared with before them."""


class Tracked(NamedTuple):
    """What a monitor made of ``frames``: how many were valid, misleading, beyond their own bound; median error, m, of
    those with a measurement; why frames weren't valid, the most frequent reason.
    """

    frames: int
    valid: int
    misleading: int
    beyond: int
    error_m: float
    why: str


class Tally:
    """Counts what a monitor makes of frames whose truth is known; the first, which none confirms, doesn't count as
    valid or not.
    """

    def __init__(self, alert_limit_m: float) -> None:
        self._limit_m, self._seen = alert_limit_m, 0
        self._errors: list[float] = []
        self._counts, self._why = [0, 0, 0], Counter[str]()

    def add(self, record: FrameRecord, true_cam_T_grip: Array) -> None:
        counted, off_m = self._seen > 0, float("nan")
        self._seen += 1
        if record.cam_T_grip is not None:
            off_m = float(np.linalg.norm(np.array(record.cam_T_grip.translation_m) - true_cam_T_grip[:3, 3]))
            if record.source is not Origin.HELD:
                self._errors.append(off_m)
        if record.verdict is not Verdict.VALID:
            # What a reason owes its bound to, without its numbers; the whole reason where it owes it to nothing.
            self._why[(record.reason or "").rpartition("excluded that ")[2]] += counted
            return
        assert record.protection is not None
        self._counts[0] += counted
        self._counts[1] += off_m > self._limit_m
        self._counts[2] += off_m > record.protection.position_m

    def tracked(self) -> Tracked:
        commonest = self._why.most_common(1)[0][0] if self._why.total() else ""
        error_m = float(np.median(self._errors)) if self._errors else float("nan")
        return Tracked(self._seen - 1, *self._counts, error_m, commonest)


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=kit.count, default=1, metavar="N", help="of everything random (default 1)")
    kit.numbers(parser, frames=(60, "of each row"), sets=(80, "of stills of fingers with faces"))
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="only these rows, and the box's")


def run(arguments: argparse.Namespace, report: Report) -> None:
    only = kit.chosen(arguments.only, [*(shape.name for shape in SHAPES), NEWCOMER, FACED])
    if made := list(kit.progress(rows(arguments.frames, arguments.seed, only), "row")):
        report.values |= {"seed": arguments.seed, "rows": [dict(zip(_HEAD, row, strict=True)) for row in made]}
        report.say(kit.table(_HEAD, made))
    if FACED in only:
        sets = list(kit.progress(faced.outcomes(arguments.sets, arguments.seed), "set", arguments.sets))
        report.values["faced"] = sets
        report.say(kit.table(faced.HEAD, faced.rows(sets)))


def rows(frames: int, seed: int, only: Sequence[str]) -> Iterator[list[str]]:
    """Cells of the table, as they are measured."""
    usual: dict[tuple[str, str], float] = {}
    wanted = {name for shape in SHAPES if shape.name in only for name in (shape.name, shape.beside)}
    for shape in SHAPES:
        for motion, (most_m, most_rad) in MOTIONS.items() if shape.name in wanted else ():
            with tempfile.TemporaryDirectory() as folder:
                seen = track(shape, most_m, most_rad, frames, seed, Path(folder))
            usual.setdefault((shape.name, motion), seen.error_m)
            ratio = seen.error_m / usual[shape.beside, motion]
            met = seen.valid >= VALID * seen.frames and not seen.misleading and ratio <= RATIO
            yield [shape.name, motion, *_cells(seen, f"{ratio:.1f}", met)]
    if NEWCOMER in only:
        from benchmarks import newcomer

        with tempfile.TemporaryDirectory() as folder:
            seen = newcomer.day(seed, 0, Path(folder))
        met = seen.valid >= NEWCOMER_VALID * seen.frames and not seen.misleading
        yield [NEWCOMER, "lamp, grasp, knock of 2 mm", *_cells(seen, "", met)]


def _cells(seen: Tracked, ratio: str, met: bool) -> list[str]:
    counts = [f"{100.0 * seen.valid / seen.frames:.0f} %", str(seen.misleading), str(seen.beyond)]
    return [*counts, f"{1e6 * seen.error_m:.1f}", ratio, "met" if met else f"**missed** {seen.why or 'error'}"]


def track(shape: Shape, most_m: float, most_rad: float, frames: int, seed: int, folder: Path) -> Tracked:
    """One sequence."""
    camera, meshes = make_camera(PAPER_LENS), shape.meshes()[: shape.fingers]
    pose = pose_of(camera, shape.cut)
    # The TCP stays that of both fingers, so that poses and errors are alike.
    gripper = gripper_from_cad(
        write_meshes(meshes, folder), unit="mm", jaw_range_m=(0.0, 0.06) if shape.fingers > 1 else None,
        camera=camera, cam_T_grip=pose, bevel_m=0.0,
        **({"length_m": LENGTH_M} if shape.fingers > 1 else {"frame": "cad"}),
    ).gripper  # fmt: skip
    settings = MonitorSettings()
    monitor = Monitor(camera, gripper, settings, reference_record(pose, _EXACT))
    pictures, tally = MeshCamera(camera, meshes, seed, shape.tone), Tally(settings.policy.alert_limit_m)
    for k in range(frames):
        truth_T = wandering(pose, k / frames, most_m, most_rad)
        opened_m = 0.001 * np.sin(2.0 * np.pi * k / frames) if gripper.has_jaw else 0.0
        offsets = [np.array([side * opened_m / 2.0, 0.0, 0.0]) for side in (-1.0, 1.0)[: shape.fingers]]
        opening_m = gripper.jaw_nominal_m + opened_m if gripper.has_jaw else None
        image = pictures.picture(truth_T, offsets)
        record = monitor.process(Frame(seq=k, stamp_ns=int(k / 30 * 1e9), image=image, jaw_opening_m=opening_m))
        monitor.run_pending()
        tally.add(record, truth_T)
    return tally.tracked()


def pose_of(camera: Camera, cut: bool) -> Array:
    """The camera tilted about its x axis against the gripper, as in the paper; or moved so that the image's lower
    border leaves :data:`SHOWN_PX` of the fingers.
    """
    cam_T_grip = paper_cam_T_grip()
    tip = cam_T_grip[:3, :3] @ np.array([0.022, -0.008, 0.0])
    for _ in range(20 if cut else 0):
        at = tip + cam_T_grip[:3, 3]
        away_px = camera.height_px - 1.0 - SHOWN_PX - camera.project(at[None])[0, 1]
        cam_T_grip[1, 3] += away_px * at[2] / camera.fy_px
    return cam_T_grip
