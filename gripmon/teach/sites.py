"""The teaching page: for a gripper whose corners snap to its edges, and without one, for rough corners in one image."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path

import msgspec

from gripmon import __version__
from gripmon.calibrate.sighting import CalibrationError
from gripmon.model.atomic import write_atomically
from gripmon.teach.api import Picture
from gripmon.teach.messages import (
    CornersRequest,
    EmptyRequest,
    PictureInfo,
    Place,
    Saved,
    SaveOrder,
    State,
    encoded,
)
from gripmon.teach.outlines import FINGERS, INNERMOST, POINTS, SIDES, outlines_of
from gripmon.teach.page_server import Action, Served, web_files
from gripmon.teach.session import TeachSession


class TeachSite:
    """The page of one session.  ``back``: where it goes when the person is done, None for nowhere; ``saves``: which
    files it offers, None for all.
    """

    def __init__(self, session: TeachSession, back: str | None = None, saves: tuple[str, ...] | None = None) -> None:
        self.session, self._back, self._saves = session, back, saves
        self._files = web_files("index.html")

    def close(self) -> None:
        """Release the camera."""
        self.session.close()

    def get(self, path: str) -> Served | None:
        """The page's files, its state, images and the live image."""
        if path == "state":
            state = self.session.state()
            state = msgspec.structs.replace(state, back=self._back, saves=self._saves or state.saves)
            return msgspec.json.encode(state), "application/json"
        if path.partition("?")[0] == "live.jpg":
            return self.session.live(), "image/jpeg"
        number = path.removeprefix("image/").removesuffix(".png")
        if path == f"image/{number}.png" and number.isascii() and number.isdecimal() and len(number) < 6:
            return self.session.still(int(number)), "image/png"
        return self._files.get(path)

    def post(self, path: str) -> Action | None:
        """To snap, to keep the live image, to save."""
        session = self.session
        actions: dict[str, Action] = {
            "look": (CornersRequest, session.look),
            "take": (EmptyRequest, lambda _: session.take()),
            "save": (SaveOrder, session.save),
        }
        return actions.get(path)


_NAMES = tuple(f"{finger}_{point}_{side}" for point in POINTS for finger in FINGERS for side in SIDES)
_COLUMNS = {"left": 0.06, "right": 0.8}


class OutlineSite:
    """The page without a gripper: one image, in which nothing snaps, and whose corners go to ``path``.

    ``follows``: the command that reads that file; ``note``: a remark on it; ``saved``: what was last written, None
    before.
    """

    def __init__(self, picture: Picture, path: Path, follows: str, note: str, back: str | None = None) -> None:
        self._picture, self._path, self._follows, self._note, self._back = picture, path, follows, note, back
        self._files = web_files("index.html")
        self._lock = threading.Lock()
        self.saved: Saved | None = None

    def close(self) -> None:
        """Nothing to release."""

    def get(self, path: str) -> Served | None:
        """The page's files, its state, the image."""
        if path == "state":
            return msgspec.json.encode(self._state()), "application/json"
        if path == "image/0.png":
            return encoded(self._picture.image, ".png"), "image/png"
        return self._files.get(path)

    def post(self, path: str) -> Action | None:
        """To save."""
        return (SaveOrder, self._save) if path == "save" else None

    def _state(self) -> State:
        height_px, width_px = self._picture.image.shape[:2]
        return State(
            width_px=width_px,
            height_px=height_px,
            corners=_NAMES,
            places=_columns(width_px, height_px),
            pictures=(PictureInfo(number=0, name=self._picture.name, jaw_opening_m=None),),
            gripper="no gripper file yet",
            needed=2 * len(INNERMOST),
            robot="robot",  # the page neither asks for these names nor writes them
            camera_name="camera",
            folder=str(self._path.parent.resolve()),
            files={"corners": str(self._path), "config": "", "taught": ""},
            corners_only=True,
            saves=("corners",),
            back=self._back,
        )

    def _save(self, order: SaveOrder) -> Saved:
        """Write the corners if ``calibrate plane --infer`` can use them; otherwise return the reason."""
        corners = order.put.corners
        try:
            outlines_of(corners)
        except CalibrationError as error:
            return Saved(refused=str(error))
        with self._lock:
            if self._path.exists() and not order.replace:
                return Saved(exists=(str(self._path),))
            try:
                write_atomically(self._path, self._text(corners).encode())
            except OSError as error:
                return Saved(refused=f"{self._path}: can't be written ({error.strerror or error})")
            self.saved = Saved(written={str(self._path): "rough corners"}, notes=(self._note,), next=self._follows)
            return self.saved

    def _text(self, corners: Mapping[str, Place]) -> str:
        image = " ".join(ascii(self._picture.name)[1:-1].split())
        lines = [
            f"# Rough fingertip corners in {image}, put by hand (gripmon teach --page, gripmon {__version__})",
            "# For gripmon calibrate plane --infer --corners; name: [column, row] in the image (px)",
            "corners:",
        ]
        lines += [f"  {name}: [{corners[name][0]:.2f}, {corners[name][1]:.2f}]" for name in _NAMES if name in corners]
        return "\n".join(lines) + "\n"


def _columns(width_px: int, height_px: int) -> dict[str, Place | None]:
    """First positions of the handles: a column for each finger, in the order of its outline."""
    order = [f"{point}_near" for point in reversed(POINTS)] + [f"{point}_far" for point in POINTS]
    return {
        f"{finger}_{point}": (round(share * width_px, 1), round((k + 0.7) / (len(order) + 0.8) * height_px, 1))
        for finger, share in _COLUMNS.items()
        for k, point in enumerate(order)
    }
