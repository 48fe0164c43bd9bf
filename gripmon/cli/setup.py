"""``gripmon setup`` and ``gripmon target``: from a camera to a running monitor, on one page or step by step."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from gripmon.cli.common import PAGE_PORT, PORT_OPTIONS, Arguments, Command, announcer, make_directory
from gripmon.model.errors import InputError

_OPTIONS = f"""
[DIR]            folder of the set-up; created if missing (default: this one)
--source SOURCE  the camera: 0, /dev/video0, a URL, a folder of images, zenoh:WIDTHxHEIGHT[:KEY] or
                 ros2:WIDTHxHEIGHT:TOPIC; with --step plate, standing or teaching: the source of its images
--step NAME      without a page: carry out this step with the entries in the folder's setup.yaml; camera, target,
                 plate, intrinsics, gripper, standing, corners, reference, teaching, teach, check or run
{PORT_OPTIONS.strip()}
"""

_EXAMPLES = """\
  gripmon setup arm1
  gripmon setup arm1 --source 0
  gripmon setup arm1 --step plate        take images of the target automatically, without a page

exit codes: 0 done; 2 wrong usage or files; 3 a step has no result, with the reason; 130 Ctrl-C"""


@Command(
    _OPTIONS, _EXAMPLES, dir={"default": Path()},
    port=PAGE_PORT,
)  # fmt: skip
def setup(arguments: Arguments) -> None:
    """Lead from a camera to a running monitor on a local web page: camera, printed target, images of it,
    lens, gripper, hand/eye calibration, teaching, forecast, start.  Every step shows a command and writes
    the same file as that command to the folder; call again with the same folder to continue.
    """
    from gripmon.daemon.setup import Project, SetupSite
    from gripmon.teach.page_server import serve

    folder, source = make_directory(arguments.dir, "DIR"), arguments.source
    if source is not None and not source.isdecimal() and not Path(source).is_absolute() and Path(source).exists():
        source = os.path.relpath(os.path.realpath(source), os.path.realpath(folder))  # stored relative to the folder
    with contextlib.chdir(folder):
        project = Project(Path())
        project.keep({} if source is None else {project.source_field(arguments.step): source})
        if arguments.step is not None:
            print("\n".join(f"{line.level:<5} {line.text}".strip() for line in project.do_here(arguments.step, print)))
            return
        with contextlib.closing(SetupSite(project)) as site:
            serve(site, arguments.port, announcer("set up"), open_browser=not arguments.no_browser)


_TARGET_OPTIONS = """
[TARGET]      as for gripmon calibrate intrinsics --target (default: circles:12x10:0.008:0.004)
--pdf FILE    file to write
--paper SIZE  a5 to a0, letter, legal, tabloid, or WIDTHxHEIGHT in mm (default: a4)
--force       replace an existing file
"""

_TARGET_EXAMPLES = """\
  gripmon target --pdf plate.pdf
  gripmon target charuco:8x6:0.03:0.022 --paper letter --pdf board.pdf
  gripmon target chequerboard:20x14:0.025 --paper 600x420 --pdf large.pdf

exit codes: 0 written; 2 wrong usage, or the target doesn't fit on the paper"""


@Command(
    _TARGET_OPTIONS, _TARGET_EXAMPLES,
    target={"default": "circles:12x10:0.008:0.004"}, pdf={"required": True}, paper={"default": "a4"},
)  # fmt: skip
def target(arguments: Arguments) -> None:
    """Write a calibration target as a page to print: PDF in true size, with a bar to check it with a ruler.
    The page also shows its name for --target.
    """
    from gripmon.calibrate.target_print import print_target
    from gripmon.model.targets import parse_target

    if arguments.pdf.suffix.lower() != ".pdf":
        raise InputError(f"--pdf {arguments.pdf}: isn't the name of a PDF; FILE.pdf")
    made = print_target(parse_target(arguments.target), arguments.paper)
    arguments.check_outputs("pdf")
    arguments.save("pdf", made.pdf)
    print(f"print at 100 %; the bar has to measure {made.bar_mm:g} mm\nwritten: {arguments.pdf}")
