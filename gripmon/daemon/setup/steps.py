"""The steps from a camera to a running monitor: each step's fields, inputs and outputs, and the command that does the
same in the project's folder.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from gripmon.daemon.config import builtin_config
from gripmon.daemon.setup.entries import (
    BY_CORNERS,
    BY_IMAGES,
    FROM_CAD,
    FROM_FILE,
    FROM_IMAGES,
    HAND_EYE,
    HAVE_ONE,
    INFERRED,
    LENS,
    ON_PLATE,
    PRINT_IT,
    Values,
    confirmed,
    on_plate,
    other_target,
    target_in,
)
from gripmon.model.errors import InputError
from gripmon.model.targets import CircleGrid, name_of

Kind = Literal["form", "capture", "page", "run"]
DEFAULT_TARGET = name_of(CircleGrid(12, 10, 0.008, 0.004))
"""Mostly light, so that dark fingers are visible in front of it, and small enough for A5."""
_WITHOUT = "when teaching, less accurately"


@dataclass(frozen=True)
class Field:
    """An input field of a step.  ``only``: (another field, its values) for which it is shown; None: always."""

    name: str
    label: str
    default: str = ""
    hint: str = ""
    choices: tuple[str, ...] = ()
    only: tuple[str, tuple[str, ...]] | None = None
    asks: Callable[[Values], str] | None = None
    """The text of a box to tick, which is the field's value then; empty: nothing is to be confirmed now."""


@dataclass(frozen=True)
class Step:
    """``needs`` and ``writes`` are paths in the project's folder; ``command`` returns the words of the command that
    does the same, None if these values need no action.
    """

    name: str
    title: str
    about: str
    kind: Kind
    button: str
    needs: tuple[str, ...]
    writes: tuple[str, ...]
    command: Callable[[Values], list[str] | None]
    fields: tuple[Field, ...] = ()
    picture: str | None = None


def grippers() -> dict[str, Path]:
    """Gripper files that come with gripmon, by name."""
    folder = builtin_config("demo.yaml").parent / "grippers"
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


_PLATE_SOURCE = "empty: the camera of step 1; or a folder of existing images"
_OPTIONS = {
    "paper": "--paper", "model": "--model", "cad_unit": "--unit", "cad_view": "--view", "distance": "--distance",
    "jaw_range": "--jaw-range", "jaw_opening": "--jaw-opening",
}  # fmt: skip
"""The commands' options for fields."""


def _step_command(name: str) -> Callable[[Values], list[str]]:
    return lambda _values: ["gripmon", "setup", ".", "--step", name]


def _target(values: Values) -> list[str]:
    if values["have"] != PRINT_IT:
        return _step_command("target")(values)
    return ["gripmon", "target", values["target"], "--paper", values["paper"], "--pdf", "target.pdf", "--force"]


def _plate(values: Values) -> list[str] | None:
    return None if values["intrinsics_by"] == FROM_FILE else _step_command("plate")(values)


def own_camera(path: Path) -> bool:
    """Whether this is a file of gripmon, which is used unchanged; those of other programs are imported."""
    return path.is_file() and b"gripmon.camera_calibration/" in path.read_bytes()[:4096]


def _intrinsics(values: Values) -> list[str]:
    if values["intrinsics_by"] == FROM_FILE:
        path = values["camera_file"]
        if own_camera(Path(path)):
            return ["cp", path, "camera.yaml"]
        return ["gripmon", "calibrate", "import", path, "--out", "camera.yaml", "--force"]
    words = ["gripmon", "calibrate", "intrinsics", "plate", "--target", name_of(target_in(values))]
    return [*words, "--model", values["model"], "--out", "camera.yaml", "--picture", "camera.png", "--force"]


def _gripper(values: Values) -> list[str] | None:
    which = values["gripper"]
    if which == INFERRED:
        return None
    if which == FROM_CAD:
        return _from_cad(values)
    if which == FROM_IMAGES:
        return _from_images(values)
    path = values["gripper_file"] if which == FROM_FILE else str(grippers().get(which, which))
    return ["cp", path, "gripper.yaml"]


