"""Files of teaching from corners: the taught model, a configuration, the corners; each whole or not at all."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from gripmon import __version__
from gripmon.calibrate.detection import BLURRED_PX
from gripmon.calibrate.grey_levels import sharpest_blur_px, to_grey
from gripmon.daemon.config import ConfigError, load_config
from gripmon.daemon.config.writing import with_taught
from gripmon.daemon.teaching.inputs import Inputs, live_settings, read_rough
from gripmon.daemon.teaching.written import config_text
from gripmon.io.sources import SourceError, open_source
from gripmon.model.atomic import write_atomically
from gripmon.model.errors import InputError, NoResultError
from gripmon.model.project import FILES
from gripmon.model.records import ReferenceRecord
from gripmon.model.response import ResponseSeen
from gripmon.model.yaml_text import yaml_value
from gripmon.teach.api import Picture, taught_from, to_yaml, told_response
from gripmon.teach.messages import CornersRequest, Evaluation, Saved, SaveOrder, SavingRefused
from gripmon.teach.session import Labels, TeachSession
from gripmon.teach.snapping import FEWEST_PUT
from gripmon.teach.views import TeachingRefused
from gripmon.teach.visibility import Rig
from gripmon.track.edges import TaughtModel

TAUGHT, CONFIG, CORNERS, IMAGES = FILES["taught"], FILES["config"], "corners.yaml", "teaching"


class FileSaving:
    """Writes the files into one folder, after checking that they can be used."""

    def __init__(self, inputs: Inputs):
        self._inputs = inputs
        self.picture: Callable[[str], bytes] | None = None
        """The first image with what was taught, once that is saved, in the format of a file's ending."""

    @property
    def _paths(self) -> dict[str, Path]:
        """The path of each file."""
        inputs, config = self._inputs, self._inputs.config
        named = None if config is None else config.taught_path
        return {
            "taught": inputs.folder / TAUGHT if named is None else named,
            "config": inputs.folder / CONFIG if config is None else config.path,
            "corners": inputs.folder / CORNERS,
        }

    def labels(self) -> Labels:
        """What the page shows."""
        inputs, known = self._inputs, self._inputs.setup.reference
        return Labels(
            robot=inputs.robot,
            camera_name=inputs.camera_name,
            fixed_names=inputs.config is not None,
            folder=str(inputs.folder.resolve()),
            files={kind: str(path) for kind, path in self._paths.items()},
            reference=None if known is None else known.reference_id,
            live=inputs.live,
        )

    def save(self, order: SaveOrder, found: Evaluation, number: int, pictures: Sequence[Picture]) -> Saved:
        """As :class:`gripmon.teach.session.Saving`."""
        paths, light = self._paths, self._light(pictures)
        notes: list[str] = []
        wanted = [kind for kind in ("corners", "taught", "config") if getattr(order, kind)]
        if not wanted:
            raise SavingRefused("nothing is to be saved; at least one of the files")
        if "config" in wanted and self._names_it_already(order):
            wanted.remove("config")
        exists = tuple(str(paths[kind]) for kind in wanted if paths[kind].exists())
        if exists and not order.replace:
            return Saved(exists=exists)
        self._check_sharp(pictures)
        texts: dict[str, str] = {}
        if "corners" in wanted:
            texts["corners"] = self._corners(order, found, pictures[number].name)
        pictures, files = self._pictures(pictures)
        reference = found.reference
        if reference is None and {"taught", "config"} & set(wanted):
            raise SavingRefused(f"{found.no_reference}; or save the corners only")
        model = None
        if order.taught and reference is not None:
            model, notes = self._taught(order, found, reference, pictures, files, light)
            texts["taught"] = to_yaml(model)
        if "config" in wanted and reference is not None:
            texts["config"] = self._config(order, found, model is not None)
            self._try_out(texts["config"], model)
        written = self._write(texts, files if order.taught else {})
        config_path = paths["config"] if self._inputs.config is not None or "config" in texts else None
        follows = None if config_path is None or not config_path.exists() else f"gripmon check {config_path}"
        return Saved(written=written, notes=(*light.notes, *notes), next=follows)

    def _light(self, pictures: Sequence[Picture]) -> ResponseSeen:
        """The camera's response, a live one's from the images that are kept."""
        inputs = self._inputs
        if inputs.response is not None:
            return inputs.response
        light = told_response(pictures, "auto", None)
        settings = inputs.setup.settings.with_response(light.response)
        self._inputs = replace(inputs, setup=replace(inputs.setup, settings=settings))
        return light

    def _names_it_already(self, order: SaveOrder) -> bool:
        """Whether the given configuration stays as it is: it names a taught model already, or none is saved."""
        config = self._inputs.config
        return config is not None and (config.taught_path is not None or not order.taught)

    def _pictures(self, pictures: Sequence[Picture]) -> tuple[list[Picture], dict[str, bytes]]:
        """Save live images as files, so that the taught model can be made again."""
        out, files = [], {}
        for picture in pictures:
            if picture.path is None:
                ending = ".tif" if picture.image.dtype.kind == "f" else ".png"
                path = str(self._inputs.folder / IMAGES / Path(picture.name).with_suffix(ending))
                picture = replace(picture, path=path)
                files[path] = cv2.imencode(ending, picture.image)[1].tobytes()
            out.append(picture)
        return out, files

    @staticmethod
    def _check_sharp(pictures: Sequence[Picture]) -> None:
        for picture in pictures:
            blur_px = sharpest_blur_px(to_grey(picture.image))
            if blur_px > BLURRED_PX:
                raise SavingRefused(
                    f"{picture.name}: blurred: its sharpest edges have a standard deviation of {blur_px:.1f} px, at "
                    f"most {BLURRED_PX:g} px; an image in focus, without motion"
                )

    def _taught(
        self,
        order: SaveOrder,
        found: Evaluation,
        reference: ReferenceRecord,
        pictures: Sequence[Picture],
        files: Mapping[str, bytes],
        light: ResponseSeen,
    ) -> tuple[TaughtModel, list[str]]:
        setup, opening_m = self._inputs.setup, found.snapped.jaw_opening_m
        given = order.put.jaw_opening_m is not None
        pictures = [replace(p, jaw_opening_m=opening_m) if given or p.jaw_opening_m is None else p for p in pictures]
        rig = Rig(setup.camera, setup.gripper, setup.settings)
        try:
            teaching = taught_from(pictures, rig, reference, light, self._inputs.command, files)
        except TeachingRefused as refused:
            why = f"no taught model: {refused}; or save without it: on the page untick it"
            raise SavingRefused(why, refused.notes) from None
        self.picture, taught = teaching.picture, teaching.taught
        left = [f"{name} is not taught: {why}" for name, why in taught.untaught.items()]
        return teaching.model, [*(f"left out: {why}" for why in taught.left_out.values()), *taught.notes, *left]

    def _corners(self, order: SaveOrder, found: Evaluation, image: str) -> str:
        """Corners as ``--corners`` reads them."""
        lines = [
            f"# Fingertip corners in {image}, written by {self._inputs.command} (gripmon {__version__})",
            "# For gripmon calibrate plane --corners, gripmon teach --corners; name: [column, row] in the image (px)",
            "corners:",
        ]
        for corner in found.snapped.corners:
            by_hand = order.put.corners.get(corner.name)
            if by_hand is not None and (corner.name in order.put.by_hand or corner.uv_px is None):
                lines.append(f"  {corner.name}: {yaml_value([round(v, 4) for v in by_hand])}  # by hand")
            elif corner.uv_px is not None:
                at = [round(v, 4) for v in corner.uv_px.tolist()]
                lines.append(f"  {corner.name}: {yaml_value(at)}  # measured, +- {corner.sigma_px:.3f} px")
        if len(lines) == 3:
            lines[-1] = "corners: {}"
        return "\n".join(lines) + "\n"

    def _config(self, order: SaveOrder, found: Evaluation, taught: bool) -> str:
        given = self._inputs.config
        if given is not None:
            return with_taught(given.path, self._paths["taught"])
        return config_text(self._inputs, order, found, TAUGHT if taught else None)

    def _try_out(self, text: str, model: TaughtModel | None) -> None:
        """Check that the configuration will be valid; otherwise nothing is written."""
        try:
            load_config(
                self._paths["config"], check_source=False, with_taught=model is not None, say_gone=False, text=text,
                taught=model,
            )  # fmt: skip
        except ConfigError as error:
            raise SavingRefused(f"the configuration would be refused: {error}") from None

    def _write(self, texts: Mapping[str, str], files: Mapping[str, bytes]) -> dict[str, str]:
        """Write each file whole or not at all; the configuration last, since it names the others."""
        words = {"corners": "the corners", "taught": "the taught model", "config": "the configuration"}
        written: dict[str, str] = {}
        todo = [(Path(path), data, "an image") for path, data in files.items()]
        todo += [(self._paths[k], texts[k].encode(), words[k]) for k in ("corners", "taught", "config") if k in texts]
        for path, data, what in todo:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                write_atomically(path, data)
            except OSError as error:
                done = f"; written before: {', '.join(written)}" if written else ""
                raise SavingRefused(f"{path}: can't be written ({error.strerror or error}){done}") from None
            written[str(path)] = what
        return written


