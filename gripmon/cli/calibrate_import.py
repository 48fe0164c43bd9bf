"""``gripmon calibrate import``: a camera from another program's file."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import Any

from gripmon.cli import calibration_files as files
from gripmon.cli import common

CAMERA_FORMATS = ("ros", "kalibr", "opencv", "mrcal")

_DESCRIPTION = """\
Take over a camera that another program has calibrated: ROS camera_info, Kalibr camchain, OpenCV
FileStorage (YAML, XML, JSON) or mrcal .cameramodel.  The format is recognised by its content."""

_EXAMPLES = """\
  gripmon calibrate import camera_info.yaml --out camera.yaml
  gripmon calibrate import camchain.yaml --camera cam1 --out camera.yaml
  gripmon calibrate import intrinsics.xml --size 1280x960 --out camera.yaml

exit codes: 0 written; 2 wrong usage or files: nothing is written then"""


def add_parser(methods: Any) -> None:
    """Add the method."""
    parser = common.add_command(
        methods, "import", run, "a camera from a file of ROS, Kalibr, OpenCV or mrcal", _DESCRIPTION, _EXAMPLES
    )
    parser.add_argument("file", metavar="FILE", help="file of the other program")
    parser.add_argument("--format", choices=CAMERA_FORMATS, help="its format (default: recognised by its content)")
    parser.add_argument("--camera", metavar="CAM", help="which camera of a camchain, e.g. cam1 (default: the only one)")
    parser.add_argument(
        "--size", type=_size, metavar="WIDTHxHEIGHT", help="image size (px), of an OpenCV file that doesn't say it"
    )
    parser.add_argument(
        "--fisheye",
        action="store_true",
        default=None,
        help="the four coefficients of an OpenCV file are cv2.fisheye's; without fisheye_model it doesn't say so",
    )
    parser.add_argument("--out", required=True, metavar="FILE.yaml", help="file to write")
    parser.add_argument("--force", action="store_true", help="replace the file if there is one")


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([0-9]{1,5})x([0-9]{1,5})", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"'{text}' is no image size; e.g. 1280x960")
    return int(match[1]), int(match[2])


def run(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon calibrate import``."""
    from gripmon.calibrate.documents import CameraCalibration
    from gripmon.calibrate.interchange import format_of, read_camera
    from gripmon.daemon.calibrations import read_bytes
    from gripmon.model.provenance import provenance_of

    out, path = Path(arguments.out), Path(arguments.file)
    files.check_output(out, force=arguments.force)
    data = read_bytes(path)
    kind = arguments.format or format_of(data, str(path))
    camera = read_camera(data, str(path), kind, arguments.camera, arguments.size, arguments.fisheye)
    said = {
        "--format": arguments.format,
        "--camera": arguments.camera,
        "--size": arguments.size and "{}x{}".format(*arguments.size),
        "--fisheye": arguments.fisheye,
        "--out": arguments.out,
    }
    document = CameraCalibration(
        camera=camera,
        parameters=(),
        covariance=(),
        warnings=(f"imported from {kind}: how certain it is isn't known",),
        provenance=provenance_of(files.command_line("import", [arguments.file], said), [path]),
    )
    files.write_document(document, out)
    lens = camera.__struct_config__.tag
    print(f"{kind}: {lens}, {camera.width_px} x {camera.height_px} px, focal length {camera.fx_px:.6g} px")
    print(f"written: {out}")
    return common.EXIT_DONE