def _from_cad(values: Values) -> list[str]:
    files = _words(values, "cad_files")
    if not files:
        raise InputError("no file is given; a mesh for each finger, or one for both, a URDF or a .cao")
    words = [*_given(values, "jaw_range", "cad_unit", "cad_view"), *_words(values, "options")]
    # A picture needs a view.
    viewed = any(word.startswith(("--view", "--reference")) for word in words)
    words += ["--camera", "camera.yaml", "--picture", "gripper.png"] if viewed else []
    return ["gripmon", "gripper", "from-cad", *files, *words, "--out", "gripper.yaml", "--force"]


def _from_images(values: Values) -> list[str]:
    """Also writes a reference."""
    words = [*_words(values, "free_images"), "--camera", "camera.yaml", *_given(values, "distance")]
    words += [*_words(values, "options"), "--picture", "gripper.png", "--reference-out", "hand_eye.yaml"]
    return ["gripmon", "gripper", "from-images", *words, "--out", "gripper.yaml", "--force"]


def _given(values: Values, *fields: str) -> list[str]:
    """Options from the fields with their values; empty fields are left out."""
    return [word for field in fields if values[field] for word in (_OPTIONS[field], values[field])]


def _words(values: Values, field: str) -> list[str]:
    try:
        return shlex.split(values[field])
    except ValueError as error:
        raise InputError(f"{field}: {error}; words as on a command line") from None


def _corners(values: Values) -> list[str] | None:
    if not on_plate(values):
        return None
    words = ["gripmon", "teach", "--page", "standing/000.png", "--camera", "camera.yaml", "--out", "standing"]
    return words if values["gripper"] == INFERRED else [*words, "--gripper", "gripper.yaml"]


def _reference(values: Values) -> list[str] | None:
    if values["reference_by"] == FROM_FILE:
        return ["cp", values["reference_file"], "hand_eye.yaml"]
    if not on_plate(values):
        return None
    words = ["gripmon", "calibrate", "plane", "standing", "--target", name_of(target_in(values))]
    words += ["--camera", "camera.yaml"]
    if values["gripper"] == INFERRED:
        words += ["--corners", "standing/rough.yaml", "--infer", "--gripper-out", "gripper.yaml"]
        words += _given(values, "jaw_range")
    else:
        words += ["--corners", "standing/corners.yaml", "--gripper", "gripper.yaml"]
    words += [*_given(values, "jaw_opening"), *(["--other-target"] if confirmed(values) else [])]
    return [*words, "--out", "hand_eye.yaml", "--picture", "hand_eye.png", "--force"]


def _teach(values: Values) -> list[str]:
    words = ["gripmon", "teach", "--page", "teaching/*.png", "--camera", "camera.yaml", "--gripper", "gripper.yaml"]
    words += [] if values["reference_by"] == BY_CORNERS else ["--reference", "hand_eye.yaml"]
    return [*words, "--source", values["source"]]


