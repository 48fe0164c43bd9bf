"""``gripmon calibrate verify``: do two calibrations differ, or does a calibration still hold?"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from gripmon.cli.common import Arguments, Command, positive_number
from gripmon.model.errors import InputError
from gripmon.model.stopping import EXIT_DONE, EXIT_FAILED

if TYPE_CHECKING:
    from gripmon.calibrate.verify import Calibrated

DEFAULT_LEVEL = 0.01

_OPTIONS = """
A                    calibration
B...                 the other calibration, or images (files, folders)
--config CONFIG      with images: the configuration with gripper and monitor
--target TARGET      with images: the plate that the gripper stands on
--other-target       the plate is another one than the calibration's, of the same pattern in another size
--jaw-opening M      in the images (m); default: the calibration's, else the configuration's
--level P            probability that equal calibrations are reported as different (default: 0.01)
--tolerance-mm MM    negligible shift of the TCP, however significant
--tolerance-deg DEG  negligible rotation, however significant; with --tolerance-mm
--tolerance-px PX    negligible difference of two cameras in the image, however significant
--json               print JSON
"""

_EXAMPLES = """\
  gripmon calibrate verify hand_eye.yaml new/hand_eye.yaml
  gripmon calibrate verify camera.yaml imported.yaml --tolerance-px 0.2
  gripmon calibrate verify hand_eye.yaml today/*.png --config mine/arm1.yaml
  gripmon calibrate verify hand_eye.yaml plate/*.png --config mine/arm1.yaml --target charuco:14x12:0.006:0.0044

exit codes: 0 the same; 2 wrong usage or files; 3 different, or the images can't be measured (then
only the reason is printed)"""


def _share(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < 0.5:
        raise argparse.ArgumentTypeError(f"'{text}' isn't a probability of a false alarm; between 0 and 0.5, e.g. 0.01")
    return value


@Command(
    _OPTIONS, _EXAMPLES,
    level={"type": _share, "default": DEFAULT_LEVEL}, jaw_opening=positive_number, tolerance_mm=positive_number,
    tolerance_deg=positive_number, tolerance_px=positive_number,
)  # fmt: skip
def verify(arguments: Arguments) -> int:
    """Compare two hand/eye calibrations (difference at the TCP, mm and degrees along the camera's axes), two
    cameras (the largest difference of their projections in the image), or a hand/eye calibration with
    fresh images of the gripper: on the calibration plate (--target), or anywhere, measured as by the
    monitor; then three or more before different backgrounds, because one that contradicts the others is
    left out.  Each may also be a configuration, a monitor's state file (its reference in force) or
    estimates.jsonl (its last valid transform).  The significance follows from both covariances; errors
    common to both, such as the camera's, make differences look less significant than they are.
    """
    from gripmon.calibrate.api import verify
    from gripmon.daemon.calibrations import read_calibrated

    tolerance_m, tolerance_rad = arguments.metres("tolerance_mm"), arguments.radians("tolerance_deg")
    if (tolerance_m is None) is not (tolerance_rad is None):
        raise InputError("--tolerance-mm and --tolerance-deg: one without the other; both or none")
    first = read_calibrated(Path(arguments.a))
    second, doubts = _second(first, arguments)
    found = verify(
        first, second, level=arguments.level, tolerance_m=tolerance_m, tolerance_rad=tolerance_rad,
        tolerance_px=arguments.tolerance_px,
    )  # fmt: skip
    found = replace(found, warnings=(*doubts, *found.warnings))
    given = tolerance_m is not None or arguments.tolerance_px is not None
    if arguments.json:
        print(json.dumps(found.values() | {"within_tolerance": found.within if given else None}))
    else:
        print("\n".join(found.summary(given=given)))
    return EXIT_DONE if found.same else EXIT_FAILED


def _second(first: Calibrated, arguments: Arguments) -> tuple[Calibrated, tuple[str, ...]]:
    """The other calibration, or the measurement in images; and warnings about it."""
    from gripmon.daemon.calibrations import measure_again, read_calibrated
    from gripmon.daemon.targets import target_of
    from gripmon.model.images import IMAGE_SUFFIXES

    names: list[str] = arguments.b
    if any(Path(n).is_dir() or Path(n).suffix.lower() in IMAGE_SUFFIXES for n in names):
        target = None if arguments.target is None else target_of(arguments.target)
        return measure_again(
            first, names, arguments.config, target, other_target=arguments.other_target,
            jaw_opening_m=arguments.jaw_opening,
        )  # fmt: skip
    of_images = "config", "target", "other_target", "jaw_opening"
    arguments.refuse(of_images, "applies only to images; leave it out")
    if len(names) > 1:
        raise InputError(f"{names[1]}: a third calibration; two of them, or images")
    return read_calibrated(Path(names[0])), ()
