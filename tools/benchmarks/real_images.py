"""Real grippers' files made of their own images by ``gripmon gripper from-images``, for ``tools/bench real``."""

from __future__ import annotations

import math
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import yaml

from benchmarks import kit
from benchmarks.kit import Report
from benchmarks.machine import ROOT
from benchmarks.outlines import Beside, beside, drawn_outlines, projected_outline
from benchmarks.real import untrue, way
from benchmarks.real_figures import Figures
from benchmarks.real_runs import CONFIG, Limit, Run
from gripmon.daemon.calibrations import camera_in, pose_in
from gripmon.daemon.config import read_gripper
from gripmon.io.sources.files import TIMESTAMPS_NAME
from gripmon.model.camera import make_camera
from gripmon.model.errors import InputError
from gripmon.model.images import image_paths

DRAWN = ROOT / "tests" / "data" / "real_outlines.json"
WITHIN_PX = 1.0
"""To reach: 95 % of the written outline is as near to what was drawn by hand."""
LEAST_COVERED = 0.5
"""Of the drawn outline, by the written one: with less it isn't these fingers' outline."""
_VIDEO_HZ = 30.0
_VIDEO: dict[str, Any] = {
    "robot": "umi",
    "camera_name": "cam",
    "camera": {
        "model": "fisheye",
        "width_px": 960,
        "height_px": 880,
        "fx_px": 346.0,
        "fy_px": 346.0,
        "cx_px": 480.0,
        "cy_px": 438.0,
        "coefficients": [-0.02196, -0.01896, 0.00169, -0.00017],
    },
    "source": {"kind": "folder", "path": ".", "fps": _VIDEO_HZ},
    "monitor": {"drift": {"frames_per_s": _VIDEO_HZ}, "recalibration": {"mode": "off"}},
    "publish": {"enabled": False},
    "recording": {"enabled": False},
}
"""The configuration of ``umi_left``, which has none; of the lens what its README says."""


_BESIDE_PLATE = ("--within", "300,560,476,715", "--within", "508,560,672,715")
"""Where the fingers of ``umi_left`` are: no image tells them from the plate that they hold in all of them."""


@dataclass(frozen=True)
class Task:
    """How a set's file is made, ``options`` of the command, and what it is to reach.

    Alert limit and ``play`` (how far an image may really be from where the gripper was) in metres, or
    ``of_distance``; the limit of rotation in rad; ``least``: share of the images that count.
    """

    options: tuple[str, ...]
    limit: tuple[float, float]
    least: float
    play: float
    of_distance: bool = False
    values: dict[str, Any] = field(default_factory=dict)


def tasks(limits: dict[str, tuple[float, float]], play_m: float) -> dict[str, Task]:
    """By folder; ``limits`` and play as for the files made by hand, whose distance is the one stated here."""
    return {
        "xarm": Task(("--distance", "0.24:0.005"), limits["xarm"], 14 / 24, play_m),
        "piper": Task(("--distance", "0.15:0.005", "--fingers", "1"), limits["piper"], 9 / 13, play_m),
        # Nothing says how large this gripper is.  The marks on its mounts move by up to 2 px of 346 in the video.
        "umi_left": Task(_BESIDE_PLATE, (0.025, math.radians(8.0)), 0.6, 2.0 / 346.0, of_distance=True, values=_VIDEO),
    }


@dataclass(frozen=True)
class Made:
    """What the command answered for a set, and how far its outline is beside the drawn one, where one is drawn;
    ``folder``: where the file, its configuration and the images are, if it can be used; ``of_video``: made of the
    video as it is.
    """

    name: str
    of_video: bool
    code: int
    took_s: float
    words: tuple[str, ...]
    folder: Path | None = None
    distance_m: float = math.nan
    off: Beside | None = None

    @property
    def row(self) -> str:
        """Its name in the table."""
        return f"{self.name}, the video itself" if self.of_video else self.name


class Answer(NamedTuple):
    """A command's exit code and its lines: of what it printed, or of its fault."""

    code: int
    words: tuple[str, ...]
    took_s: float


def answered(*words: str | Path, without: Sequence[Path] = ()) -> Answer:
    """``gripmon`` with these arguments, in a process of its own; ``without``: folders that its lines needn't name."""
    begun_s = time.monotonic()
    answer = subprocess.run(
        [sys.executable, "-P", "-m", "gripmon", *map(str, words)], capture_output=True, text=True, check=False
    )
    said = answer.stdout if answer.returncode == 0 else answer.stderr
    for folder in without:
        said = said.replace(f"{folder}/", "")
    lines = tuple(line for line in said.splitlines() if line.strip())
    return Answer(answer.returncode, lines, time.monotonic() - begun_s)


def camera_file(lens: dict[str, Any]) -> str:
    """A lens as `gripmon calibrate` writes one whose uncertainty isn't known."""
    provenance = {"gripmon": "", "time": "", "command": "what the lens is said to be"}
    schema = "gripmon.camera_calibration/1"
    return yaml.safe_dump(
        {"schema": schema, "camera": lens, "parameters": [], "covariance": [], "provenance": provenance}
    )


