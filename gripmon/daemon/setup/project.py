"""A folder in which a monitor is set up: the answers so far, the progress of the steps, and the steps themselves.

A step that computes runs the command that it shows, in this folder.
"""

from __future__ import annotations

import contextlib
import shlex
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal

import msgspec

from gripmon.calibrate.grey_levels import to_bytes, to_grey
from gripmon.calibrate.target_print import print_target
from gripmon.daemon.config import read_gripper
from gripmon.daemon.config.calibrated import read_camera
from gripmon.daemon.config.robot_file import reference_text
from gripmon.daemon.config.yaml_file import read_yaml
from gripmon.daemon.setup import entries, steps
from gripmon.daemon.setup.capture import Capture
from gripmon.daemon.setup.entries import target_in
from gripmon.daemon.setup.lines import Line, findings, jaws, last_line
from gripmon.daemon.setup.steps import BY_NAME, FIELDS, STEPS, Plan, Step, own_camera
from gripmon.daemon.teaching.source import open_named
from gripmon.io.sources import Source, Waiting
from gripmon.io.wire.session import check_name
from gripmon.model.atomic import writable_folder, write_atomically
from gripmon.model.errors import InputError, NoResultError
from gripmon.model.images import IMAGE_SUFFIXES
from gripmon.model.targets import OtherSizeError, name_of, parse_target, refuse_squares
from gripmon.model.yaml_text import as_yaml
from gripmon.teach.messages import encoded

SETUP, VIEW = "setup.yaml", "view.jpg"
_FIRST_FRAME_READS = 20
"""Number of reads, half a second each, within which the first image must arrive: network cameras take ten seconds to
connect.
"""
Progress = Literal["done", "stale", "ready", "waits", "skipped"]


class StepState(msgspec.Struct, frozen=True, kw_only=True):
    """``progress`` "stale": an input is newer than the result, or it was made with another target; ``note``: why the
    step isn't done, or the number of its images; ``first``: the step whose result it waits for.
    """

    name: str
    progress: Progress
    note: str
    first: str | None = None
    command: str
    files: tuple[str, ...]


