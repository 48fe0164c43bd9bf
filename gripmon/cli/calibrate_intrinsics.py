"""``gripmon calibrate intrinsics``: a camera from images of a flat target."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import calibration_files as files
from gripmon.cli import common

if TYPE_CHECKING:
    from gripmon.calibration.intrinsics import IntrinsicsResult
    from gripmon.calibration.sighting import Sighting
    from gripmon.calibration.targets import Target

MODELS = ("paper", "brown_conrady", "brown_conrady_5", "fisheye")

_DESCRIPTION = """\
Calibrate a camera from images of a flat target, each of which may show a part of it: focal lengths,
principal point and lens with their standard deviations.  Best are ten to thirty images that fill the
view, corners included, the target tilted by 20 to 45 degrees to different sides.  From one image
comes a calibration with the principal point at the image's centre and square pixels, as in the
self-viewing method."""

_EXAMPLES = """\
  gripmon calibrate intrinsics plate/*.png --target chequerboard:9x6:0.025 --out camera.yaml
  gripmon calibrate intrinsics plate/ --target charuco:8x6:0.03:0.022:DICT_4X4_250 --model auto --out camera.yaml
  gripmon calibrate intrinsics one.png --target circles:8x8:0.008:0.004 --model paper --out camera.yaml

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
        "(squares, m) or circles:COLUMNSxROWS:SPACING:DIAMETER (discs, m)",
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
        metavar="NAME",
        help="hold a parameter, e.g. cx_px (at the image's centre), coefficients.2 (at 0) or aspect (square pixels); "
        "may be given several times",
    )
    parser.add_argument("--out", required=True, metavar="FILE.yaml", help="file to write")
    parser.add_argument("--force", action="store_true", help="replace files that are there")


def run(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon calibrate intrinsics``."""
    from gripmon.calibration.sighting import CalibrationError

    out = Path(arguments.out)
    files.check_output(out, force=arguments.force)
    target = files.target_of(arguments.target)
    paths = files.image_paths(arguments.images)
    sightings = _sightings(paths, target)
    try:
        result = _calibrated(sightings, arguments)
    except CalibrationError as error:
        raise common.CommandFailedError(f"calibrate intrinsics: {error}") from None
    files.write_document(_document(result, sightings, target, paths, arguments), out)
    print(f"written: {out}")
    return common.EXIT_DONE


def _sightings(paths: list[Path], target: Target) -> list[Sighting]:
    import sys

    from gripmon.calibration.detection import detect
    from gripmon.calibration.sighting import NotFound

    images = files.read_images(paths)
    found: list[Sighting] = []
    with common.progress_bar(len(paths), "image") as step:
        for path, image in zip(paths, images, strict=True):
            sight = detect(image, target, str(path))
            if isinstance(sight, NotFound):
                print(f"{path}: {sight.reason}", file=sys.stderr)
            else:
                found.append(sight)
            step()
    if not found:
        raise common.CommandFailedError(f"none of {len(paths)} images shows the target {arguments_text(target)}")
    return found


def arguments_text(target: Target) -> str:
    """The target as it is given."""
    from gripmon.calibration.targets import name_of

    return name_of(target)


def _calibrated(sightings: list[Sighting], arguments: argparse.Namespace) -> IntrinsicsResult:
    from gripmon.calibration import intrinsics
    from gripmon.calibration.lens_models import MODELS as ALL

    fixed = frozenset(arguments.fix)
    if len(sightings) == 1:
        return intrinsics.calibrate_single_view(sightings[0], arguments.model or "paper")
    if arguments.model == "auto":
        return intrinsics.calibrate_best(sightings, ALL, fixed=fixed)
    return intrinsics.calibrate(sightings, arguments.model or "brown_conrady", fixed=fixed)


def _document(
    result: IntrinsicsResult,
    sightings: list[Sighting],
    target: Target,
    paths: list[Path],
    arguments: argparse.Namespace,
) -> Any:
    from gripmon.calibration.documents import CameraCalibration, CameraResiduals
    from gripmon.provenance import provenance_of

    options = {"--target": arguments.target, "--model": arguments.model, "--out": arguments.out}
    return CameraCalibration(
        camera=result.camera,
        parameters=result.parameters,
        covariance=tuple(result.covariance.ravel().tolist()),
        residuals=CameraResiduals(
            rms_px=result.rms_px,
            views=len(sightings),
            points=sum(int(u.sum()) for u in result.used),
            outliers=sum(int((~u).sum()) for u in result.used),
        ),
        target=arguments_text(target),
        warnings=result.warnings,
        provenance=provenance_of(files.command_line("intrinsics", arguments.images, options), paths),
    )