def made_from_images(name: str, folder: Path, place: Path, task: Task, of_video: bool = False) -> Made:
    """Run the command on a folder's stills, or on a video's frames as files; ``of_video``: on the video as it is.
    Raises :class:`~gripmon.InputError` for a folder that has neither.
    """
    stills = place / "stills"
    stills.mkdir(parents=True)
    values = dict(task.values) or yaml.safe_load((folder / CONFIG).read_text())
    camera, gripper, reference = (stills / f"{what}.yaml" for what in ("camera", "gripper", "reference"))
    camera.write_text(camera_file(values["camera"]))
    videos = sorted(folder.glob("*.mp4"))
    _lay_out(folder, videos, stills)
    of = videos if of_video else [stills]
    options = ("--camera", camera, "--out", gripper, "--reference-out", reference, *task.options)
    answer = answered("gripper", "from-images", *of, *options, without=(stills, folder))
    if answer.code != 0:
        return Made(name, of_video, answer.code, answer.took_s, answer.words[-1:])
    try:
        return _measured(Made(name, of_video, 0, answer.took_s, answer.words, stills), values)
    except InputError as unusable:
        return Made(name, of_video, 0, answer.took_s, (str(unusable).replace(f"{stills}/", ""),))


def _measured(made: Made, values: dict[str, Any]) -> Made:
    """As a project with these values: with the distance of the TCP (m, or in units of a size that isn't known), and
    the outline's.
    """
    assert made.folder is not None
    gripper = read_gripper(made.folder / "gripper.yaml")
    files = {what: f"{what}.yaml" for what in ("camera", "gripper", "reference")}
    values = {key: value for key, value in values.items() if key != "jaw"} | files
    if gripper.has_jaw:
        told = (made.folder / TIMESTAMPS_NAME).is_file()
        values["jaw"] = {"source": "frames"} if told else {"source": "fixed", "opening_m": gripper.jaw_nominal_m}
    (made.folder / CONFIG).write_text(yaml.safe_dump(values))
    camera = make_camera(camera_in(made.folder / "camera.yaml").lens)
    cam_T_grip = pose_in(made.folder / "reference.yaml")[0]
    drawn = drawn_outlines(DRAWN, made.name)
    off = None if drawn is None else beside(drawn, projected_outline(gripper, camera, cam_T_grip))
    return replace(made, distance_m=float(cam_T_grip[2, 3]), off=off)


def _lay_out(folder: Path, videos: Sequence[Path], stills: Path) -> None:
    """The images and their table as a project has them; a video's frames as files."""
    if not videos:
        tables = [path for path in (folder / TIMESTAMPS_NAME,) if path.is_file()]
        for path in [*image_paths([folder]), *tables]:
            (stills / path.name).symlink_to(path.resolve())
        return
    count = 0
    for video in videos:
        stream = cv2.VideoCapture(str(video))
        while (frame := stream.read())[0]:
            # Least compression: they are read once or twice.
            cv2.imwrite(str(stills / f"{count:06d}.png"), frame[1], [cv2.IMWRITE_PNG_COMPRESSION, 1])
            count += 1
        stream.release()


def runs_of_made(
    made: Made, task: Task, runs_of: Callable[[str, Path, Limit], Any]
) -> tuple[list[Run], float, str | None]:
    """Its replays at the limits for the distance that its reference has; the play (m); why its file can't be used."""
    if made.folder is None:
        return [], 0.0, None
    scale_m = made.distance_m if task.of_distance else 1.0
    try:
        found = list(runs_of(made.name, made.folder, Limit(scale_m * task.limit[0], task.limit[1])))
    except InputError as refused:
        return [], 0.0, str(refused).replace(f"{made.folder}/", "")
    return found, scale_m * task.play, None


_HEAD = (
    "set", "exit code", "s", "distance", "written off drawn, px", "drawn off written, px", "drawn within 1 px",
)  # fmt: skip


def say_made(every: Sequence[Made], report: Report) -> None:
    """A row for each set, distances of outlines in the median and at 95 %; below it what the command said."""
    lines = []
    for made in every:
        cells = [made.row, str(made.code), f"{made.took_s:.0f}"]
        cells.append("" if math.isnan(made.distance_m) else f"{made.distance_m:.4g}")
        off = made.off
        if off is None:
            cells.append("nothing usable" if made.folder is None else "nothing drawn")
        else:
            cells += [f"{median:.2f}, {most:.2f}" for median, most in (off.written, off.drawn)]
            cells.append(f"{kit.percent(off.covered, 0)} %")
        lines.append(cells)
    report.say(kit.table(_HEAD, lines), "\n".join(f"- {made.row}: {line}" for made in every for line in made.words))


def missed_from_images(made: Made, task: Task, found: Sequence[tuple[Run, Figures]], play_m: float) -> list[str]:
    """What one set was to reach and didn't: a gripper, its outline, and ``valid`` by the motion since the reference."""
    if made.folder is None:
        return [f"{made.row}, from images: exit code {made.code}: {' '.join(made.words) or 'without a word'}"]
    out = []
    if made.off is not None:
        if not made.off.written[1] <= WITHIN_PX:
            out.append(f"outline: 95 % within {made.off.written[1]:.2f} px of what was drawn; {WITHIN_PX:g} px")
        if made.off.covered < LEAST_COVERED:
            out.append(f"outline: {100.0 * made.off.covered:.0f} % of what was drawn is there; at least half")
    for run, figures in found:
        what = f"{way(run)}, {run.bound} bound"
        out += [f"{what}: {each}" for each in untrue(figures, play_m)]
        least = math.ceil(task.least * figures.stills - 1e-9)
        if run.taught and run.bound == "reference" and figures.valid < least:
            out.append(f"{what}: {figures.valid} of {figures.stills} valid; at least {least}")
    return [f"{made.row}, from images: {each}" for each in out]
