"""Laser spots with the arm's poses at which they were seen: tables of them, and finding spots in their images."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gripmon.calibrate.foreign import FileValues
from gripmon.calibrate.sighting import NotFound
from gripmon.calibrate.tables import POSITION, QUATERNION, check_scale, pose_of, rows_of
from gripmon.laser.planning import Plan
from gripmon.laser.spots import Spot, find_spots, plain_spot
from gripmon.model.errors import InputError, input_errors
from gripmon.model.geometry import quaternion_xyzw
from gripmon.model.images import check_size, image_in
from gripmon.model.progress import Progress, quiet
from gripmon.model.records import Array


@dataclass(frozen=True, slots=True)
class Samples:
    """n samples: their ``names`` and the ``places`` where they are listed; ``uv_px`` (n, 2), NaN where the spot must be
    found in an image; ``images`` and ``laser_off``, files or None; ``base_T_ee`` (n, 4, 4); ``groups`` (n,) labels of
    orientations, or None to derive them from the poses.
    """

    names: tuple[str, ...]
    places: tuple[str, ...]
    uv_px: Array
    images: tuple[Path | None, ...]
    laser_off: tuple[Path | None, ...]
    base_T_ee: Array
    groups: tuple[str, ...] | None

    def __len__(self) -> int:
        return len(self.names)

    @classmethod
    def of_spots(cls, uv_px: Array, base_T_ee: Array, groups: Sequence[str] | None = None) -> Samples:
        """From known spots (n, 2) at poses (n, 4, 4)."""
        none = (None,) * len(uv_px)
        names = tuple(f"sample {k + 1}" for k in range(len(uv_px)))
        labels = None if groups is None else tuple(groups)
        return cls(names, names, np.asarray(uv_px, dtype=float), none, none, base_T_ee, labels)

    @property
    def files(self) -> list[Path]:
        """All images in which spots must be found."""
        unseen = np.flatnonzero(np.isnan(self.uv_px).any(axis=1))
        files = [path for k in unseen for path in (self.images[k], self.laser_off[k])]
        return list(dict.fromkeys(path for path in files if path is not None))

    def picked(self, kept: Sequence[int]) -> Samples:
        """A subset of the samples."""
        return Samples(
            names=tuple(self.names[k] for k in kept),
            places=tuple(self.places[k] for k in kept),
            uv_px=self.uv_px[list(kept)],
            images=tuple(self.images[k] for k in kept),
            laser_off=tuple(self.laser_off[k] for k in kept),
            base_T_ee=self.base_T_ee[list(kept)],
            groups=None if self.groups is None else tuple(self.groups[k] for k in kept),
        )


def read_samples(paths: Sequence[Path]) -> Samples:
    """All samples of all tables; with several tables each sample's name includes its table.

    :class:`~gripmon.model.errors.InputError` for a faulty table, or tables that don't go together.
    """
    parts = []
    for path in paths:
        rows = rows_of(path)
        with input_errors(str(path)):
            parts.append(_from_rows(rows, path))
    if len(parts) == 1:
        return parts[0]
    grouped = [part.groups is not None for part in parts]
    if any(grouped) and not all(grouped):
        raise InputError(f"{paths[grouped.index(False)]}: has no groups, other files have; all or none of them")
    groups = tuple(f"{k}/{g}" for k, part in enumerate(parts) for g in (part.groups or ()))
    samples = Samples(
        names=tuple(name for part in parts for name in part.names),
        places=tuple(place for part in parts for place in part.places),
        uv_px=np.concatenate([part.uv_px for part in parts]),
        images=tuple(image for part in parts for image in part.images),
        laser_off=tuple(image for part in parts for image in part.laser_off),
        base_T_ee=np.concatenate([part.base_T_ee for part in parts]),
        groups=groups if all(grouped) else None,
    )
    tables = [path for path, part in zip(paths, parts, strict=True) for _ in part.names]
    try:
        _check_different(samples, samples.places)
    except ValueError as error:
        raise InputError(str(error)) from None
    return replace(samples, names=tuple(f"{t.name}, {n}" for t, n in zip(tables, samples.names, strict=True)))


def _from_rows(rows: Sequence[FileValues], table: Path) -> Samples:
    """Samples of a table's rows.  ValueError: "place: what is wrong; what would be right"."""
    if not rows:
        raise ValueError("holds no sample; a row for each spot, better 50 of them")
    places = [row.path.rstrip(": ") for row in rows]
    named = [row.content.get("group") not in (None, "") for row in rows]
    images, off = ([_text(row.content.get(key)) for row in rows] for key in ("image", "laser_off"))
    folder = table.parent
    samples = Samples(
        names=tuple(image or place for image, place in zip(images, places, strict=True)),
        places=tuple(f"{table}: {image or place}" for image, place in zip(images, places, strict=True)),
        uv_px=np.array([_spot(row) for row in rows]),
        images=tuple(None if image is None else folder / image for image in images),
        laser_off=tuple(None if image is None else folder / image for image in off),
        base_T_ee=np.stack([pose_of(row) for row in rows]),
        groups=tuple(str(row.content["group"]) for row in rows) if all(named) else None,
    )
    check_scale(samples.base_T_ee)
    if any(named) and not all(named):
        raise ValueError(f"{places[named.index(False)]}: has no group, others have; a group for every row, or for none")
    _check_different(samples, places)
    return samples


