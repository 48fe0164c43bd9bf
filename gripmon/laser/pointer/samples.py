"""Samples of the laser-pointer method from rows of a table: spots or images, and the poses that they were seen at."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gripmon.calibrate.tables import Row, check_scale, numbers_of, pose_of
from gripmon.model.records import Array


@dataclass(frozen=True, slots=True)
class Samples:
    """``names`` of n samples; ``uv_px`` (n, 2), NaN where an image is to be looked at; ``images`` and ``laser_off``,
    file names or None; ``base_T_ee`` (n, 4, 4); ``groups`` (n,) labels of orientations, or None: the poses tell them.
    """

    names: tuple[str, ...]
    uv_px: Array
    images: tuple[str | None, ...]
    laser_off: tuple[str | None, ...]
    base_T_ee: Array
    groups: tuple[str, ...] | None

    def __len__(self) -> int:
        return len(self.names)


def from_rows(rows: Sequence[Row], places: Sequence[str]) -> Samples:
    """``places`` say where each row stands.  ValueError: "place: what is wrong; what would be right"."""
    if not rows:
        raise ValueError("holds no sample; a row for each spot, better 50 of them")
    uv_px = np.array([_spot(row, place) for row, place in zip(rows, places, strict=True)])
    base_T_ee = np.stack([pose_of(row, place) for row, place in zip(rows, places, strict=True)])
    check_scale(base_T_ee)
    named = [row.get("group") not in (None, "") for row in rows]
    if any(named) and not all(named):
        raise ValueError(f"{places[named.index(False)]}: has no group, others have; a group for every row, or for none")
    images = tuple(_text(row.get("image")) for row in rows)
    _check_different(uv_px, base_T_ee, images, places)
    return Samples(
        names=tuple(image or place for image, place in zip(images, places, strict=True)),
        uv_px=uv_px,
        images=images,
        laser_off=tuple(_text(row.get("laser_off")) for row in rows),
        base_T_ee=base_T_ee,
        groups=tuple(str(row["group"]) for row in rows) if all(named) else None,
    )


def joined(parts: Sequence[Samples], sources: Sequence[str]) -> Samples:
    """Several tables as one; groups of different tables are different, poses of one orientation are not."""
    grouped = [part.groups is not None for part in parts]
    if any(grouped) and not all(grouped):
        raise ValueError(f"{sources[grouped.index(False)]}: has no groups, other files have; all or none of them")
    groups = [f"{k}/{g}" for k, part in enumerate(parts) for g in (part.groups or ())]
    return Samples(
        names=tuple(name for part in parts for name in part.names),
        uv_px=np.concatenate([part.uv_px for part in parts]),
        images=tuple(i for part in parts for i in part.images),
        laser_off=tuple(i for part in parts for i in part.laser_off),
        base_T_ee=np.concatenate([part.base_T_ee for part in parts]),
        groups=tuple(groups) if all(grouped) else None,
    )


def picked(samples: Samples, kept: Sequence[int]) -> Samples:
    """Those samples only."""
    return Samples(
        names=tuple(samples.names[k] for k in kept),
        uv_px=samples.uv_px[list(kept)],
        images=tuple(samples.images[k] for k in kept),
        laser_off=tuple(samples.laser_off[k] for k in kept),
        base_T_ee=samples.base_T_ee[list(kept)],
        groups=None if samples.groups is None else tuple(samples.groups[k] for k in kept),
    )


def _text(value: Any) -> str | None:
    return None if value is None or str(value).strip() == "" else str(value).strip()


def _spot(row: Row, place: str) -> tuple[float, float]:
    spot = [row.get("u_px"), row.get("v_px")]
    if all(value not in (None, "") for value in spot):
        u, v = numbers_of(row, ("u_px", "v_px"), place)
        return u, v
    if _text(row.get("image")) is None:
        raise ValueError(f"{place}: has neither u_px and v_px nor image; the spot in pixels, or the image file's name")
    return math.nan, math.nan


def _check_different(uv_px: Array, base_T_ee: Array, images: Sequence[str | None], places: Sequence[str]) -> None:
    """The same sample twice would make every uncertainty too small."""
    seen: dict[tuple[Any, ...], str] = {}
    for uv, pose, image, place in zip(uv_px, base_T_ee, images, places, strict=True):
        key = (image, *np.round(pose, 9).ravel().tolist(), *([] if np.isnan(uv).any() else uv.tolist()))
        first = seen.setdefault(key, place)
        if first is not place:
            raise ValueError(f"{place}: is the same sample as {first}; each sample once")