STEPS = (
    Step(
        "camera", "Camera", "Where the monitor's frames come from.  Fix focus, zoom and exposure first.", "form",
        "Look through it", (), ("setup.yaml",), _step_command("camera"),
        (
            Field("source", "camera", "", "0 or /dev/video0, a URL, a folder of images, zenoh:1280x720[:KEY], "
                  "ros2:1280x720:/camera/image_raw"),
            Field("robot", "robot", "robot1", "names in messages: gripmon/<robot>/<camera name>/…"),
            Field("camera_name", "camera name", "wrist"),
        ), "view.jpg",
    ),
    Step(
        "target", "Target", "A flat pattern of known size.  Print it at 100 %, glue it onto something flat, and hold a "
        "ruler against its bar.", "form", "Make it", (), ("setup.yaml", "target.pdf"), _target,
        (
            Field("have", "target", PRINT_IT, choices=(PRINT_IT, HAVE_ONE)),
            Field("target", "pattern", DEFAULT_TARGET, "circles:COLUMNSxROWS:SPACING:DIAMETER, "
                  "chequerboard:COLUMNSxROWS:SQUARE (inner corners) or charuco:COLUMNSxROWS:SQUARE:MARKER; metres"),
            Field("paper", "paper", "a4", "a5 to a0, letter, legal, tabloid, or WIDTHxHEIGHT in mm", (),
                  ("have", (PRINT_IT,))),
            Field("bar_measured", "the bar measures (mm)", "", "empty: as printed beside it; otherwise the pattern is "
                  "scaled to the measured length", (), ("have", (PRINT_IT,))),
        ),
    ),
    Step(
        "plate", "Images of the target", "Ten to thirty images that fill the view, the target tilted by 20 to 45° to "
        "all sides.  Start shows what the camera sees; Take automatically takes an image whenever the camera stands "
        "still and the target is sharp.  With a lens file none are needed: choose it in the next step.", "capture",
        "Start", ("setup.yaml",), ("plate",),
        _plate,
        (Field("plate_source", "images from", "", _PLATE_SOURCE),),
    ),
    Step(
        "intrinsics", "Lens", "Focal lengths, principal point and distortion, with their uncertainties.", "form",
        "Calibrate", ("plate",), ("camera.yaml",), _intrinsics,
        (
            Field("intrinsics_by", "lens", "from the images", choices=("from the images", FROM_FILE)),
            Field("model", "model", "brown_conrady", "auto: the one that fits the images best",
                  ("auto", "brown_conrady", "brown_conrady_5", "fisheye", "paper"),
                  ("intrinsics_by", ("from the images",))),
            Field("camera_file", "file", "", "of gripmon, ROS, Kalibr, OpenCV or others", (),
                  ("intrinsics_by", (FROM_FILE,))),
        ), "camera.png",
    ),
    Step(
        "gripper", "Gripper", "What the fingertips look like: inferred from images of the gripper standing on the "
        "target (straight fingers), a file of the library or your own, from CAD, or from images before changing "
        "backgrounds.", "form", "Use it", (), ("gripper.yaml",), _gripper,
        (
            Field("gripper", "gripper", INFERRED, choices=(INFERRED, FROM_IMAGES, FROM_CAD, FROM_FILE)),
            Field("gripper_file", "file", "", "a gripper file", (), ("gripper", (FROM_FILE,))),
            Field("cad_files", "CAD files", "", "STL, OBJ, PLY or .cao, one per finger or one for both; or a URDF.  "
                  "Sharp edges count as broken by 0.2 mm, with bounds too wide for valid, until the step Teach",
                  (), ("gripper", (FROM_CAD,))),
            Field("cad_unit", "unit of the meshes", "", "known for URDF and .cao", ("", "mm", "m", "cm", "in"),
                  ("gripper", (FROM_CAD,))),
            Field("cad_view", "view (m:°)", "", "for round, hollow or open fingers: distance from the camera to the "
                  "fingertips, and the camera's tilt against them, e.g. 0.12:30", (), ("gripper", (FROM_CAD,))),
            Field("free_images", "images in", "teaching", "a folder with five to two hundred images, each before "
                  "another background, some brighter and some darker than the fingers; teaching: take fifteen in the "
                  "step Gripper at work first", (), ("gripper", (FROM_IMAGES,))),
            Field("distance", "distance (m)", "", "of the fingertips from the camera, with its standard deviation, "
                  "which is in every bound, e.g. 0.12:0.0001; empty: from images at several jaw openings, else unknown",
                  (), ("gripper", (FROM_IMAGES,))),
            Field("jaw_range", "jaws move (m)", "", "MIN:MAX, e.g. 0:0.06; empty: they don't", (),
                  ("gripper", (INFERRED, FROM_CAD))),
            Field("options", "more options", "", "added to the command below, written as there", (),
                  ("gripper", (FROM_CAD, FROM_IMAGES))),
        ), "gripper.png",
    ),
    Step(
        "standing", "Gripper on the target", "For the hand/eye calibration the fingertips stand on the target, as flat "
        "as they can.  Three to ten images, put down again for each, with the jaws unchanged.  Or choose another "
        "reference.", "capture", "Start", ("camera.yaml",),
        ("standing",), lambda v: _step_command("standing")(v) if on_plate(v) else None,
        (
            Field("reference_by", "reference", ON_PLATE, f"{BY_CORNERS}: {_WITHOUT}",
                  (ON_PLATE, FROM_FILE, BY_CORNERS, BY_IMAGES)),
            Field("standing_source", "images from", "", _PLATE_SOURCE, (), ("reference_by", (ON_PLATE,))),
            Field("reference_file", "file", "", "of gripmon calibrate plane, or of the robot: cam_T_grip, or "
                  "flange_T_cam and flange_T_tcp", (), ("reference_by", (FROM_FILE,))),
        ),
    ),
    Step(
        "corners", "Corners", "Drag the corners onto the fingertips in the first of these images; some pixels off is "
        "fine.  Save, then Done.", "page", "Drag them", ("camera.yaml", "standing"), ("standing/rough.yaml",), _corners,
    ),
    Step(
        "reference", "Hand and eye", "The gripper's pose in the camera frame, with its uncertainty: from the images on "
        "the target, or the file chosen in the step Gripper on the target.", "form", "Calibrate",
        ("camera.yaml", "standing", "standing/rough.yaml"), ("hand_eye.yaml", "gripper.yaml"), _reference,
        (
            Field("jaw_opening", "jaw opening (m)", "", "in these images, as the robot reports it; empty: the "
                  "gripper's nominal opening, or of an inferred gripper the distance of its fingertips", (),
                  ("reference_by", (ON_PLATE,))),
            Field("other_target", "another target", "", "It is one pattern in two sizes.  If there is only one "
                  "target, correct its size in the step Target instead, or calibrate the lens again: no image shows "
                  "that a size is wrong, and all lengths would be wrong by as much.", asks=other_target),
        ), "hand_eye.png",
    ),
    Step(
        "teaching", "Gripper at work", "One to ten images as at work, each before another background, the fingers free "
        "and lit as in use; fifteen if the gripper's model is made from them.", "capture", "Start",
        ("camera.yaml", "gripper.yaml"), ("teaching",),
        _step_command("teaching"), (Field("teaching_source", "images from", "", _PLATE_SOURCE),),
    ),
    Step(
        "teach", "Teach", "See the edges snap, and the expected accuracy; drag the corners that the page asks for.  "
        "Save, then Done.  Without this step a gripper from CAD is hardly ever valid: its real edges are unknown.",
        "page", "Teach", ("camera.yaml", "gripper.yaml", "hand_eye.yaml", "teaching"), ("config.yaml",), _teach,
    ),
    Step(
        "check", "Forecast", "What the monitor keeps over your images, and what it can in this view.", "form", "Check",
        ("config.yaml",), ("check.json",), lambda _values: ["gripmon", "check", "config.yaml"],
    ),
    Step(
        "run", "Start", "The monitor itself.  It ends with this page; without the page start it by the "
        "command below.  gripmon report run shows what happened.", "run", "Start the monitor",
        ("config.yaml",), ("run",), lambda _values: ["gripmon", "run", "config.yaml", "--out", "run"],
    ),
)  # fmt: skip