def page_session(inputs: Inputs) -> TeachSession:
    """The session of the page.  Raises :class:`~gripmon.model.errors.InputError` for a camera that can't be opened."""
    try:
        live = None if inputs.live is None else open_source(live_settings(inputs.live, inputs.setup.camera))
    except SourceError as error:
        raise InputError(str(error), "live") from None
    saving = FileSaving(inputs)
    return TeachSession(inputs.setup, inputs.pictures, saving.labels(), saving, live)


def teach_from_file(
    inputs: Inputs, path: Path
) -> tuple[Evaluation, Callable[[bool], tuple[Saved, Callable[[str], bytes] | None]]]:
    """The evaluation of the corners in a file for the first picture, and a function that teaches from all pictures and
    saves it (True: replace existing files); this returns also what draws it (:attr:`FileSaving.picture`).

    Raises :class:`~gripmon.model.errors.InputError` for invalid corners, and
    :class:`~gripmon.model.errors.NoResultError` if nothing can be taught from them.
    """
    rough, setup, picture = read_rough(path, inputs.setup.gripper), inputs.setup, inputs.pictures[0]
    if setup.reference is None and len(rough) < FEWEST_PUT:
        raise InputError(
            f"{path}: {len(rough)} of the gripper's corners; at least {FEWEST_PUT}, hidden ones too, about where they "
            "would show; or --reference FILE (of gripmon calibrate plane)"
        )
    corners = {name: np.array(at) for name, at in rough.items()}
    found = setup.evaluate(picture.image, corners, (), picture.jaw_opening_m)
    if found.snapped.refused is not None:
        raise NoResultError(f"{picture.name}: {found.snapped.refused}")
    put = CornersRequest(corners=rough, image=0, jaw_opening_m=picture.jaw_opening_m)

    def save(replace: bool) -> tuple[Saved, Callable[[str], bytes] | None]:
        saving = FileSaving(inputs)
        order = SaveOrder(put=put, robot=inputs.robot, camera_name=inputs.camera_name, replace=replace)
        try:
            return saving.save(order, found, 0, inputs.pictures), saving.picture
        except SavingRefused as refused:
            raise NoResultError(f"teach: {refused}", refused.notes) from None

    return found, save
