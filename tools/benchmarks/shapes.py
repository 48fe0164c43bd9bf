"""``tools/bench shapes``: fingers of any shape, with models from CAD, while the camera moves."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import options

_DESCRIPTION = """\
Makes gripper files from meshes, as `gripmon gripper from-cad --bevel 0` does, and tracks pictures of them: another
piece of background behind the fingers in each frame, the camera wandering on a smooth way by as much as the row says
along and about each axis, the jaws by 1 mm.  Valid: share of the frames from the second on (the first has none before
it that confirms it).  Misleading: valid and off by more than the alert limit; beyond: valid and off by more than its
own bound.  Error: median distance of the TCP from the truth, over that of sharp boxes that show as much of themselves.
Last the tapered fingers with pads of `tools/bench integrity`, whose file is made by `gripmon gripper from-images` and
taught by `gripmon teach`, through a change of the lamp, a grasp and a knock of 2 mm: 180 frames.
Takes some ten minutes."""

VALID, RATIO = 0.98, 2.0
"""To reach: share of valid frames, and error over the sharp boxes'."""

NEWCOMER, NEWCOMER_VALID = "tapered, with pads, from images", 0.90
"""Row, and share of valid frames to reach through a working day."""

MOTIONS = {"0.2 mm, 0.2°": (2e-4, 3.5e-3), "2 mm, 1°": (2e-3, 1.75e-2)}
"""How far the camera wanders: m and rad."""

LENGTH_M = 0.035
SHOWN_PX = 25.0
"""What of a finger shows that the image's border cuts."""


@dataclass(frozen=True)
class Shape:
    """Fingers and how they show: ``meshes`` of a module that is loaded late, ``beside`` which row's error is compared,
    ``fingers`` how many of them, ``tone`` two tones, ``cut`` by the image's border.
    """

    name: str
    meshes: Callable[[], list[Any]]
    beside: str
    fingers: int = 2
    tone: tuple[float, float] | None = None
    cut: bool = False


def shapes() -> list[Shape]:
    """All rows, those that others are compared with before them."""
    from benchmarks.meshes import box_fingers, curved_fingers, rounded_fingers

    def rounded(radius_m: float) -> Callable[[], list[Any]]:
        return lambda: rounded_fingers(radius_m)

    box, cut, one = "sharp box", "sharp box, cut by the border", "sharp box, one finger"
    return [
        Shape(box, box_fingers, box),
        *(Shape(f"rounded by {r} mm", rounded(1e-3 * r), box) for r in (2, 4, 8)),
        Shape("curved finger", curved_fingers, box),
        Shape("sharp box, two tones", box_fingers, box, tone=(-0.012, 0.5)),
        Shape("rounded by 4 mm, two tones", rounded(0.004), box, tone=(-0.012, 0.5)),
        Shape(cut, box_fingers, cut, cut=True),
        Shape("rounded by 2 mm, cut", rounded(0.002), cut, cut=True),
        Shape("rounded by 4 mm, cut", rounded(0.004), cut, cut=True),
        Shape(one, box_fingers, one, fingers=1),
        Shape("rounded by 4 mm, one finger", rounded(0.004), one, fingers=1),
        Shape("sharp box, one finger, two tones", box_fingers, one, fingers=1, tone=(-0.004, 0.6)),
    ]


@dataclass(frozen=True)
class Tracked:
    """What a monitor made of ``frames``: how many were valid, misleading, beyond their own bound; median error, m, of
    those with a measurement; why frames weren't valid, the most frequent reason.
    """

    frames: int
    valid: int
    misleading: int
    beyond: int
    error_m: float
    why: str


def track(shape: Shape, most_m: float, most_rad: float, frames: int, seed: int, folder: Path) -> Tracked:
    """One sequence."""
    from collections import Counter

    import numpy as np

    from benchmarks.meshes import MeshCamera, wandering, write_meshes
    from gripmon.model.camera import make_camera
    from gripmon.model.records import Frame, Origin, Verdict
    from gripmon.monitor import Monitor, MonitorSettings
    from gripmon.simulate import PAPER_LENS
    from gripmon.teach.cad import gripper_from_cad

    camera, meshes = make_camera(PAPER_LENS), shape.meshes()[: shape.fingers]
    pose = _pose(camera, shape.cut)
    jaw_range_m = (0.0, 0.06) if shape.fingers > 1 else None
    paths = write_meshes(meshes, folder)
    # The TCP stays that of both fingers, so that poses and errors are alike.
    made = gripper_from_cad(
        paths, unit="mm", jaw_range_m=jaw_range_m, camera=camera, cam_T_grip=pose, bevel_m=0.0,
        **({"length_m": LENGTH_M} if shape.fingers > 1 else {"frame": "cad"}),
    )  # fmt: skip
    gripper, settings = made.gripper, MonitorSettings()
    monitor = Monitor(camera, gripper, settings, _reference(pose))
    pictures = MeshCamera(camera, meshes, seed, shape.tone)
    errors, counts, why = [], [0, 0, 0], Counter[str]()
    for k in range(frames):
        truth_T = wandering(pose, k / frames, most_m, most_rad)
        opened_m = 0.001 * np.sin(2.0 * np.pi * k / frames) if gripper.has_jaw else 0.0
        offsets = [np.array([side * opened_m / 2.0, 0.0, 0.0]) for side in (-1.0, 1.0)[: shape.fingers]]
        opening_m = gripper.jaw_nominal_m + opened_m if gripper.has_jaw else None
        image = pictures.picture(truth_T, offsets)
        record = monitor.process(Frame(seq=k, stamp_ns=int(k / 30 * 1e9), image=image, jaw_opening_m=opening_m))
        monitor.run_pending()
        if record.cam_T_grip is None:
            why[record.reason or ""] += k > 0
            continue
        off_m = float(np.linalg.norm(np.array(record.cam_T_grip.translation_m) - truth_T[:3, 3]))
        if record.source is not Origin.HELD:
            errors.append(off_m)
        if record.verdict is Verdict.VALID:
            assert record.protection is not None
            counts[0] += k > 0
            counts[1] += off_m > settings.policy.alert_limit_m
            counts[2] += off_m > record.protection.position_m
        else:
            why[_kind(record.reason or "")] += k > 0
    commonest = why.most_common(1)[0][0] if why.total() else ""
    return Tracked(frames - 1, *counts, float(np.median(errors)) if errors else float("nan"), commonest)