BY_NAME = {step.name: step for step in STEPS}


def in_fields(text: str) -> str:
    """A command's message with its options called as the page's fields are."""
    labels = {field.name: field.label for step in STEPS for field in step.fields}
    for name, option in _OPTIONS.items():
        text = re.sub(rf"(?<!\S){option}(?![\w-])", f"“{labels[name]}”", text)
    return text


def defaults() -> dict[str, str]:
    """Every field's default value."""
    return {field.name: field.default for step in STEPS for field in step.fields}


def needed(step: Step, values: Values) -> tuple[str, ...]:
    """The files that the step needs with these values; these decide which files exist and how some are named."""
    names = step.needs
    if step.name == "intrinsics" and values["intrinsics_by"] == FROM_FILE:
        names = ()
    own = values["gripper"] == FROM_IMAGES and values["free_images"] == "teaching"
    if step.name == "gripper" and values["gripper"] in (FROM_CAD, FROM_IMAGES):
        names = ("camera.yaml", "teaching") if own else ("camera.yaml",)
    if step.name == "teaching" and own:
        names = ("camera.yaml",)
    if step.name == "teach" and values["reference_by"] == BY_CORNERS:
        names = tuple(name for name in names if name != "hand_eye.yaml")
    if values["gripper"] != INFERRED:
        names = tuple("standing/corners.yaml" if name == "standing/rough.yaml" else name for name in names)
        names += ("gripper.yaml",) if step.name in ("corners", "reference") else ()
    if step.name == "reference" and values["reference_by"] == FROM_FILE:
        names = ("camera.yaml", "gripper.yaml")
    return names


def measured_with_target(step: Step, values: Values) -> str | None:
    """The step's result that was measured with the target of the page, if it is one."""
    if step.name == "intrinsics" and values["intrinsics_by"] != FROM_FILE:
        return LENS
    return HAND_EYE if step.name == "reference" and on_plate(values) else None


def written(step: Step, values: Values) -> tuple[str, ...]:
    """The files that the step writes with these values."""
    if step.name == "corners" and values["gripper"] != INFERRED:
        return ("standing/corners.yaml",)
    if step.name == "reference" and values["gripper"] != INFERRED:
        return ("hand_eye.yaml",)
    return step.writes
