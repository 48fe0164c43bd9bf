"""``gripmon setup`` and ``gripmon target``: from a camera to a running monitor, on one page or step by step."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from gripmon.cli.common import PAGE_PORT, PORT_OPTIONS, Arguments, Command, announcer, make_directory
from gripmon.model.errors import InputError

_OPTIONS = f"""
[DIR]            folder of the set-up; made if it is missing (default: this one)
--source SOURCE  the camera: 0, /dev/video0, a URL, a folder of images, zenoh:WIDTHxHEIGHT[:KEY] or
                 ros2:WIDTHxHEIGHT:TOPIC; with --step plate, standing or teaching: where its images come from
--step NAME      without a page: carry out this step with what was said in the folder (setup.yaml); camera, target,
                 plate, intrinsics, gripper, standing, corners, reference, teaching, teach, check or run
{PORT_OPTIONS.strip()}
"""

_EXAMPLES = """\
  gripmon setup arm1
  gripmon setup arm1 --source 0
  gripmon setup arm1 --step plate        take images of the target by themselves, without a page

exit codes: 0 done; 2 wrong usage or files; 3 a step gives nothing, and why; 130 Ctrl-C"""


@Command(
    "setup", "from a camera to a running monitor, on one page", _OPTIONS, _EXAMPLES, dir={"default": Path()},
    port=PAGE_PORT,
)  # fmt: skip
def setup(arguments: Arguments) -> None:
    """Lead from a camera to a running monitor on a local web page: camera, printed target, images of it,
    lens, gripper, hand and eye, teaching, forecast, start.  Every step writes its file to the folder, the
    same that the command writes which it names; whoever opens the folder again goes on where it stopped.
    """
    from gripmon.daemon.setup import Project, SetupSite
    from gripmon.teach.page_server import serve

    folder, source = make_directory(arguments.dir, "DIR"), arguments.source
    if source is not None and not source.isdecimal() and not Path(source).is_absolute() and Path(source).exists():
        source = os.path.relpath(os.path.realpath(source), os.path.realpath(folder))  # named from here, kept from there
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
--force       replace the file if there is one
"""

_TARGET_EXAMPLES = """\
  gripmon target --pdf plate.pdf
  gripmon target charuco:8x6:0.03:0.022 --paper letter --pdf board.pdf
  gripmon target chequerboard:20x14:0.025 --paper 600x420 --pdf large.pdf

exit codes: 0 written; 2 wrong usage, or the target doesn't fit on the paper"""


@Command(
    "target", "a calibration target to print", _TARGET_OPTIONS, _TARGET_EXAMPLES,
    target={"default": "circles:12x10:0.008:0.004"}, pdf={"required": True}, paper={"default": "a4"},
)  # fmt: skip
def target(arguments: Arguments) -> None:
    """Write a calibration target as a page to print: PDF in true size, with a bar to hold a ruler against.
    What it has to be called in --target stands on the page.
    """
    from gripmon.calibrate.target_print import print_target
    from gripmon.model.targets import parse_target

    if arguments.pdf.suffix.lower() != ".pdf":
        raise InputError(f"--pdf {arguments.pdf}: is no PDF's name; FILE.pdf")
    made = print_target(parse_target(arguments.target), arguments.paper)
    arguments.check_outputs("pdf")
    arguments.save("pdf", made.pdf)
    print(f"print at 100 %; the bar has to measure {made.bar_mm:g} mm\nwritten: {arguments.pdf}")
