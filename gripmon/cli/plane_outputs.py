"""What ``gripmon calibrate plane`` writes and says."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gripmon.calibrate.documents import CalibratedGripper, HandEyeCalibration, HandEyeResiduals
from gripmon.calibrate.plane import Coincidence
from gripmon.calibrate.plane_average import PlaneCalibration
from gripmon.calibrate.sighting import CalibrationError
from gripmon.cli import calibration_files as files
from gripmon.cli.plane_inputs import Inputs
from gripmon.model.geometry import to_record
from gripmon.model.gripper import Gripper, GripperError, GripperModel
from gripmon.model.provenance import Provenance, provenance_of
from gripmon.model.targets import name_of
from gripmon.teach.onboarding import KnownGripper, Look, UnknownGripper
from gripmon.track.edges.taught import gripper_digest


def inferred_gripper(
    inputs: Inputs, looks: Sequence[Look], result: PlaneCalibration, arguments: argparse.Namespace
) -> Gripper | None:
    """The gripper that the images show; None if it is known.  Raises :class:`CalibrationError`."""
    if not isinstance(inputs.method, UnknownGripper):
        return None
    model = inputs.method.model(
        arguments.name, looks, result, arguments.jaw_range, arguments.jaw_opening, _provenance(inputs, arguments)
    )
    try:
        return Gripper(model)
    except GripperError as error:
        raise CalibrationError(f"what the corners show is no gripper: {error}") from None


def write(inputs: Inputs, result: PlaneCalibration, inferred: Gripper | None, arguments: argparse.Namespace) -> None:
    """The files, each whole or not at all."""
    method = inputs.method
    if inferred is not None:
        files.write_document(_without_defaults(inferred.model), Path(arguments.gripper_out), "--gripper-out")
    gripper = method.gripper if isinstance(method, KnownGripper) else inferred
    assert gripper is not None, "an inferred gripper has been made"
    opening_m = method.jaw_opening_m if isinstance(method, KnownGripper) else None
    if opening_m is None and gripper.has_jaw:
        opening_m = gripper.jaw_nominal_m
    document = HandEyeCalibration(
        camera=inputs.camera.lens,
        gripper=CalibratedGripper(name=gripper.name, sha256=gripper_digest(gripper)),
        jaw_opening_m=opening_m,
        cam_T_grip=to_record(result.cam_T_grip),
        covariance=tuple(result.covariance.ravel().tolist()),
        residuals=HandEyeResiduals(
            rms_m=result.rms_m,
            rms_px=result.rms_px,
            corners=sum(len(image.corners.names) for image in result.images),
            images=len(result.images),
        ),
        warnings=result.warnings,
        provenance=_provenance(inputs, arguments),
    )
    files.write_document(document, Path(arguments.out))


def report(inputs: Inputs, looks: Sequence[Look], result: PlaneCalibration, arguments: argparse.Namespace) -> None:
    """What a person should know; warnings go to stderr."""
    for warning in result.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    if arguments.json:
        print(json.dumps(_values(inputs, looks, result, arguments), indent=2))
        return
    width = max(len(image.sighting.name) for image in result.images)
    compared = any(look.coincidence.tilt_rad is not None for look in looks)
    apart = "  tilt about x, y          gap" if compared else ""
    print(f"{'image':<{width}}  plate points     rms  corners  residual{apart}")
    for look in looks:
        print(_image_line(look.coincidence, width))
    for note in inputs.notes:
        print(f"note: {note}")
    for look in looks:
        for name, reason in look.missing.items():
            print(f"note: {look.coincidence.sighting.name}: {name} not measured: {reason}")
    if result.consistency_p is not None:
        print(f"the images agree with each other: probability {result.consistency_p:.2g} of differing as much")
    sigma = np.sqrt(result.covariance.diagonal())
    x, y, z = (1e3 * result.cam_T_grip[:3, 3]).tolist()
    sx, sy, sz = (1e3 * sigma[:3]).tolist()
    print(f"TCP in the camera frame  {x:.3f} {y:.3f} {z:.3f} mm  +- {sx:.4f} {sy:.4f} {sz:.4f} mm")
    rx, ry, rz = np.degrees(sigma[3:]).tolist()
    print(f"rotation about x, y, z   +- {rx:.4f} {ry:.4f} {rz:.4f} degrees")
    if inputs.inferred:
        print(_lengths_line(result))
        print(f"written: {arguments.gripper_out}")
    print(f"written: {arguments.out}")


def _values(
    inputs: Inputs, looks: Sequence[Look], result: PlaneCalibration, arguments: argparse.Namespace
) -> dict[str, Any]:
    transform = to_record(result.cam_T_grip)
    out: dict[str, Any] = {
        "cam_T_grip": {"translation_m": transform.translation_m, "rotation_xyzw": transform.rotation_xyzw},
        "covariance": result.covariance.ravel().tolist(),
        "rms_m": result.rms_m,
        "rms_px": result.rms_px,
        "consistency_p": result.consistency_p,
        "warnings": result.warnings,
        "notes": inputs.notes,
        "images": [_image_values(look) for look in looks],
        "written": [arguments.gripper_out, arguments.out] if inputs.inferred else [arguments.out],
    }
    if inputs.inferred:
        sigma = np.sqrt(result.lengths_covariance.diagonal()[:2])
        out["sides_m"] = (2.0 * result.corners_m[3, :2]).tolist()
        out["sides_sigma_m"] = sigma.tolist()
    return out


def _image_values(look: Look) -> dict[str, Any]:
    image = look.coincidence
    sigma_px = np.sqrt(image.corners.covariance_px.diagonal()).reshape(-1, 2)
    rows = zip(image.corners.names, image.corners.uv_px, sigma_px, image.residuals_m, strict=True)
    return {
        "image": image.sighting.name,
        "plate_points": int(image.plate.used[0].sum()),
        "plate_points_left_out": int((~image.plate.used[0]).sum()),
        "plate_rms_px": image.plate.rms_px,
        "corners": {
            name: {"uv_px": uv.tolist(), "sigma_px": sigma.tolist(), "residual_m": residual.tolist()}
            for name, uv, sigma, residual in rows
        },
        "missing": look.missing,
        "residuals_p": image.p_value,
        "tilt_rad": None if image.tilt_rad is None else image.tilt_rad.tolist(),
        "gap_m": image.gap_m,
        "tilt_gap_sigma": None if image.apart_sigma is None else image.apart_sigma.tolist(),
        "tilt_gap_p": image.apart_p,
    }


def _image_line(image: Coincidence, width: int) -> str:
    used, left_out = int(image.plate.used[0].sum()), int((~image.plate.used[0]).sum())
    points = f"{used}" + (f" (-{left_out})" if left_out else "")
    residual_mm = 1e3 * float(np.sqrt(np.mean(np.square(image.residuals_m))))
    apart = ""
    if image.tilt_rad is not None and image.gap_m is not None:
        tilt = np.degrees(image.tilt_rad)
        apart = f"  {tilt[0]:+.3f} {tilt[1]:+.3f} degrees   {1e3 * image.gap_m:+.4f} mm"
    rms_px, corners = image.plate.rms_px, len(image.corners.names)
    return f"{image.sighting.name:<{width}}  {points:>12} {rms_px:4.2f} px  {corners:7d} {residual_mm:6.4f} mm{apart}"


def _lengths_line(result: PlaneCalibration) -> str:
    sides = 2e3 * result.corners_m[3, :2]
    sigma = 1e3 * np.sqrt(result.lengths_covariance.diagonal()[:2])
    apart, along = (f"{side:.3f} +- {error:.4f} mm" for side, error in zip(sides, sigma, strict=True))
    return f"fingertips {apart} apart, innermost edges {along} long"


def _provenance(inputs: Inputs, arguments: argparse.Namespace) -> Provenance:
    # As itself where a file named it: the hand/eye calibration holds its target nowhere else.
    target = name_of(inputs.target) if files.is_target_file(arguments.target) else arguments.target
    options: dict[str, Any] = {"--target": target, "--camera": arguments.camera, "--config": arguments.config}
    options |= {"--gripper": arguments.gripper, "--infer": arguments.infer, "--jaw-opening": arguments.jaw_opening}
    if arguments.jaw_range is not None:
        options["--jaw-range"] = ":".join(f"{end:g}" for end in arguments.jaw_range)
    if arguments.infer:
        options |= {"--name": arguments.name, "--gripper-out": arguments.gripper_out}
    options["--out"] = arguments.out
    words = [*arguments.images, *(word for name in arguments.corners or [] for word in ("--corners", name))]
    return provenance_of(files.command_line("plane", words, options), inputs.files)


def _without_defaults(model: GripperModel) -> Any:
    """Without keys that only say what goes without saying."""
    import msgspec

    out = msgspec.to_builtins(model)
    out["fingers"] = {
        name: {k: v for k, v in finger.items() if v is not None} for name, finger in out["fingers"].items()
    }
    out["edges"] = {name: {"from": edge["from"], "to": edge["to"]} for name, edge in out["edges"].items()}
    return {key: value for key, value in out.items() if value not in (None, [], ())}
