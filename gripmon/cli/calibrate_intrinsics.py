"""``gripmon calibrate intrinsics``: a camera from images of a flat target."""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import calibration_files as files
from gripmon.cli import common
from gripmon.model.errors import InputError

if TYPE_CHECKING:
    from gripmon.calibrate.api import CameraFromViews

MODELS = ("paper", "brown_conrady", "brown_conrady_5", "fisheye")

_DESCRIPTION = """\
Calibrate a camera from images of a flat target, each of which may show a part of it: focal lengths,
principal point and lens with their standard deviations.  Best are ten to thirty images that fill the
view, corners included, the target tilted by 20 to 45 degrees to different sides.  From one image
comes a calibration with the principal point at the image's centre and square pixels, as in the
self-viewing method."""

_EXAMPLES = """\
  gripmon calibrate intrinsics plate/*.png --target chequerboard:9x6:0.025 --out camera.yaml
  gripmon calibrate intrinsics plate/ --target charuco:8x6:0.03:0.022:DICT_4X4_250 --model auto \\
      --out camera.yaml --picture maps.png
  gripmon calibrate intrinsics one.png --target circles:8x8:0.008:0.004 --out camera.yaml

exit codes: 0 written; 2 wrong usage or files; 3 the images can't be calibrated from, and why:
nothing is written then"""


def add_parser(methods: Any) -> None:
    """Add the method."""
    parser = common.add_command(
        methods, "intrinsics", run, "a camera from images of a flat target", _DESCRIPTION, _EXAMPLES
    )
    parser.add_argument("images", nargs="+", metavar="IMAGE", help="image file, or folder with images")
    parser.add_argument(
        "--target",
        required=True,
        metavar="TARGET",
        help="chequerboard:COLUMNSxROWS:SQUARE (inner corners, m), charuco:COLUMNSxROWS:SQUARE:MARKER[:DICTIONARY] "
        "(squares, m), circles:COLUMNSxROWS:SPACING:DIAMETER (discs, m), or FILE.yaml of a calibration with it",
    )
    parser.add_argument(
        "--model",
        choices=(*MODELS, "auto"),
        help="lens model; auto: the one with the smallest information criterion "
        "(default: brown_conrady; of a single image paper)",
    )
    parser.add_argument(
        "--fix",
        action="append",
        default=[],
        metavar="NAME[=VALUE]",
        help="hold a parameter, e.g. cx_px (at the image's centre), coefficients.2 (at 0), aspect (square pixels) or "
        "fx_px=870.5 (there); may be given several times",
    )
    parser.add_argument("--out", required=True, metavar="FILE.yaml", help="file to write")
    parser.add_argument(
        "--picture", metavar="FILE.png", help="also draw the residuals over the image, and how each view fits"
    )
    parser.add_argument("--force", action="store_true", help="replace files that are there")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of text; px, the lens's own units")


def run(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon calibrate intrinsics``."""
    import cv2

    from gripmon.calibrate.api import calibrate_intrinsics, draw_maps
    from gripmon.model.images import image_paths
    from gripmon.model.provenance import provenance_of

    cv2.setNumThreads(1)
    out, picture = Path(arguments.out), arguments.picture and Path(arguments.picture)
    files.check_output(out, force=arguments.force)
    if picture:
        files.check_picture(picture, force=arguments.force)
    target = files.target_of(arguments.target)
    fixed = _fixed(arguments)
    paths = image_paths(arguments.images)
    with files.errors_of("intrinsics"):
        found = calibrate_intrinsics(paths, target, model=arguments.model, fixed=fixed, progress=common.progress_bar)
    for name, reason in found.not_found.items():
        print(f"{name}: {reason}", file=sys.stderr)
    options = files.options_of(arguments, "target", "model", "fix", "out", "picture", "force")
    document = found.document(provenance_of(files.command_line("intrinsics", arguments.images, options), paths))
    if picture:
        files.write_picture(draw_maps(found.fit, found.sightings), picture)
    files.write_document(document, out)
    print(json.dumps(_values(found, out), indent=2) if arguments.json else _summary(found, out, fixed))
    return common.EXIT_DONE


def _fixed(arguments: argparse.Namespace) -> dict[str, float | None]:
    """What is held, and at which value."""
    from gripmon.calibrate.api import check_fixed

    fixed: dict[str, float | None] = {}
    for text in arguments.fix:
        name, equals, number = text.partition("=")
        if name in fixed:
            raise InputError(f"--fix {text}: is held already; each once")
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


def _values(found: CameraFromViews, out: Path) -> dict[str, Any]:
    fit, sigmas = found.fit, found.sigmas
    return {
        "out": str(out),
        "model": fit.model,
        "parameters": {name: {"value": value, "sigma": sigmas[name]} for name, value in fit.values.items()},
        "rms_px": fit.rms_px,
        "cross_validated_rms_px": fit.cross_validated_rms_px,
        "criterion": fit.criterion,
        "views": [
            {"image": s.name, "points": len(s), "left_out": int((~used).sum()), "rms_px": rms, "note": s.note}
            for s, used, rms in zip(found.sightings, fit.used, fit.view_rms_px, strict=True)
        ],
        "not_found": [{"image": name, "reason": reason} for name, reason in found.not_found.items()],
        "warnings": list(fit.warnings),
    }


def _summary(found: CameraFromViews, out: Path, fixed: dict[str, float | None]) -> str:
    fit, views = found.fit, len(found.sightings)
    lines = [f"{'parameter':<15} {'value':>14} {'±':>11}"]
    for name, value in fit.values.items():
        sigma = found.sigmas[name]
        # A tied one has no deviation of its own: fy_px is fx_px with square pixels.
        lines.append(f"{name:<15} {value:>14.6g} {'held' if sigma is None else f'{sigma:.2g}':>11}")
    images = f"{views} of {views + len(found.not_found)} images"
    line = f"{images}, {found.points} points, {found.outliers} left out; rms {fit.rms_px:.3f} px"
    if fit.cross_validated_rms_px is not None:
        line += f", {fit.cross_validated_rms_px:.3f} px in images that had no part in the fit"
    lines.append(line)
    if views == 1:
        given = any(fixed.get(name) is not None for name in ("cx_px", "cy_px"))
        centre = "as held" if given else "at the image's centre"
        lines.append(f"from a single image: principal point {centre}, square pixels, one number of the lens")
    if fit.criterion is not None and len(fit.criterion) > 1:
        least = min(fit.criterion.values())
        lines.append("model            information criterion above the best")
        ranked = sorted(fit.criterion.items(), key=lambda item: item[1])
        lines += [f"{name:<16} {value - least:>8.1f}" for name, value in ranked]
    lines += [f"warning: {warning}" for warning in fit.warnings]
    return "\n".join([*lines, f"written: {out}"])
