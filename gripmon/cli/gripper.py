"""``gripmon gripper``: gripper files from what people have."""

from __future__ import annotations

import argparse
from typing import Any

from gripmon.cli import gripper_cad, gripper_images

_WAYS = (gripper_cad.from_cad, gripper_images.from_images)

_DESCRIPTION = """\
Make a gripper file from what there is of a gripper.  Each way writes it whole or not at all, and
replaces none without --force."""


def add_to(commands: Any) -> None:
    """Add the group below a parser."""
    group = commands.add_parser(
        "gripper",
        help="make a gripper file",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    ways = group.add_subparsers(title="ways", metavar="WAY", required=True)
    for way in _WAYS:
        way.add_to(ways)
