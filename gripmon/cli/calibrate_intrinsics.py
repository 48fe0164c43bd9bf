"""``gripmon calibrate intrinsics``: a camera from images of a flat target."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING

from gripmon.cli.common import REQUIRED, Arguments, Command, note, progress_bar
from gripmon.model.errors import InputError

if TYPE_CHECKING:
    from gripmon.calibrate.api import CameraFromViews

MODELS = ("paper", "brown_conrady", "brown_conrady_5", "fisheye")

_OPTIONS = """
IMAGE...               image file, or folder with images
--target TARGET        chequerboard:COLUMNSxROWS:SQUARE (inner corners, m),
                       charuco:COLUMNSxROWS:SQUARE:MARKER[:DICTIONARY] (squares, m),
                       circles:COLUMNSxROWS:SPACING:DIAMETER (discs, m), acircles:… (staggered; SPACING in a row),
                       or FILE.yaml of a calibration with it
--model                lens model; auto: the one with the smallest information criterion
                       (default: brown_conrady; for a single image paper)
--fix NAME[=VALUE]...  hold a parameter, e.g. cx_px (at the image's centre), coefficients.2 (at 0), aspect (square
                       pixels) or fx_px=870.5 (at this value); may be repeated
--out FILE.yaml        file to write
--picture FILE.png     also draw the residuals over the image, and how each view fits
--force                replace existing files
--json                 one JSON object instead of text; px, the lens's own units
"""

_EXAMPLES = """\
  gripmon calibrate intrinsics plate/*.png --target chequerboard:9x6:0.025 --out camera.yaml
  gripmon calibrate intrinsics plate/ --target charuco:8x6:0.03:0.022:DICT_4X4_250 --model auto \\
      --out camera.yaml --picture maps.png
  gripmon calibrate intrinsics one.png --target circles:8x8:0.008:0.004 --out camera.yaml

exit codes: 0 written; 2 wrong usage or files; 3 no calibration from these images, with the reason:
nothing is written then"""


@Command(
    _OPTIONS, _EXAMPLES, target=REQUIRED,
    model={"choices": (*MODELS, "auto")}, fix={"default": []}, out=REQUIRED,
)  # fmt: skip
def intrinsics(arguments: Arguments) -> None:
    """Calibrate a camera from images of a flat target, each of which may show a part of it: focal lengths,
    principal point and lens with their standard deviations.  Best are ten to thirty images that fill the
    view, corners included, the target tilted by 20 to 45 degrees to different sides.  A single image
    gives a calibration with the principal point at the image's centre and square pixels, as in the
    self-viewing method.
    """
    import cv2

    from gripmon.calibrate.api import calibrate_intrinsics, draw_maps
    from gripmon.daemon.targets import target_of
    from gripmon.model.images import image_paths
    from gripmon.model.provenance import provenance_of

    cv2.setNumThreads(1)
    arguments.check_outputs("out", "picture")
    target, fixed, paths = target_of(arguments.target), _fixed(arguments), image_paths(arguments.image)
    found = calibrate_intrinsics(paths, target, model=arguments.model, fixed=fixed, progress=progress_bar)
    note(f"{name}: {reason}" for name, reason in found.not_found.items())
    document = found.document(provenance_of(arguments.command_line(), paths))
    arguments.save("picture", lambda: draw_maps(found.fit, found.sightings))
    arguments.save("out", document)
    if arguments.json:
        print(json.dumps({"out": str(arguments.out), **found.values()}, indent=2))
    else:
        print("\n".join([*_summary(found, fixed), f"written: {arguments.out}"]))


def _fixed(arguments: Arguments) -> dict[str, float | None]:
    """The held parameters and their values."""
    from gripmon.calibrate.api import check_fixed

    fixed: dict[str, float | None] = {}
    for text in arguments.fix:
        name, equals, number = text.partition("=")
        if name in fixed:
            raise InputError(f"--fix {text}: is held already; each parameter once")
        try:
            fixed[name] = float(number) if equals else None
        except ValueError:
            fixed[name] = math.nan
        try:
            check_fixed({name: fixed[name]}, arguments.model)
            check_fixed(fixed, arguments.model)
        except InputError as error:
            raise InputError(f"--fix {text}:{str(error).partition(':')[2]}") from None
    return fixed


def _summary(found: CameraFromViews, fixed: dict[str, float | None]) -> list[str]:
    fit, views = found.fit, len(found.sightings)
    lines = [f"{'parameter':<15} {'value':>14} {'±':>11}"]
    for name, value in fit.values.items():
        sigma = found.sigmas[name]
        # A tied parameter has no deviation of its own: fy_px is fx_px with square pixels.
        lines.append(f"{name:<15} {value:>14.6g} {'held' if sigma is None else f'{sigma:.2g}':>11}")
    images = f"{views} of {views + len(found.not_found)} images"
    line = f"{images}, {found.points} points, {found.outliers} left out; rms {fit.rms_px:.3f} px"
    if fit.cross_validated_rms_px is not None:
        line += f", {fit.cross_validated_rms_px:.3f} px in images that had no part in the fit"
    lines.append(line)
    if views == 1:
        given = any(fixed.get(name) is not None for name in ("cx_px", "cy_px"))
        centre = "as held" if given else "at the image's centre"
        lines.append(f"from a single image: principal point {centre}, square pixels, one lens coefficient")
    if fit.criterion is not None and len(fit.criterion) > 1:
        least = min(fit.criterion.values())
        lines.append("model            information criterion above the best")
        ranked = sorted(fit.criterion.items(), key=lambda item: item[1])
        lines += [f"{name:<16} {value - least:>8.1f}" for name, value in ranked]
    return [*lines, *(f"warning: {warning}" for warning in fit.warnings)]
