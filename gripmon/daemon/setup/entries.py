"""What a person enters on the page of ``gripmon setup``: the choices, and the target that follows, compared with
those of the calibrations in this process's working directory.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import msgspec

from gripmon.daemon.targets import target_of
from gripmon.model.errors import InputError
from gripmon.model.project import FILES
from gripmon.model.targets import OtherSizeError, Target, TargetError, name_of, parse_target, refuse_other_size

Values = Mapping[str, str]
PRINT_IT, HAVE_ONE = "print it", "I have one"
INFERRED, FROM_FILE, FROM_CAD, FROM_IMAGES = "from the plate", "a file", "from CAD", "from images"
LENS, HAND_EYE = FILES["camera"], FILES["reference"]
ON_PLATE, BY_CORNERS, BY_IMAGES = "on the plate", "from corners alone", "with the gripper's images"


def target_in(values: Values) -> Target:
    """The target as printed, scaled by its bar.  Raises :class:`~gripmon.model.errors.InputError`."""
    target = parse_target(values["target"])
    text, nominal = values["bar_measured"].strip(), values.get("bar_mm", "")
    if values["have"] != PRINT_IT or not text:
        return target
    try:
        measured = float(text.replace(",", "."))  # decimal comma
    except ValueError:
        measured = 0.0
    bar_mm = float(nominal or "0") or measured
    if not 0.5 * bar_mm < measured < 2.0 * bar_mm:
        raise InputError(f"the bar measures '{text}' mm; a number near the {bar_mm:g} mm that were printed")
    lengths = {
        name: round(value * measured / bar_mm, 9)
        for name, value in msgspec.structs.asdict(target).items()
        if name.endswith("_m")
    }
    return msgspec.structs.replace(target, **lengths)


def on_plate(values: Values) -> bool:
    """Whether the hand/eye calibration is made from images of the gripper standing on the target."""
    return values["reference_by"] == ON_PLATE


def made_with(path: Path) -> str | None:
    """The target that a calibration was made with; None if there is no such file, or it names none."""
    try:
        return name_of(target_of(str(path)))
    except TargetError:
        return None


def other_size(values: Values) -> OtherSizeError | None:
    """Whether the lens was calibrated with the pattern of the target on which the gripper stands, in another size."""
    try:
        refuse_other_size(target_in(values), made_with(Path(LENS)) if on_plate(values) else None)
    except OtherSizeError as error:
        return error
    return None


def other_target(values: Values) -> str:
    """The statement to confirm if the sizes differ, else empty.  It names both targets, so that it confirms nothing
    about others.
    """
    if other_size(values) is None:
        return ""
    lens, stands = made_with(Path(LENS)), name_of(target_in(values))
    return f"There are two targets: the lens was calibrated with {lens}, the gripper stands on {stands}"


def confirmed(values: Values) -> bool:
    """Whether a person has confirmed that these are two targets."""
    return bool(values["other_target"]) and values["other_target"] == other_target(values)
