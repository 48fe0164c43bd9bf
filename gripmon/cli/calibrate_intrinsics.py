"""``gripmon calibrate intrinsics``: a camera from images of a flat target."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import calibration_files as files
from gripmon.cli import common

if TYPE_CHECKING:
    from gripmon.calibrate.intrinsics import Fixed, IntrinsicsResult
    from gripmon.calibrate.sighting import Sighting
    from gripmon.model.targets import Target

MODELS = ("paper", "brown_conrady", "brown_conrady_5", "fisheye")
_FOLDS = 5

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


@dataclass(frozen=True)
class _Views:
    """Images that show the target, and why the others don't."""

    sightings: list[Sighting]
    not_found: dict[str, str]


def run(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon calibrate intrinsics``."""
    import cv2

    from gripmon.calibrate.maps import draw_maps
    from gripmon.calibrate.sighting import CalibrationError

    cv2.setNumThreads(1)
    out, picture = Path(arguments.out), arguments.picture and Path(arguments.picture)
    files.check_output(out, force=arguments.force)
    if picture:
        files.check_picture(picture, force=arguments.force)
    target = files.target_of(arguments.target)
    fixed = _fixed(arguments)
    paths = files.image_paths(arguments.images)
    views = _looked_at(paths, target)
    try:
        result = _calibrated(views.sightings, arguments.model, fixed)
    except CalibrationError as error:
        raise common.CommandFailedError(f"calibrate intrinsics: {error}") from None
    result = replace(result, warnings=(*result.warnings, *_about_target(views.sightings, target)))
    document = _document(result, views.sightings, target, paths, arguments)
    if picture:
        files.write_picture(draw_maps(result, views.sightings), picture)
    files.write_document(document, out)
    print(json.dumps(_values(result, views, out), indent=2) if arguments.json else _summary(result, views, out, fixed))
    return common.EXIT_DONE


def _fixed(arguments: argparse.Namespace) -> Fixed:
    """What is held, and at which value; what can't be ends the command with exit code 2."""
    from gripmon.calibrate.lens_models import MODELS as ALL
    from gripmon.calibrate.lens_models import parameter_names

    models = [m for m in ALL if arguments.model in (m, "auto") or (arguments.model is None and m != "fisheye")]
    known = list(dict.fromkeys(name for model in models for name in parameter_names(model)))
    fixed: dict[str, float | None] = {}
    for text in arguments.fix:
        name, equals, number = text.partition("=")
        value = _number(number) if equals else None
        fault = None
        if name not in (*known, "aspect"):
            fault = f"is no parameter of the model; {', '.join(known)} or aspect"
        elif name in fixed:
            fault = "is held already; each once"
        elif equals and (name == "aspect" or value is None):
            fault = "takes no value: pixels are square" if name == "aspect" else f"is no number; {name}=VALUE"
        elif name in ("fx_px", "fy_px") and (value is None or value <= 0.0):
            fault = f"at what isn't said; {name}=VALUE (px), above 0"
        if fault is not None:
            raise common.CommandFailedError(f"--fix {text}: {fault}", common.EXIT_USAGE)
        fixed[name] = value
    if "aspect" in fixed and "fy_px" in fixed:
        raise common.CommandFailedError("--fix fy_px: is fx_px with aspect; one of them", common.EXIT_USAGE)
    return fixed


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _looked_at(paths: list[Path], target: Target) -> _Views:
    """The target in all images; ends the command where none shows it, or where they can't be of one camera."""
    from gripmon.calibrate.detection import detect
    from gripmon.calibrate.sighting import NotFound

    views = _Views([], {})
    larger: list[str] = []
    with common.progress_bar(len(paths), "image") as step:
        for path, image in files.images_of(paths):
            try:
                sight = detect(image, target, str(path))
            except ValueError as error:
                raise common.CommandFailedError(f"--target: {error}", common.EXIT_USAGE) from None
            if isinstance(sight, NotFound):
                views.not_found[str(path)] = sight.reason
                larger += [f"{path}: {sight.reason}"] if sight.larger else []
            else:
                views.sightings.append(sight)
            step()
    # Of images that all have the same fault the last line says enough.
    if views.sightings or len(set(views.not_found.values())) > 1:
        for name, reason in views.not_found.items():
            print(f"{name}: {reason}", file=sys.stderr)
    if not views.sightings:
        (reason, times), *_ = Counter(views.not_found.values()).most_common(1)
        why = reason if times == len(paths) else f"{times} of them: {reason}"
        count = "the image doesn't show" if len(paths) == 1 else f"none of {len(paths)} images shows"
        raise common.CommandFailedError(f"calibrate intrinsics: {count} the target ({why})")
    if larger:
        # Where the rest of it is hidden or out of view, the smaller one fits as well: those images prove nothing.
        raise common.CommandFailedError(
            f"--target: {len(larger)} of {len(paths)} images show a larger one ({larger[0]}); its full size",
            common.EXIT_USAGE,
        )
    return views


def _calibrated(sightings: list[Sighting], asked: str | None, fixed: Fixed) -> IntrinsicsResult:
    from gripmon.calibrate import intrinsics
    from gripmon.calibrate.lens_models import MODELS as ALL

    model: Any = "paper" if len(sightings) == 1 and asked in (None, "auto") else asked or "brown_conrady"
    if len(sightings) == 1:
        return intrinsics.calibrate_single_view(sightings[0], model, fixed=fixed)
    steps = (len(ALL) if asked == "auto" else 1) + min(_FOLDS, len(sightings)) * (len(sightings) > 3)
    with common.progress_bar(steps, "fit") as step:
        if asked == "auto":
            result = intrinsics.calibrate_best(sightings, ALL, fixed=fixed, step=step)
        else:
            result = intrinsics.calibrate(sightings, model, fixed=fixed)
            step()
        crossed = intrinsics.cross_validate(sightings, result.model, fixed=fixed, folds=_FOLDS, step=step)
    return replace(result, cross_validated_rms_px=crossed)


def _about_target(sightings: list[Sighting], target: Target) -> list[str]:
    """Whether it may have been described as larger than it is: on a lattice without marks nothing else tells."""
    from gripmon.model.targets import Charuco

    if isinstance(target, Charuco):
        return []
    step_m = getattr(target, "square_m", None) or getattr(target, "spacing_m", 1.0)
    spans = [sorted((s.plate_m.max(axis=0) - s.plate_m.min(axis=0))[:2].tolist(), reverse=True) for s in sightings]
    seen = [round(max(span[k] for span in spans) / step_m) + 1 for k in (0, 1)]
    if seen[0] < max(target.columns, target.rows) and len(sightings) > 1:
        whole = f"{target.columns} x {target.rows}"
        return [
            f"no image shows more than {seen[0]} x {seen[1]} of the target's {whole} points: is it described rightly?"
        ]
    return []


def _document(
    result: IntrinsicsResult,
    sightings: list[Sighting],
    target: Target,
    paths: list[Path],
    arguments: argparse.Namespace,
) -> Any:
    from gripmon.calibrate.documents import CameraCalibration, CameraResiduals
    from gripmon.model.provenance import provenance_of
    from gripmon.model.targets import name_of

    options = {"--target": arguments.target, "--model": arguments.model, "--fix": arguments.fix}
    options |= {"--out": arguments.out, "--picture": arguments.picture, "--force": arguments.force}
    return CameraCalibration(
        camera=result.camera,
        parameters=result.parameters,
        covariance=tuple(result.covariance.ravel().tolist()),
        residuals=CameraResiduals(
            rms_px=result.rms_px,
            views=len(sightings),
            points=sum(int(u.sum()) for u in result.used),
            outliers=sum(int((~u).sum()) for u in result.used),
            cross_validated_rms_px=result.cross_validated_rms_px,
        ),
        target=name_of(target),
        warnings=result.warnings,
        provenance=provenance_of(files.command_line("intrinsics", arguments.images, options), paths),
    )


def _sigmas(result: IntrinsicsResult) -> dict[str, float | None]:
    found = dict(zip(result.parameters, result.covariance.diagonal() ** 0.5, strict=True))
    return {name: float(found[name]) if name in found else None for name in result.values}


def _values(result: IntrinsicsResult, views: _Views, out: Path) -> dict[str, Any]:
    sigmas = _sigmas(result)
    return {
        "out": str(out),
        "model": result.model,
        "parameters": {name: {"value": value, "sigma": sigmas[name]} for name, value in result.values.items()},
        "rms_px": result.rms_px,
        "cross_validated_rms_px": result.cross_validated_rms_px,
        "criterion": result.criterion,
        "views": [
            {"image": s.name, "points": len(s), "left_out": int((~used).sum()), "rms_px": rms, "note": s.note}
            for s, used, rms in zip(views.sightings, result.used, result.view_rms_px, strict=True)
        ],
        "not_found": [{"image": name, "reason": reason} for name, reason in views.not_found.items()],
        "warnings": list(result.warnings),
    }


def _summary(result: IntrinsicsResult, views: _Views, out: Path, fixed: Fixed) -> str:
    sigmas = _sigmas(result)
    lines = [f"{'parameter':<15} {'value':>14} {'±':>11}"]
    for name, value in result.values.items():
        sigma = sigmas[name]
        # A tied one has no deviation of its own: fy_px is fx_px with square pixels.
        said = "held" if sigma is None else f"{sigma:.2g}"
        lines.append(f"{name:<15} {value:>14.6g} {said:>11}")
    lost = sum(int((~u).sum()) for u in result.used)
    total = sum(len(s) for s in views.sightings)
    images = len(views.sightings) + len(views.not_found)
    fit = f"{len(views.sightings)} of {images} images, {total} points, {lost} left out; rms {result.rms_px:.3f} px"
    if result.cross_validated_rms_px is not None:
        fit += f", {result.cross_validated_rms_px:.3f} px in images that had no part in the fit"
    lines.append(fit)
    if len(views.sightings) == 1:
        given = any(fixed.get(name) is not None for name in ("cx_px", "cy_px"))
        centre = "as held" if given else "at the image's centre"
        lines.append(f"from a single image: principal point {centre}, square pixels, one number of the lens")
    if result.criterion is not None and len(result.criterion) > 1:
        least = min(result.criterion.values())
        lines.append("model            information criterion above the best")
        lines += [
            f"{name:<16} {value - least:>8.1f}"
            for name, value in sorted(result.criterion.items(), key=lambda item: item[1])
        ]
    lines += [f"warning: {warning}" for warning in result.warnings]
    lines.append(f"written: {out}")
    return "\n".join(lines)
