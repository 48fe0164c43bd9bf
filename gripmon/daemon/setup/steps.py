"""The steps from a camera to a running monitor: each step's fields, and what these make of it: its inputs and outputs,
and the command that does the same in the project's folder.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import msgspec

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


class Field(msgspec.Struct, frozen=True):
    """An input field of a step.  ``only``: (another field, its values) for which it is shown; None: always.
    ``option``: the command's option that it gives.
    """

    name: str
    label: str
    default: str = ""
    hint: str = ""
    choices: tuple[str, ...] = ()
    only: tuple[str, tuple[str, ...]] | None = None
    option: str | None = None


class Plan(NamedTuple):
    """A step with some values: the paths that it ``needs`` and ``writes`` in the project's folder; ``command`` returns
    the words of the command that does the same, None if there is none; ``skipped``: why nothing is to be done, empty if
    something is; ``measured``: the result that is measured with the page's target.
    """

    needs: tuple[str, ...]
    writes: tuple[str, ...]
    command: Callable[[], list[str]] | None
    skipped: str = ""
    measured: str | None = None


@dataclass(frozen=True)
class Step:
    name: str
    title: str
    about: str
    kind: Kind
    button: str
    plan: Callable[[Values], Plan]
    fields: tuple[Field, ...] = ()
    picture: str | None = None


def grippers() -> dict[str, Path]:
    """Gripper files that come with gripmon, by name."""
    folder = builtin_config("demo.yaml").parent / "grippers"
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


_PLATE_SOURCE = "empty: the camera of step 1; or a folder of existing images"


def _step(name: str) -> Callable[[], list[str]]:
    """The command that carries out a step."""
    return lambda: ["gripmon", "setup", ".", "--step", name]


def _target(values: Values) -> Plan:
    def printed() -> list[str]:
        return ["gripmon", "target", values["target"], "--paper", values["paper"], "--pdf", "target.pdf", "--force"]

    return Plan((), ("setup.yaml", "target.pdf"), printed if values["have"] == PRINT_IT else _step("target"))


def _plate(values: Values) -> Plan:
    skipped = f"lens: {values['intrinsics_by']}" if values["intrinsics_by"] == FROM_FILE else ""
    return Plan(("setup.yaml",), ("plate",), _step("plate"), skipped)


def own_camera(path: Path) -> bool:
    """Whether this is a file of gripmon, which is used unchanged; those of other programs are imported."""
    return path.is_file() and b"gripmon.camera_calibration/" in path.read_bytes()[:4096]


def _intrinsics(values: Values) -> Plan:
    def command() -> list[str]:
        words = ["gripmon", "calibrate", "intrinsics", "plate", "--target", name_of(target_in(values))]
        return [*words, *_given(values, "model"), "--out", "camera.yaml", "--report", "camera.html", "--force"]

    def imported() -> list[str]:
        path = values["camera_file"]
        if own_camera(Path(path)):
            return ["cp", path, "camera.yaml"]
        return ["gripmon", "calibrate", "import", path, "--out", "camera.yaml", "--force"]

    if values["intrinsics_by"] == FROM_FILE:
        return Plan((), (LENS,), imported)
    return Plan(("plate",), (LENS,), command, measured=LENS)


def _gripper(values: Values) -> Plan:
    which, writes = values["gripper"], ("gripper.yaml",)
    if which == INFERRED:
        return Plan((), writes, None)
    if which == FROM_CAD:
        return Plan((LENS,), writes, lambda: _from_cad(values))
    if which == FROM_IMAGES:
        return Plan((LENS, "teaching") if _of_itself(values) else (LENS,), writes, lambda: _from_images(values))
    path = values["gripper_file"] if which == FROM_FILE else str(grippers().get(which, which))
    return Plan((), writes, lambda: ["cp", path, "gripper.yaml"])


def _of_itself(values: Values) -> bool:
    """Whether the gripper is made from the images that are taken for teaching."""
    return values["gripper"] == FROM_IMAGES and values["free_images"] == "teaching"


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


def _given(values: Values, *names: str) -> list[str]:
    """Options from the fields with their values; empty fields are left out."""
    return [word for name in names if values[name] for word in (str(FIELDS[name].option), values[name])]


def _words(values: Values, field: str) -> list[str]:
    try:
        return shlex.split(values[field])
    except ValueError as error:
        raise InputError(f"{field}: {error}; words as on a command line") from None


def _not_on_plate(values: Values) -> str:
    return "" if on_plate(values) else f"reference: {values['reference_by']}"


def _known(values: Values) -> tuple[str, ...]:
    """The gripper's file, where the images on the plate don't make it."""
    return () if values["gripper"] == INFERRED else ("gripper.yaml",)


def _rough(values: Values) -> str:
    """Where the corners are dragged to."""
    return "standing/rough.yaml" if values["gripper"] == INFERRED else "standing/corners.yaml"


def _standing(values: Values) -> Plan:
    return Plan((LENS,), ("standing",), _step("standing"), _not_on_plate(values))


def _corners(values: Values) -> Plan:
    def command() -> list[str]:
        words = ["gripmon", "teach", "--page", "standing/000.png", "--camera", "camera.yaml", "--out", "standing"]
        return [*words, *(["--gripper", "gripper.yaml"] if _known(values) else [])]

    return Plan((LENS, "standing", *_known(values)), (_rough(values),), command, _not_on_plate(values))


def _reference(values: Values) -> Plan:
    def command() -> list[str]:
        words = ["gripmon", "calibrate", "plane", "standing", "--target", name_of(target_in(values))]
        words += ["--camera", "camera.yaml", "--corners", _rough(values)]
        if _known(values):
            words += ["--gripper", "gripper.yaml"]
        else:
            words += ["--infer", "--gripper-out", "gripper.yaml", *_given(values, "jaw_range")]
        words += [*_given(values, "jaw_opening"), *(["--other-target"] if confirmed(values) else [])]
        return [*words, "--out", "hand_eye.yaml", "--picture", "hand_eye.png", "--force"]

    if values["reference_by"] == FROM_FILE:
        return Plan((LENS, "gripper.yaml"), (HAND_EYE,), lambda: ["cp", values["reference_file"], HAND_EYE])
    # An inferred gripper is made together with the hand/eye calibration.
    writes = (HAND_EYE,) if _known(values) else (HAND_EYE, "gripper.yaml")
    needs = (LENS, "standing", _rough(values), *_known(values))
    return Plan(needs, writes, command, _not_on_plate(values), HAND_EYE)


def _teaching(values: Values) -> Plan:
    return Plan((LENS,) if _of_itself(values) else (LENS, "gripper.yaml"), ("teaching",), _step("teaching"))


def _teach(values: Values) -> Plan:
    known = () if values["reference_by"] == BY_CORNERS else (HAND_EYE,)

    def command() -> list[str]:
        words = ["gripmon", "teach", "--page", "teaching/*.png", "--camera", "camera.yaml", "--gripper", "gripper.yaml"]
        return [*words, *(["--reference", "hand_eye.yaml"] if known else []), "--source", values["source"]]

    return Plan((LENS, "gripper.yaml", *known, "teaching"), ("config.yaml",), command)


STEPS = (
    Step(
        "camera", "Camera", "Where the monitor's frames come from.  Fix focus, zoom and exposure first.", "form",
        "Look through it", lambda _: Plan((), ("setup.yaml",), _step("camera")),
        (
            Field("source", "camera", "", "0 or /dev/video0, a URL, a folder of images, zenoh:1280x720[:KEY], "
                  "ros2:1280x720:/camera/image_raw"),
            Field("robot", "robot", "robot1", "names in messages: gripmon/<robot>/<camera name>/…"),
            Field("camera_name", "camera name", "wrist"),
        ), "view.jpg",
    ),
    Step(
        "target", "Target", "A flat pattern of known size.  Print it at 100 %, glue it onto something flat, and hold a "
        "ruler against its bar.", "form", "Make it", _target,
        (
            Field("have", "target", PRINT_IT, choices=(PRINT_IT, HAVE_ONE)),
            Field("target", "pattern", DEFAULT_TARGET, "circles:COLUMNSxROWS:SPACING:DIAMETER, "
                  "chequerboard:COLUMNSxROWS:SQUARE (inner corners) or charuco:COLUMNSxROWS:SQUARE:MARKER; metres"),
            Field("paper", "paper", "a4", "a5 to a0, letter, legal, tabloid, or WIDTHxHEIGHT in mm", (),
                  ("have", (PRINT_IT,)), "--paper"),
            Field("bar_measured", "the bar measures (mm)", "", "empty: as printed beside it; otherwise the pattern is "
                  "scaled to the measured length", (), ("have", (PRINT_IT,))),
        ),
    ),
    Step(
        "plate", "Images of the target", "Ten to thirty images that fill the view, the target tilted by 20 to 45° to "
        "all sides.  Start shows what the camera sees; Take automatically takes an image whenever the camera stands "
        "still and the target is sharp.  With a lens file none are needed: choose it in the next step.", "capture",
        "Start", _plate,
        (Field("plate_source", "images from", "", _PLATE_SOURCE),),
    ),
    Step(
        "intrinsics", "Lens", "Focal lengths, principal point and distortion, with their uncertainties.", "form",
        "Calibrate", _intrinsics,
        (
            Field("intrinsics_by", "lens", "from the images", choices=("from the images", FROM_FILE)),
            Field("model", "model", "brown_conrady", "auto: the one that fits the images best",
                  ("auto", "brown_conrady", "brown_conrady_5", "fisheye", "paper"),
                  ("intrinsics_by", ("from the images",)), "--model"),
            Field("camera_file", "file", "", "of gripmon, ROS, Kalibr, OpenCV or others", (),
                  ("intrinsics_by", (FROM_FILE,))),
        ), "camera.html",
    ),
    Step(
        "gripper", "Gripper", "What the fingertips look like: inferred from images of the gripper standing on the "
        "target (straight fingers), a file of the library or your own, from CAD, or from images before changing "
        "backgrounds.", "form", "Use it", _gripper,
        (
            Field("gripper", "gripper", INFERRED, choices=(INFERRED, FROM_IMAGES, FROM_CAD, FROM_FILE, *grippers())),
            Field("gripper_file", "file", "", "a gripper file", (), ("gripper", (FROM_FILE,))),
            Field("cad_files", "CAD files", "", "STL, OBJ, PLY or .cao, one per finger or one for both; or a URDF.  "
                  "Sharp edges count as broken by 0.2 mm, with bounds too wide for valid, until the step Teach",
                  (), ("gripper", (FROM_CAD,))),
            Field("cad_unit", "unit of the meshes", "", "known for URDF and .cao", ("", "mm", "m", "cm", "in"),
                  ("gripper", (FROM_CAD,)), "--unit"),
            Field("cad_view", "view (m:°)", "", "for round, hollow or open fingers: distance from the camera to the "
                  "fingertips, and the camera's tilt against them, e.g. 0.12:30",
                  (), ("gripper", (FROM_CAD,)), "--view"),
            Field("free_images", "images in", "teaching", "a folder with five to two hundred images, each before "
                  "another background, some brighter and some darker than the fingers; teaching: take fifteen in the "
                  "step Gripper at work first", (), ("gripper", (FROM_IMAGES,))),
            Field("distance", "distance (m)", "", "of the fingertips from the camera, with its standard deviation, "
                  "which is in every bound, e.g. 0.12:0.0001; empty: from images at several jaw openings, else unknown",
                  (), ("gripper", (FROM_IMAGES,)), "--distance"),
            Field("jaw_range", "jaws move (m)", "", "MIN:MAX, e.g. 0:0.06; empty: they don't", (),
                  ("gripper", (INFERRED, FROM_CAD)), "--jaw-range"),
            Field("options", "more options", "", "added to the command below, written as there", (),
                  ("gripper", (FROM_CAD, FROM_IMAGES))),
        ), "gripper.png",
    ),
    Step(
        "standing", "Gripper on the target", "For the hand/eye calibration the fingertips stand on the target, as flat "
        "as they can.  Three to ten images, put down again for each, with the jaws unchanged.  Or choose another "
        "reference.", "capture", "Start", _standing,
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
        "fine.  Save, then Done.", "page", "Drag them", _corners,
    ),
    Step(
        "reference", "Hand and eye", "The gripper's pose in the camera frame, with its uncertainty: from the images on "
        "the target, or the file chosen in the step Gripper on the target.", "form", "Calibrate", _reference,
        (
            Field("jaw_opening", "jaw opening (m)", "", "in these images, as the robot reports it; empty: the "
                  "gripper's nominal opening, or of an inferred gripper the distance of its fingertips", (),
                  ("reference_by", (ON_PLATE,)), "--jaw-opening"),
            Field("other_target", "another target", "", "It is one pattern in two sizes.  If there is only one "
                  "target, correct its size in the step Target instead, or calibrate the lens again: no image shows "
                  "that a size is wrong, and all lengths would be wrong by as much."),
        ), "hand_eye.png",
    ),
    Step(
        "teaching", "Gripper at work", "One to ten images as at work, each before another background, the fingers free "
        "and lit as in use; fifteen if the gripper's model is made from them.", "capture", "Start", _teaching,
        (Field("teaching_source", "images from", "", _PLATE_SOURCE),),
    ),
    Step(
        "teach", "Teach", "See the edges snap, and the expected accuracy; drag the corners that the page asks for.  "
        "Save, then Done.  Without this step a gripper from CAD is hardly ever valid: its real edges are unknown.",
        "page", "Teach", _teach,
    ),
    Step(
        "check", "Forecast", "What the monitor keeps over your images, and what it can in this view.", "form", "Check",
        lambda _: Plan(("config.yaml",), ("check.json",), lambda: ["gripmon", "check", "config.yaml"]),
    ),
    Step(
        "run", "Start", "The monitor itself.  It ends with this page; without the page start it by the "
        "command below.  gripmon report run shows what happened.", "run", "Start the monitor",
        lambda _: Plan(("config.yaml",), ("run",), lambda: ["gripmon", "run", "config.yaml", "--out", "run"]),
    ),
)  # fmt: skip


BY_NAME = {step.name: step for step in STEPS}
FIELDS = {field.name: field for step in STEPS for field in step.fields}
BOXES = {"other_target": other_target}
"""By the name of a field that is a box to tick: the text beside it, which is its value then; empty: nothing is to be
confirmed now.
"""


def in_fields(text: str) -> str:
    """A command's message with its options called as the page's fields are."""
    for field in FIELDS.values():
        if field.option is not None:
            text = re.sub(rf"(?<!\S){field.option}(?![\w-])", f"“{field.label}”", text)
    return text


def defaults() -> dict[str, str]:
    """Every field's default value."""
    return {name: field.default for name, field in FIELDS.items()}