class Project:
    """The project in a ``folder``, which is created if missing and must be this process's working directory.

    Raises :class:`~gripmon.model.errors.InputError` if it can't be used.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = writable_folder(folder).resolve()
        self.values, self._accepted = steps.defaults(), {}
        with contextlib.suppress(ValueError):  # the folder's name may be impossible as a key
            check_name("robot", self.folder.name)
            self.values["robot"] = self.folder.name
        path = self.folder / SETUP
        if path.exists():
            kept = read_yaml(path)
            if not kept.keys() & {"values", "accepted"}:
                raise InputError(f"{path}: isn't a file of gripmon setup, which would replace it; another folder")
            self.values |= _texts(path, kept, "values")
            self._accepted = _texts(path, kept, "accepted")
            return
        written = dict.fromkeys(name for step in STEPS for name in step.plan(self.values).writes)
        if theirs := [name for name in written if (self.folder / name).is_file()]:
            right = "a folder of its own, in which a step asks for a file of yours where it can use it"
            raise InputError(f"{self.folder}: {', '.join(theirs)} would be replaced; {right}")

    def keep(self, values: Mapping[str, str]) -> None:
        """Store a person's answers, even if they turn out wrong.  Raises :class:`InputError`."""
        for name in values:
            if name not in FIELDS:
                raise InputError(f"there is no field {name}")
        self.values |= {name: text.strip() for name, text in values.items()}
        self._write()

    def states(self) -> tuple[StepState, ...]:
        """The states of all steps, in order."""
        return tuple(self._state(step) for step in STEPS)

    def capture(self, step: str) -> Capture:
        """A capture for one of the steps that take images.  Raises :class:`InputError`."""
        return Capture(self.folder / step, None if step == "teaching" else target_in(self.values))

    def source_field(self, step: str | None) -> str:
        """Name of the field with the source of a step's images, or (None) of the monitor's frames.

        Raises :class:`InputError` for a step that takes no images.
        """
        name = "source" if step in (None, "camera") else f"{step}_source"
        if name not in FIELDS:
            with_it = ", ".join(each.name for each in STEPS if each.name == "camera" or each.kind == "capture")
            raise InputError(f"the step {step} takes no images; one of {with_it}, or leave it out", "source")
        return name

    def open_camera(self, step: str) -> Source:
        """Open the source of a step's images.  Raises :class:`InputError`."""
        text = self.values.get(f"{step}_source") or self.values["source"]
        if not text:
            raise InputError("no camera is named; step 1 (--source SOURCE), or a folder with images")
        return open_named(text, self.values["robot"], self.values["camera_name"])

    def do(self, name: str) -> list[Line]:
        """Carry out a step; return its output.  Raises :class:`InputError` and :class:`NoResultError`, one line."""
        step = BY_NAME[name]
        state = self._state(step)
        if state.progress == "waits":
            raise InputError(state.note)
        own = {
            "camera": self._camera, "target": self._target, "intrinsics": self._lens, "gripper": self._gripper,
            "standing": self._reference_by, "reference": self._reference, "check": self._check,
        }.get(name)  # fmt: skip
        lines = None if own is None else own()
        if lines is not None:
            return lines
        command = step.plan(self.values).command
        return [Line("nothing to do")] if command is None or state.progress == "skipped" else self._command(command())

    def do_here(self, name: str, note: Callable[[str], object]) -> list[Line]:
        """As :meth:`do`, at a terminal: images are taken automatically; ``note`` is called with the result for each."""
        step = BY_NAME.get(name)
        if step is None:
            names = ", ".join(BY_NAME)
            raise InputError(f"{name}: is not a step; one of {names}", "step")
        state = self._state(step)
        if step.kind != "capture" and state.progress == "waits":
            missing = self._missing(step)
            if missing is None:
                raise InputError(state.note)
            there_is = "there is no" if Path(missing[0]).suffix else "there are no images in"
            raise InputError(f"{name}: {there_is} {missing[0]} yet; first --step {missing[1].name}")
        if step.kind in ("page", "run"):
            command = f"cd {shlex.quote(str(self.folder))} && {state.command}"
            raise InputError(f"{name}: has a command of its own; {command}")
        if step.kind == "form":
            try:
                return self.do(name)
            except OtherSizeError as error:
                raise error.worded(f"cd {shlex.quote(str(self.folder))} && {state.command} --other-target") from None
        capture = self.capture(name)
        capture.start(self.open_camera(name))
        capture.by_itself(True)
        try:
            for text in capture.notes():
                note(text)
        finally:
            capture.stop()
        if not capture.images():
            raise NoResultError(f"{name}: no image was taken; sharp images without motion that show it")
        return [Line(f"{len(capture.images())} images in {name}", "OK")]

    def _state(self, step: Step) -> StepState:
        plan, words = step.plan(self.values), []
        try:
            if plan.command is not None and not plan.skipped:
                words = plan.command()
        except InputError as error:
            return StepState(name=step.name, progress="waits", note=str(error), command="", files=())
        command = shlex.join(words)
        if step.name == "teach":
            command = command.replace("'teaching/*.png'", "teaching/*.png")
        progress, note = self._progress(step, plan)
        files = plan.writes if step.picture is None else (*plan.writes, step.picture)
        present = tuple(name for name in files if (self.folder / name).exists())
        missing = self._missing(step) if progress == "waits" else None
        first = None if missing is None else missing[1].name
        return StepState(name=step.name, progress=progress, note=note, first=first, command=command, files=present)

    def _progress(self, step: Step, plan: Plan) -> tuple[Progress, str]:
        inferred = plan.command is None
        if inferred or step.name in ("camera", "target"):
            done = self._accepted.get(step.name) == self._answers(step)
            return ("done", "the step Hand and eye makes its file" if inferred else "") if done else ("ready", "")
        if plan.skipped:
            return "skipped", plan.skipped
        missing = self._missing(step)
        if missing is not None:
            return "waits", f"first: {missing[1].title} ({missing[0]})"
        if step.kind == "capture":
            count = self._count(step.name)
            return ("done" if count else "ready"), f"{count} image{'' if count == 1 else 's'}"
        if not all(self._there(name) for name in plan.writes):
            return "ready", ""
        made = min(self._made_ns(name) for name in plan.writes)
        newer = [name for name in plan.needs if self._made_ns(name) > made]
        if plan.measured is not None and not newer:
            made_with, now = entries.made_with(self.folder / plan.measured), name_of(target_in(self.values))
            if made_with != now and not (plan.measured == entries.LENS and entries.confirmed(self.values)):
                return "stale", f"made with {made_with}, but the target is {now}: do this again"
        return ("stale", f"{newer[0]} is newer: do this again") if newer else ("done", "")

    def _there(self, name: str) -> bool:
        path = self.folder / name
        return self._count(name) > 0 if path.is_dir() else path.exists()

    def _made_ns(self, name: str) -> int:
        """When a file was written; for a folder, its newest image."""
        path = self.folder / name
        each = [p for p in path.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES] if path.is_dir() else []
        return max((p.stat().st_mtime_ns for p in each), default=path.stat().st_mtime_ns)

    def _count(self, folder: str) -> int:
        path = self.folder / folder
        if folder == "run":
            return int(path.is_dir())
        return sum(p.suffix.lower() in IMAGE_SUFFIXES for p in path.iterdir()) if path.is_dir() else 0

    def _missing(self, step: Step) -> tuple[str, Step] | None:
        """The first missing file that a step needs, and the step that writes it."""
        name = next((name for name in step.plan(self.values).needs if not self._there(name)), None)
        if name is None:
            return None
        inferred = name == "gripper.yaml" and self.values["gripper"] == entries.INFERRED
        makers = [each for each in STEPS if name in each.plan(self.values).writes]
        return name, makers[-1 if inferred else 0]

    def _answers(self, step: Step) -> str:
        return "|".join(self.values[field.name] for field in step.fields)

    def _accept(self, name: str) -> None:
        self._accepted[name] = self._answers(BY_NAME[name])
        self._write()

    def _write(self) -> None:
        text = "# Written by gripmon setup: the entries of its page, and those that were tried out.\n" + as_yaml(
            {"values": self.values, "accepted": self._accepted}
        )
        path = self.folder / SETUP
        try:
            write_atomically(path, text.encode())
        except OSError as error:
            raise InputError(f"{path}: can't be written ({error.strerror or error})") from None

    def _camera(self) -> list[Line]:
        for role in ("robot", "camera_name"):
            try:
                check_name(role.replace("_name", ""), self.values[role])
            except ValueError as error:
                raise InputError(str(error)) from None
        source = self.open_camera("camera")
        why = "no image arrived"
        try:
            for _ in range(_FIRST_FRAME_READS):
                frame = source.read()
                if frame is None:
                    break
                if isinstance(frame, Waiting):
                    why = frame.reason.partition("; next attempt")[0]  # there is none here
                elif frame.image is None:
                    why = frame.fault or "not an image"
                else:
                    height, width = frame.image.shape[:2]
                    write_atomically(self.folder / VIEW, encoded(to_bytes(to_grey(frame.image)), ".jpg"))
                    self._accept("camera")
                    return [Line(f"{width} x {height} px, {8 * frame.image.itemsize} bits", "OK")]
        finally:
            source.close()
        raise NoResultError(f"{self.values['source']}: {why}; a camera that delivers images, or a folder of images")

    def _target(self) -> list[Line]:
        target, lines = parse_target(self.values["target"]), []
        if self.values["have"] == entries.PRINT_IT:
            bar_mm = print_target(target, self.values["paper"]).bar_mm
            self.values["bar_mm"] = f"{bar_mm:g}"
            lines = self._as_shown("target")
        else:
            self.values["bar_mm"] = ""
        lines.append(Line(f"the target is {name_of(target_in(self.values))}", "OK"))
        self._accept("target")
        return lines

    def _gripper(self) -> list[Line] | None:
        which = self.values["gripper"]
        if which == entries.INFERRED:
            refuse_squares(target_in(self.values))
            lines = [jaws(self.values["jaw_range"]), Line("the step Hand and eye makes the gripper file", "OK")]
            self._accept("gripper")
            return lines
        if which == entries.FROM_IMAGES:
            return self._gripper_from_images()
        if which == entries.FROM_CAD:
            # Its notes need a person's attention: edges that aren't taught, a small finger, an open surface.
            lines, note = self._as_shown("gripper"), "note: "
            return [Line(e.text.removeprefix(note), "WARN") if e.text.startswith(note) else e for e in lines]
        name = self.values["gripper_file"] if which == entries.FROM_FILE else str(steps.grippers().get(which, which))
        path = Path(name)
        if not name or not path.is_file():
            raise InputError(f"{name or 'the file'}: there is no such file; a gripper file such as the library's")
        gripper = read_gripper(path)
        write_atomically(self.folder / "gripper.yaml", path.read_bytes())
        return [Line(f"{gripper.name}: {len(gripper.corner_ids)} corners, {len(gripper.edge_ids)} edges", "OK")]

    def _gripper_from_images(self) -> list[Line]:
        """Existing images on the target stay the reference."""
        lines = self._as_shown("gripper")
        if self.values["reference_by"] == entries.ON_PLATE and not self._count("standing"):
            self.keep({"reference_by": entries.BY_IMAGES})
            lines.append(
                Line("the reference comes with it; choose another one in the step Gripper on the target", "OK")
            )
        return lines

    def _reference_by(self) -> list[Line]:
        by = self.values["reference_by"]
        if by != entries.ON_PLATE and self.values["gripper"] == entries.INFERRED:
            raise InputError("an inferred gripper needs its images on the target; these, or another gripper")
        if by == entries.BY_IMAGES and self.values["gripper"] != entries.FROM_IMAGES:
            raise InputError("this gripper wasn't made from images; another reference")
        return [Line(f"reference: {by}", "OK")]

    def _reference(self) -> list[Line] | None:
        if self.values["reference_by"] != entries.FROM_FILE:
            other = entries.other_size(self.values)
            if other is not None and not entries.confirmed(self.values):
                raise other
            return None
        path = Path(self.values["reference_file"])
        text, summary = reference_text(path)
        write_atomically(self.folder / "hand_eye.yaml", text)
        return [Line(summary, "OK")]

    def _lens(self) -> list[Line] | None:
        if self.values["intrinsics_by"] != entries.FROM_FILE:
            return None
        path = Path(self.values["camera_file"])
        if not self.values["camera_file"] or not path.is_file():
            raise InputError(
                f"{self.values['camera_file'] or 'the file'}: there is no such file; a calibrated camera's"
            )
        if not own_camera(path):
            return None
        camera = read_camera(path).camera
        write_atomically(self.folder / "camera.yaml", path.read_bytes())
        return [Line(f"{camera.width_px} x {camera.height_px} px", "OK")]

    def _check(self) -> list[Line]:
        done = self._run(["gripmon", "check", "config.yaml", "--json"])
        try:
            found = msgspec.json.decode(done.stdout)["findings"]
        except (msgspec.DecodeError, KeyError):
            raise NoResultError(last_line(done.stderr) or "gripmon check printed nothing") from None
        write_atomically(self.folder / "check.json", done.stdout.encode())
        return findings(found)

    def checked(self) -> list[Line]:
        """The lines of the last forecast; empty if there is none."""
        with contextlib.suppress(OSError, msgspec.DecodeError, KeyError):
            return findings(msgspec.json.decode((self.folder / "check.json").read_bytes())["findings"])
        return []

    def _as_shown(self, step: str) -> list[Line]:
        """Run the command that a step shows."""
        command = BY_NAME[step].plan(self.values).command
        assert command is not None
        return self._command(command())

    def _command(self, words: list[str]) -> list[Line]:
        done = self._run(words)
        if done.returncode != 0:
            raise NoResultError(last_line(done.stderr) or f"{shlex.join(words)} ended with {done.returncode}")
        lines = [Line(text) for text in done.stdout.splitlines()]
        return [*lines, *(Line(text, "WARN") for text in done.stderr.splitlines())]

    def _run(self, words: list[str]) -> subprocess.CompletedProcess[str]:
        assert words[0] == "gripmon"
        return subprocess.run(
            [sys.executable, "-m", *words], cwd=self.folder, capture_output=True, text=True, check=False,
            stdin=subprocess.DEVNULL,
        )  # fmt: skip


def _texts(path: Path, kept: Mapping[str, object], key: str) -> dict[str, str]:
    found = kept.get(key, {})
    if not isinstance(found, dict) or not all(isinstance(text, str) for pair in found.items() for text in pair):
        raise InputError(f"{path}: {key}: isn't a table of texts; a file of gripmon setup, or delete it")
    return dict(found)
