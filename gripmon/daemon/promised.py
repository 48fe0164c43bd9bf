"""The images that ``gripmon check`` judges a configuration by, and a monitor's own bounds over them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2

from gripmon.daemon.api import Monitor, open_configured, open_source
from gripmon.daemon.config import Config
from gripmon.daemon.forecast import rig_of
from gripmon.io.sources import EpisodeSettings, FolderSettings, SourceSettings, VideoSettings, settings_for_path
from gripmon.model.errors import InputError
from gripmon.model.images import image_in
from gripmon.model.records import Frame
from gripmon.monitor import warm_up
from gripmon.teach.drawing import draw_doubted
from gripmon.teach.kept import APART_S, Kept, doubted_edges, kept, with_help
from gripmon.teach.views import TeachingImage
from gripmon.teach.visibility import Rig

MOST_IMAGES = 100
"""Images that are taken, from the beginning: thirty settle where the reference's frames had the gripper, and the others
show what a bound is then; a second or two of computing.
"""


class Images(NamedTuple):
    """Images of the gripper at its reference: ``what`` they are in words, and where they are read from."""

    what: str
    files: tuple[tuple[Path, float | None], ...] = ()
    """Single ones, each with its jaw opening (m)."""
    source: SourceSettings | None = None
    """A source of frames instead: the configuration's own, or another."""


def images_of(config: Config, given: Path | None = None) -> Images | None:
    """The images to judge a configuration by: those ``given``, else its recorded source, else those that it was taught
    from, as far as they are still there unchanged; None where there are none.  Raises :class:`InputError`.
    """
    if given is not None:
        if not given.exists():
            raise InputError(f"{given}: there is no such file or folder; a folder of images, or a video", "images")
        return Images(f"{given}", source=settings_for_path(given, 1.0 / APART_S if given.is_dir() else None))
    if isinstance(config.settings.source, FolderSettings | VideoSettings | EpisodeSettings):
        return Images("the source's images", source=config.settings.source)
    if config.taught is None:
        return None
    found = []
    for image in config.taught.provenance.images:
        places = (Path(image.file), config.directory / image.file)
        same = (p for p in places if p.is_file() and hashlib.sha256(p.read_bytes()).hexdigest() == image.sha256)
        if (path := next(same, None)) is not None:
            found.append((path, image.jaw_opening_m))
    return Images("the images taught from", files=tuple(found)) if found else None


def frames_of(config: Config, images: Images) -> Iterator[Frame]:
    """The first :data:`MOST_IMAGES` of them as frames, with the openings that the monitor is told."""
    with_opening = Monitor(config).with_opening
    if images.source is None:
        for number, (path, opening_m) in enumerate(images.files[:MOST_IMAGES]):
            frame = Frame(number, round(1e9 * APART_S * (number + 1)), image_in(path), opening_m, str(path))
            yield frame if opening_m is not None else with_opening(frame)
        return
    own = images.source is config.settings.source
    source = open_configured(config) if own else open_source(images.source)
    try:
        for _ in range(MOST_IMAGES):
            item = source.read()
            if not isinstance(item, Frame):
                return
            yield with_opening(item)
    finally:
        source.close()


def kept_of(config: Config, images: Images) -> Kept:
    """What the monitor says over these images, and what would help most."""
    warm_up()
    rig = rig_of(config)

    def run(known: Rig) -> Kept:
        return kept(known, config.reference, frames_of(config, images))

    return with_help(run(rig), rig, run)


def picture_of(config: Config, images: Images, found: Kept, ending: str) -> bytes | None:
    """The first image with what costs most drawn in it; ``ending``: .png, .jpg or .jpeg.  None without an image."""
    frame = next((frame for frame in frames_of(config, images) if frame.image is not None), None)
    if frame is None or frame.image is None:
        return None
    rig, cam_T_grip = rig_of(config), config.cam_T_grip
    doubted = doubted_edges(found, rig, cam_T_grip)
    shown = TeachingImage(frame.image, frame.jaw_opening_m or config.jaw_opening_m or 0.0, frame.name)
    drawn = draw_doubted(rig.camera, rig.gripper, cam_T_grip, shown, doubted, config.view().edges_visible, found.why())
    return bytes(cv2.imencode(ending, drawn)[1].tobytes())
