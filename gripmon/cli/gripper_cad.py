"""``gripmon gripper from-cad``: a gripper file from meshes, a URDF or a .cao."""

from __future__ import annotations

import argparse

from gripmon.cli.common import (
    REQUIRED,
    Arguments,
    Command,
    jaw_opening,
    jaw_range,
    positive_number,
    progress_bar,
    two_numbers,
)
from gripmon.model.errors import InputError

_OPTIONS = """
FILE...                 .stl, .obj, .ply, .dae, .cao: one per finger, or both in one; or one .urdf
--out FILE.yaml         gripper file to write
--unit UNIT             unit of meshes: m, cm, mm or in (a .dae has its own)
--body BODIES           for one mesh of several bodies: all (one finger), or their numbers, as 1,2 (two fingers) or
                        1+3,2; for a URDF: the fingers' links, as link1,link2
--approach AXIS[,AXIS]  axis of the CAD frame that points out of the gripper: +x, -x, +y, -y, +z or -z (default: +z, for
                        a URDF the direction of its fingers), and the one from the left finger to the right one; write
                        negative ones as --approach=-x
--frame FRAME           tcp: origin between the fingertips; cad: the CAD's own (default tcp)
--length M              use only this length of the fingers, from the tips (m)
--jaw-range MIN:MAX     range of the jaw opening (m); for a URDF: only this part of its joint's
--jaw-opening M         reported opening of the jaws as drawn (default: the tips' distance, m)
--joint NAME[=POS]      for a URDF: the joint that opens the jaws, if several are possible, or where it stands (m or
                        rad); two of them with a comma
--bevel M               width of the bevels on real edges that are sharp in the CAD (default: 0.0002 m); 0: the edges
                        are known to be sharp to 0.02 mm
--camera FILE.yaml      the view's camera: a file of gripmon calibrate intrinsics, or a configuration
--reference FILE.yaml   the gripper's pose in the view: a file of gripmon calibrate plane, or a configuration
| --view D:TILT         a rough pose: the TCP at distance D (m) in the image's middle, the camera at -y and tilted
                        by TILT (degrees) against z
--name NAME             the gripper's name (default: FILE's; for several FILEs that of --out)
--picture FILE.png      also draw the model in the view
--force                 replace existing files
--json                  one JSON object instead of text; m
"""

_EXAMPLES = """\
  gripmon gripper from-cad left.stl right.stl --unit mm --jaw-range 0:0.06 --out gripper.yaml
  gripmon gripper from-cad gripper.urdf --camera camera.yaml --view 0.12:30 \\
      --out gripper.yaml --picture gripper.png
  gripmon gripper from-cad finger.obj --unit m --approach=-y --camera camera.yaml \\
      --reference hand_eye.yaml --length 0.04 --out gripper.yaml

exit codes: 0 written; 2 wrong usage or files, one line says what would be right"""


def _view(text: str) -> tuple[float, float]:
    values = two_numbers(text)
    if values is None or not (0.0 < values[0] <= 2.0 and 0.0 <= values[1] <= 180.0):
        raise argparse.ArgumentTypeError(
            f"'{text}' isn't D:TILT; metres (2 at most; millimetres?) and degrees, e.g. 0.12:30"
        )
    return values


def _bevel(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' isn't the width of a bevel; metres, e.g. 0.0002") from None


@Command(
    _OPTIONS, _EXAMPLES, out=REQUIRED, length=positive_number,
    jaw_range=jaw_range, jaw_opening=jaw_opening, view=_view, frame={"default": "tcp"},
    bevel=_bevel,
)  # fmt: skip
def from_cad(arguments: Arguments) -> None:
    """Make a gripper file from CAD.  FILE is one mesh (STL, OBJ, PLY, DAE) or ViSP .cao for each finger, one
    with both, or one URDF.  Meshes need --unit; URDF, DAE and .cao have theirs.

    The origin is the TCP, the middle of the four innermost fingertip corners: x across the jaws, from the
    finger called left to the right one, z along --approach.  --frame cad keeps the CAD's axes.

    The jaws' motion comes from the URDF's joint; for meshes, both fingers move straight by half of an opening
    in --jaw-range.  What a URDF or a mesh of several bodies doesn't tell is asked for, with the option.

    Real edges are broken, by 0.1 to 0.3 mm if the drawing leaves it open (ISO 13715); CAD draws them sharp.
    --bevel states the width.  The default makes the bounds of an untaught gripper so wide that hardly any
    transform is valid at an alert limit of 1 mm: gripmon teach measures the real edges.

    Convex fingers with flat faces are valid for every view.  For round, hollow or open ones the edges and
    outlines are those of one view: --camera with --reference, or with a rough --view.  Make such a file
    again when the camera moves by more than some degrees.
    """
    from gripmon.daemon.calibrations import view_in
    from gripmon.model.gripper import UNTOLD_BEVEL_M
    from gripmon.model.provenance import provenance_of
    from gripmon.teach.cad import gripper_from_cad

    arguments.check_outputs("out", "picture")
    camera, cam_T_grip = view_in(arguments.camera, arguments.reference, arguments.view)
    if arguments.picture is not None and (camera is None or cam_T_grip is None):
        raise InputError("--picture: needs a view; add --camera and --reference or --view")
    missing = [path for path in arguments.file if not path.is_file()]
    if missing:
        raise InputError(f"{missing[0]}: there is no such file; a mesh, URDF or .cao")
    name = arguments.name or (arguments.out.stem if len(arguments.file) > 1 else None)
    provenance = provenance_of(arguments.command_line(), arguments.file)
    made = gripper_from_cad(
        arguments.file, unit=arguments.unit, name=name, camera=camera, cam_T_grip=cam_T_grip,
        jaw_range_m=arguments.jaw_range, jaw_opening_m=arguments.jaw_opening, joint=arguments.joint,
        body=arguments.body, frame=arguments.frame, approach=arguments.approach, length_m=arguments.length,
        bevel_m=UNTOLD_BEVEL_M if arguments.bevel is None else arguments.bevel,
        provenance=provenance, progress=progress_bar,
    )  # fmt: skip
    arguments.save_gripper(made, provenance)
