"""Rough corners of a gripper that has no file yet, for ``gripmon calibrate plane --infer``: put, saved, nothing more.

Without a gripper nothing is known of the edges, so nothing snaps and nothing is foretold.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path

from gripmon import __version__
from gripmon.calibrate.sighting import CalibrationError
from gripmon.model.atomic import write_atomically
from gripmon.teach.edges.files import Picture
from gripmon.teach.onboarding.outlines import FINGERS, INNERMOST, POINTS, SIDES, outlines_of
from gripmon.teach.page.desk import BadRequest, encoded
from gripmon.teach.page.messages import PictureInfo, Place, Put, Reply, Saved, SaveOrder, State

_NAMES = tuple(f"{finger}_{point}_{side}" for point in POINTS for finger in FINGERS for side in SIDES)
_COLUMNS = {"left": 0.06, "right": 0.8}


class RoughDesk:
    """As :class:`gripmon.teach.page.Desk`, without a gripper: one image, whose corners go to ``path``.

    ``follows``: the command that reads that file, ``note`` what is to be said of it; ``saved``: what was last written,
    None before.
    """

    def __init__(self, picture: Picture, path: Path, follows: str, note: str):
        self._picture, self._path, self._follows, self._note = picture, path, follows, note
        self._lock = threading.Lock()
        self.saved: Saved | None = None

    def close(self) -> None:
        """Nothing is held."""

    def dark(self) -> tuple[float, str]:
        """There is no camera that could show nothing."""
        return 0.0, ""

    def state(self) -> State:
        height_px, width_px = self._picture.image.shape[:2]
        return State(
            version=__version__,
            width_px=width_px,
            height_px=height_px,
            corners=_NAMES,
            fingers={name: name.partition("_")[0] for name in _NAMES},
            places=_columns(width_px, height_px),
            pictures=(PictureInfo(number=0, name=self._picture.name, jaw_opening_m=None),),
            live=None,
            has_jaw=False,
            jaw_m=(0.0, 0.0, 0.0),
            gripper="no gripper file yet",
            reference=None,
            needed=2 * len(INNERMOST),
            robot="robot",  # neither name is asked for, nor written
            camera_name="camera",
            fixed_names=True,
            folder=str(self._path.parent.resolve()),
            files={"corners": str(self._path), "config": "", "taught": ""},
            corners_only=True,
        )

    def look(self, put: Put) -> Reply:
        """Always :class:`BadRequest`."""
        raise BadRequest("nothing snaps without a gripper file; corners are put and saved")

    def take(self) -> tuple[PictureInfo, ...]:
        """Always :class:`BadRequest`."""
        raise BadRequest("there is no live camera here")

    def live(self) -> bytes:
        """Always :class:`BadRequest`."""
        raise BadRequest("there is no live camera here")

    def still(self, number: int) -> bytes:
        """The image as PNG.  Raises :class:`BadRequest`."""
        if number != 0:
            raise BadRequest(f"there is no image {number}; 1 is there")
        return encoded(self._picture.image, ".png")

    def save(self, order: SaveOrder) -> Saved:
        """Write the corners that were put, if ``calibrate plane --infer`` can use them; else say why not."""
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
    """Where the handles wait: a column for each finger, in the order of its outline."""
    order = [f"{point}_near" for point in reversed(POINTS)] + [f"{point}_far" for point in POINTS]
    return {
        f"{finger}_{point}": (round(share * width_px, 1), round((k + 0.7) / (len(order) + 0.8) * height_px, 1))
        for finger, share in _COLUMNS.items()
        for k, point in enumerate(order)
    }
