"""The page of ``gripmon setup``: its requests to the steps, and its state."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from gripmon.daemon.setup import entries, steps
from gripmon.daemon.setup.capture import Capture, CaptureState
from gripmon.daemon.setup.lines import Line
from gripmon.daemon.setup.project import VIEW, Project, StepState
from gripmon.daemon.setup.running import MonitorProcess, MonitorView
from gripmon.daemon.setup.steps import STEPS
from gripmon.daemon.teaching import outline_page, page_session, read_inputs
from gripmon.model.errors import InputError, NoResultError, in_short
from gripmon.model.targets import OtherSizeError
from gripmon.teach.messages import BadRequest, EmptyRequest, Request
from gripmon.teach.page_server import Action, Sandboxed, Served, web_files
from gripmon.teach.sites import OutlineSite, TeachSite

_Name = Annotated[str, Meta(max_length=40)]
_Answers = Annotated[dict[_Name, Annotated[str, Meta(max_length=2000)]], Meta(max_length=40)]
_PICTURES = {
    VIEW: "image/jpeg", "camera.html": "text/html; charset=utf-8", "gripper.png": "image/png",
    "hand_eye.png": "image/png", "target.pdf": "application/pdf",
}  # fmt: skip


class StepRequest(Request, frozen=True):
    """Carry out a step with the values of its fields."""

    step: _Name
    values: _Answers = msgspec.field(default_factory=dict)


class CaptureOrder(Request, frozen=True):
    """``take`` the image shown, read the ``next`` one of a folder, ``drop`` the image ``name``."""

    step: _Name
    action: Literal["start", "stop", "by_itself", "by_hand", "take", "next", "drop"]
    values: _Answers = msgspec.field(default_factory=dict)
    name: Annotated[str, Meta(max_length=200)] = ""


class StepCard(msgspec.Struct, frozen=True, kw_only=True):
    """The constant and the changing part of a step; ``picture``: its newest picture's address; ``said``: output of the
    last run; ``error``: why it failed.
    """

    title: str
    about: str
    kind: str
    button: str
    picture: str | None
    fields: tuple[steps.Field, ...]
    state: StepState
    said: tuple[Line, ...]
    error: str


class SetupState(msgspec.Struct, frozen=True, kw_only=True):
    """``values`` of all fields; ``boxes``: of those that are boxes to tick the text, which is their value then, empty
    where there is nothing to confirm; ``busy``: the step being carried out; ``capture``: of the step ``capturing``,
    whose camera runs or ran last.
    """

    folder: str
    values: dict[str, str]
    boxes: dict[str, str]
    busy: str | None
    steps: tuple[StepCard, ...]
    capturing: str | None
    capture: CaptureState | None
    monitor: MonitorView


class SetupSite:
    """Serves one project; an open teaching page is below ``page/``."""

    def __init__(self, project: Project) -> None:
        self._project = project
        self._files = web_files("setup.html")
        self._lock = threading.Lock()
        self._busy: str | None = None
        self._said: dict[str, tuple[Line, ...]] = {"check": tuple(project.checked())}
        self._errors: dict[str, str] = {}
        self._capture: tuple[str, Capture] | None = None
        self._page: TeachSite | OutlineSite | None = None
        self._monitor = MonitorProcess(project.folder)

    def close(self) -> None:
        """Release the camera, and stop the monitor that was started here."""
        self._let_go()
        self._close_page()
        self._monitor.stop()

    def get(self, path: str) -> Served | None:
        path, _, _ = path.partition("?")
        if path in self._files:
            return self._files[path]
        page = self._page
        if path.startswith("page/") and page is not None:
            return page.get(path.removeprefix("page/"))
        if path == "state":
            return msgspec.json.encode(self.state()), "application/json"
        if path == "live.jpg" and self._capture is not None:
            return self._capture[1].preview(), "image/jpeg"
        if path == "monitor.jpg":
            return self._monitor.picture(), "image/jpeg"
        name = path.removeprefix("file/")
        if path == f"file/{name}" and name in _PICTURES and (self._project.folder / name).is_file():
            data = (self._project.folder / name).read_bytes()
            return Sandboxed(data) if name.endswith(".html") else data, _PICTURES[name]
        return None

    def post(self, path: str) -> Action | None:
        page = self._page
        if path == "page/done":
            return EmptyRequest, lambda _: self._close_page()
        if path.startswith("page/"):
            return None if page is None else page.post(path.removeprefix("page/"))
        actions: dict[str, Action] = {
            "do": (StepRequest, self._do),
            "capture": (CaptureOrder, self._captured),
            "open": (StepRequest, self._open),
            "start": (EmptyRequest, lambda _: self._start()),
            "stop": (EmptyRequest, lambda _: self._monitor.stop()),
        }
        return actions.get(path)

    def state(self) -> SetupState:
        """The state for the page."""
        capturing = self._capture
        states = self._project.states()
        return SetupState(
            folder=str(self._project.folder),
            values=dict(self._project.values),
            boxes={name: self._box(asked) for name, asked in steps.BOXES.items()},
            busy=self._busy,
            steps=tuple(self._card(step, state) for step, state in zip(STEPS, states, strict=True)),
            capturing=None if capturing is None else capturing[0],
            capture=None if capturing is None else capturing[1].state(),
            monitor=self._monitor.seen(),
        )

    def _card(self, step: steps.Step, state: StepState) -> StepCard:
        return StepCard(
            title=step.title, about=step.about, kind=step.kind, button=step.button, fields=step.fields, state=state,
            picture=self._picture(step), said=self._said.get(step.name, ()), error=self._errors.get(step.name, ""),
        )  # fmt: skip

    def _picture(self, step: steps.Step) -> str | None:
        """Its address, with the time at which it was written, so that the browser loads every new one."""
        if step.picture is None:
            return None
        with contextlib.suppress(FileNotFoundError):
            return f"file/{step.picture}?{(self._project.folder / step.picture).stat().st_mtime_ns}"
        return None

    def _box(self, asked: Callable[[entries.Values], str]) -> str:
        """Text of a box; empty if there is nothing to confirm, or no target yet."""
        with contextlib.suppress(InputError):
            return asked(self._project.values)
        return ""

    def _do(self, order: StepRequest) -> None:
        """Start a step; the state shows when and how it ends."""
        # Of the steps that take images only "standing" can be done without a camera.
        self._named(order.step, "form", *(("capture",) if order.step == "standing" else ()))
        with self._lock:
            if self._busy is not None:
                raise BadRequest(f"the step {self._busy} is still running")
            self._project.keep(order.values)
            self._busy = order.step
        self._errors.pop(order.step, None)
        self._said.pop(order.step, None)
        self._let_go()
        threading.Thread(target=self._work, args=(order.step,), name="gripmon-setup-step", daemon=True).start()

    def _work(self, step: str) -> None:
        try:
            done = self._project.do(step)
            self._said[step] = tuple(Line(steps.in_fields(e.text), e.level) if e.level else e for e in done)
        except OtherSizeError as error:
            self._errors[step] = str(error.worded("tick the box below"))
        except (InputError, NoResultError) as error:
            self._errors[step] = steps.in_fields(str(error))
        except Exception as error:  # noqa: BLE001  the page must report any failure, and continue
            self._errors[step] = in_short(error)
        finally:
            self._busy = None

    def _captured(self, order: CaptureOrder) -> None:
        self._named(order.step, "capture")
        self._errors.pop(order.step, None)
        if order.values:
            self._project.keep(order.values)
        if order.action == "start":
            self._start_camera(order.step)
            return
        capture = self._capture
        if capture is None or capture[0] != order.step:
            capture = self._capture = order.step, self._project.capture(order.step)
        match order.action:
            case "stop":
                capture[1].stop()
            case "by_itself" | "by_hand":
                capture[1].by_itself(order.action == "by_itself")
            case "take":
                capture[1].take()
            case "next":
                capture[1].go_on()
            case _:
                capture[1].drop(order.name)

    def _start_camera(self, step: str) -> None:
        self._let_go()
        if self._monitor.running:
            raise BadRequest("the monitor uses the camera; stop it first")
        capture = self._project.capture(step)
        with self._shown_at(step):
            capture.start(self._project.open_camera(step))
        self._capture = step, capture

    def _open(self, order: StepRequest) -> dict[str, str]:
        """Open a teaching page; return its address."""
        self._named(order.step, "page")
        self._project.keep(order.values)
        self._let_go()
        self._close_page()
        state = next(each for each in self._project.states() if each.name == order.step)
        if state.progress == "waits":
            raise BadRequest(state.note)
        with self._shown_at(order.step):
            self._page = self._opened(order.step, state.command)
        return {"url": "page/"}

    def _opened(self, step: str, command: str) -> TeachSite | OutlineSite:
        values, camera, back = self._project.values, Path("camera.yaml"), f"../#{step}"
        images = [Path("standing" if step == "corners" else "teaching") / name for name in self._images(step)]
        if step == "corners" and values["gripper"] == entries.INFERRED:
            return outline_page(images[0], camera, Path("standing"), back)
        corners = step == "corners"
        inputs = read_inputs(
            images[:1] if corners else images,
            command=command,
            out=Path("standing" if corners else "."),
            camera=camera,
            gripper=Path("gripper.yaml"),
            reference=None if corners or values["reference_by"] == entries.BY_CORNERS else Path("hand_eye.yaml"),
            source=None if corners else values["source"],
            robot=values["robot"],
            camera_name=values["camera_name"],
        )
        return TeachSite(page_session(inputs), back, ("corners",) if corners else None)

    def _images(self, step: str) -> tuple[str, ...]:
        return Capture(self._project.folder / ("standing" if step == "corners" else "teaching"), None).images()

    def _start(self) -> None:
        self._let_go()
        with self._shown_at("run"):
            self._monitor.start()

    @contextlib.contextmanager
    def _shown_at(self, step: str) -> Iterator[None]:
        """What the person gave wrong, also shown at the step until it is tried again."""
        self._errors.pop(step, None)
        try:
            yield
        except InputError as error:
            self._errors[step] = str(error)
            raise

    @staticmethod
    def _named(name: str, *kinds: str) -> None:
        if not any(step.name == name and step.kind in kinds for step in STEPS):
            raise BadRequest(f"there is no step {name} of this kind")

    def _let_go(self) -> None:
        """Release the camera, which only one process can open."""
        if self._capture is not None:
            self._capture[1].stop()

    def _close_page(self) -> None:
        page, self._page = self._page, None
        if page is not None:
            page.close()
