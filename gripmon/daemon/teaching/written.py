"""The configuration that teaching writes."""

from __future__ import annotations

from pathlib import Path
from statistics import NormalDist
from typing import Any

import msgspec

from gripmon.daemon.config.settings import JawSettings
from gripmon.daemon.config.writing import defaults, reference_section, relative, text_of
from gripmon.daemon.teaching.inputs import Inputs
from gripmon.io.sources import FolderSettings, SourceError
from gripmon.io.sources.files import opening_beside
from gripmon.model.gripper import SIZE_UNKNOWN
from gripmon.model.records import ValidBy
from gripmon.teach.messages import Evaluation, SaveOrder


def config_text(inputs: Inputs, order: SaveOrder, found: Evaluation, taught: str | None) -> str:
    """The whole file, for the folder of ``inputs``; ``taught``: name of the taught model (None: none).

    The defaults are commented out but for the response of the camera as it was found, and for what a transform of a
    gripper of unknown size or tilt is valid by: its motion since the reference.
    """
    source, reference, setup = inputs.source, found.reference, inputs.setup
    assert source is not None and reference is not None
    if isinstance(source, FolderSettings):
        source = msgspec.structs.replace(source, path=relative(Path(source.path), inputs.folder))
    sections: dict[str, Any] = {
        "camera": setup.camera.settings,
        "reference": reference_section(
            reference.cam_T_grip, id=reference.reference_id, covariance=reference.covariance,
            with_gripper=reference.with_gripper,
        ),
    }  # fmt: skip
    sections |= {part: relative(path, inputs.folder) for part, path in inputs.calibrations.items()}
    text = text_of(
        inputs.command, robot=order.robot, camera_name=order.camera_name,
        gripper=relative(inputs.gripper_path, inputs.folder), taught=taught, source=source,
        jaw=_jaw(inputs, found.snapped.jaw_opening_m) if setup.gripper.has_jaw else None, **sections,
    )  # fmt: skip
    model, monitor = setup.gripper.model, setup.settings
    tilt_rad = NormalDist().inv_cdf(1.0 - monitor.policy.integrity_risk / 4.0) * model.tilt_sigma_rad  # of a bound
    taken: list[tuple[str, ...]] = [("corners", "edges", "response")]
    if not (model.scale_sigma < SIZE_UNKNOWN and tilt_rad < monitor.policy.alert_limit_rad):
        policy = msgspec.structs.replace(monitor.policy, valid_by=ValidBy.REFERENCE)
        monitor, taken = msgspec.structs.replace(monitor, policy=policy), [*taken, ("policy", "valid_by")]
    return text + defaults(monitor, *taken)


def _jaw(inputs: Inputs, opening_m: float | None) -> JawSettings:
    """As asked for; else from the frames if the images' own table has their openings, else fixed as seen or given."""
    if inputs.jaw_source in ("frames", "zenoh"):
        return JawSettings(source="zenoh" if inputs.jaw_source == "zenoh" else "frames")
    openings = [picture.jaw_opening_m for picture in inputs.pictures]
    if inputs.jaw_source is None and openings and None not in openings and _in_table(inputs):
        return JawSettings(source="frames")
    return JawSettings(opening_m=None if opening_m is None else round(opening_m, 7))


def _in_table(inputs: Inputs) -> bool:
    """Whether the images' own table has their openings; an opening given for all of them is fixed."""
    try:
        return all(p.path is not None and opening_beside(Path(p.path)) == p.jaw_opening_m for p in inputs.pictures)
    except SourceError:
        return False