def _kind(reason: str) -> str:
    """What a reason owes its bound to, without its numbers; the whole reason where it owes it to nothing."""
    return reason.rpartition("excluded that ")[2]


def _pose(camera: Any, cut: bool) -> Any:
    """The camera tilted about its x axis against the gripper, as in the paper; or moved so that the image's lower
    border leaves :data:`SHOWN_PX` of the fingers.
    """
    import numpy as np

    from gripmon.simulate import paper_cam_T_grip

    cam_T_grip = paper_cam_T_grip()
    tip = cam_T_grip[:3, :3] @ np.array([0.022, -0.008, 0.0])
    if cut:
        for _ in range(20):
            at = tip + cam_T_grip[:3, 3]
            away_px = camera.height_px - 1.0 - SHOWN_PX - camera.project(at[None])[0, 1]
            cam_T_grip[1, 3] += away_px * at[2] / camera.fy_px
    return cam_T_grip


def _reference(cam_T_grip: Any) -> Any:
    """Exact to 2 µm and 0.1 mrad."""
    import numpy as np

    from gripmon.model.geometry import to_record
    from gripmon.model.records import ReferenceRecord

    covariance = np.diag(np.square([2e-6] * 3 + [1e-4] * 3))
    return ReferenceRecord("shapes", 1, 0, "exact", to_record(cam_T_grip), tuple(covariance.ravel().tolist()))


def report(frames: int, seed: int, only: list[str]) -> Iterator[str]:
    """The table by lines, as it is measured."""
    import tempfile

    yield "| shape | camera moves by | valid | misleading | beyond | error, µm | over the box's | |"
    yield "| --- | --- | --- | --- | --- | --- | --- | --- |"
    usual: dict[tuple[str, str], float] = {}
    every = shapes()
    wanted = {name for shape in every if not only or shape.name in only for name in (shape.name, shape.beside)}
    for shape in every:
        for motion, (most_m, most_rad) in MOTIONS.items() if shape.name in wanted else ():
            with tempfile.TemporaryDirectory() as folder:
                seen = track(shape, most_m, most_rad, frames, seed, Path(folder))
            usual.setdefault((shape.name, motion), seen.error_m)
            ratio = seen.error_m / usual[shape.beside, motion]
            met = seen.valid >= VALID * seen.frames and not seen.misleading and ratio <= RATIO
            cells = [
                shape.name, motion, f"{100.0 * seen.valid / seen.frames:.0f} %", seen.misleading, seen.beyond,
                f"{1e6 * seen.error_m:.1f}", f"{ratio:.1f}", "met" if met else f"**missed** {seen.why or 'error'}",
            ]  # fmt: skip
            yield "| " + " | ".join(map(str, cells)) + " |"
    if not only or NEWCOMER in only:
        yield _newcomer(seed)


def _newcomer(seed: int) -> str:
    """The row of a gripper of which there are only images."""
    import tempfile

    from benchmarks.newcomer import day

    with tempfile.TemporaryDirectory() as folder:
        seen = day(seed, 0, Path(folder))
    met = seen.valid >= NEWCOMER_VALID * seen.frames and not seen.misleading
    return (
        f"| {NEWCOMER} | lamp, grasp, knock of 2 mm | {100.0 * seen.valid / seen.frames:.0f} % | {seen.misleading} "
        f"| {seen.beyond} | {1e6 * seen.error_m:.1f} | | {'met' if met else f'**missed** {seen.why}'} |"
    )


def add_parser(commands: Any) -> None:
    help_line = "fingers of any shape, from CAD, while the camera moves"
    parser = options.add_command(commands, "shapes", run, help_line, _DESCRIPTION, seed=True, markdown=True)
    parser.add_argument("--frames", type=options.positive, default=60, metavar="N", help="of each row (default 60)")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="only these rows, and the box's")


def run(arguments: argparse.Namespace) -> int:
    from benchmarks.machine import commit

    lines = [f"`tools/bench shapes --frames {arguments.frames} --seed {arguments.seed}`, commit {commit()}", ""]
    print(*lines, sep="\n", flush=True)
    for line in report(arguments.frames, arguments.seed, arguments.only):
        lines.append(line)
        print(line, flush=True)
    if arguments.markdown:
        arguments.markdown.write_text("\n".join(lines) + "\n", encoding="utf-8")
        print(f"written: {arguments.markdown}", file=sys.stderr)
    return 0
