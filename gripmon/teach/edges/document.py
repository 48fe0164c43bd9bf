"""A taught model as a file that people can read: YAML with units, floats to the last digit."""

from __future__ import annotations

import re
from typing import Any

import msgspec
import yaml

from gripmon.track.edges.taught import TaughtModel

_HEADER = """\
# Taught model: written by gripmon teach, named by `taught:` in a configuration.  Not to be edited: teach again.
# It belongs to exactly this camera, gripper file, reference and edge settings, and is refused with any others.
#   edges.*.share       the part of the edge that was seen, between its `from` (0) and its `to` (1)
#   edges.*.offset_m    how far the edge shows beside the sharp model's at the two ends of that part, across the line of
#                       sight, positive to the right of somebody who walks along it in the image (m); sigma_m: its
#                       standard deviation
#   edges.*.depth_m     how much deeper it lies, along the line of sight; follows from the shape of a bevel (m)
#   edges.*.crease      true: between two visible faces; false: an outline
#   edges.*.brighter    the brighter side, where it may be relied on
#   edges.*.rms_px      scatter of the edge points about the line (px); seen: part of its profiles that showed it
#   edges.*.left, right grey level of the finger on that side over the median of all edges, its spread along the edge
#   corners.*.uv_px     where taught edges meet in the first image (px), and its standard deviation
# The measurement uses offsets, depths, their deviations, crease and brighter; the rest describes what was seen.
"""


_WORDS = ("true", "false", "null", "yes", "no", "on", "off", "y", "n")


class _Dumper(yaml.SafeDumper):  # type: ignore[misc]  # PyYAML has no types
    """Text in quotes wherever it could be taken for something else."""


def _text(dumper: _Dumper, text: str) -> Any:
    plain = re.fullmatch(r"[A-Za-z_][\w./-]*", text) and text.lower() not in _WORDS
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=None if plain else '"')


_Dumper.add_representer(str, _text)


def to_yaml(model: TaughtModel) -> str:
    """The file's text; reading it gives the same model, to the last bit."""
    values = _without_nothing(msgspec.to_builtins(model))
    return _HEADER + yaml.dump(
        values, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=160, allow_unicode=True
    )


def _without_nothing(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nothing(item) for key, item in value.items() if item is not None}
    return [_without_nothing(item) for item in value] if isinstance(value, list | tuple) else value
