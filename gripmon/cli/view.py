"""``gripmon view``: recordings in rerun's viewer."""

from __future__ import annotations

import argparse
import threading
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from gripmon.cli import common
from gripmon.model.errors import InputError, NoResultError

_DESCRIPTION = """\
Show recordings in rerun's viewer: in a window where there is a display, else as a page for a browser
on this machine, whose address is printed.  The files of one run appear as one recording.  It ends
with Ctrl-C, or when the window is closed, and leaves nothing running."""

_EXAMPLES = """\
  gripmon view recordings/
  gripmon view arm1-wrist-20260101T060000Z-000*.rrd --web
  gripmon view shift.rrd --web --port 9091

A page for another machine: ssh -L, for the page's port and the one of the files, which its address
names.

exit codes: 0 the window was closed; 2 wrong usage or no such recording; 3 no viewer could be started;
130 Ctrl-C"""

_PORT = 9090


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = common.add_command(
        commands, "view", run, "recordings in rerun's viewer, native or in a browser", _DESCRIPTION, _EXAMPLES
    )
    parser.add_argument(
        "recordings", nargs="+", metavar="RECORDING", help=".rrd files, or folders of them with all below"
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--web", action="store_true", help="as a page; the default where there is no display")
    where.add_argument("--native", action="store_true", help="in a window; the default where there is a display")
    parser.add_argument(
        "--port", type=_port, metavar="N", help=f"TCP port of the page (default {_PORT}, or another if that is in use)"
    )


def run(arguments: argparse.Namespace) -> int:
    """Handle ``gripmon view``."""
    from gripmon.model.stopping import signals_exit
    from gripmon.record.read import is_rrd, recording_files
    from gripmon.record.viewer import NativeViewer, ViewerError, free_port, has_display, is_free, serve_files

    files = recording_files([Path(name) for name in arguments.recordings])
    for path in files:
        try:
            wrong = "" if is_rrd(path) else "is no recording; an .rrd file of gripmon's"
        except OSError as error:
            wrong = f"can't be read ({error.strerror})"
        if wrong:
            raise InputError(f"{path}: {wrong}")
    if arguments.port is not None and not is_free(arguments.port):
        raise InputError(f"--port {arguments.port}: is in use on 127.0.0.1; another port, or none for any")
    try:
        with signals_exit(), ExitStack() as opened:
            if arguments.native or (has_display() and not arguments.web):
                viewer = NativeViewer([str(path) for path in files], tied=True)
                opened.callback(viewer.close)
                return common.EXIT_FAILED if viewer.wait() else common.EXIT_DONE
            page = opened.enter_context(serve_files(files, arguments.port or free_port(_PORT)))
            print(f"{page.url}\n(Ctrl-C ends it)", flush=True)
            threading.Event().wait()
    except ViewerError as error:
        raise NoResultError(f"view: {error}") from None
    return common.EXIT_DONE


def _port(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 65535:
        raise argparse.ArgumentTypeError(f"'{text}' is no TCP port; 1 to 65535")
    return int(text)