def _text(value: Any) -> str | None:
    return None if value is None or str(value).strip() == "" else str(value).strip()


def _spot(row: FileValues) -> tuple[float, float]:
    if all(row.content.get(key) not in (None, "") for key in ("u_px", "v_px")):
        return row.number("u_px"), row.number("v_px")
    if _text(row.content.get("image")) is None:
        raise row.fault("", "has neither u_px and v_px nor image", "the spot in pixels, or the image file's name")
    return math.nan, math.nan


def _check_different(samples: Samples, places: Sequence[str]) -> None:
    """Reject duplicate samples, which would make every uncertainty too small."""
    seen: dict[tuple[Any, ...], str] = {}
    for uv, pose, image, place in zip(samples.uv_px, samples.base_T_ee, samples.images, places, strict=True):
        key = (image, *np.round(pose, 9).ravel().tolist(), *([] if np.isnan(uv).any() else uv.tolist()))
        first = seen.setdefault(key, place)
        if first is not place:
            raise ValueError(f"{place}: is the same sample as {first}; each sample once")


def spots_of(samples: Samples, size_px: tuple[int, int], progress: Progress = quiet) -> list[list[Spot] | NotFound]:
    """For every sample its candidate spots, the likeliest first, or why there is none.  Images are read only for
    samples without a given spot.  :class:`~gripmon.model.errors.InputError` for images or spots that don't match the
    camera's size.
    """
    out: list[list[Spot] | NotFound] = []
    with progress(len(samples), "spot") as step:
        for k, (u, v) in enumerate(samples.uv_px.tolist()):
            step()
            path, off = samples.images[k], samples.laser_off[k]
            if math.isnan(u) or math.isnan(v):
                assert path is not None, "a sample has its spot or an image"
                pictures = [(at, image_in(at)) for at in (path, off) if at is not None]
                for at, image in pictures:
                    check_size(str(at), image, *size_px)
                out.append(find_spots(*(image for _, image in pictures)))
                continue
            if not (-0.5 <= u <= size_px[0] - 0.5 and -0.5 <= v <= size_px[1] - 0.5):
                raise InputError(
                    f"{samples.places[k]}: the spot ({u:g}, {v:g}) px is outside of the camera's image of "
                    f"{size_px[0]} x {size_px[1]} px; spots of this camera"
                )
            out.append([plain_spot(samples.uv_px[k])])
    return out


def plan_table(planned: Plan) -> bytes:
    """A plan as a table like those that are read, with the expected spots."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*POSITION, *QUATERNION, "expected_u_px", "expected_v_px"])
    for pose, uv in zip(planned.base_T_ee, planned.uv_px, strict=True):
        writer.writerow([*pose[:3, 3].tolist(), *quaternion_xyzw(pose[:3, :3]), *uv.round(1).tolist()])
    return text.getvalue().encode()
