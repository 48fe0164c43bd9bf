"""Tables of laser samples: CSV, YAML or JSON files, and the images that they name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gripmon.cli import common

if TYPE_CHECKING:
    import csv

    from gripmon.calibrate.sighting import NotFound
    from gripmon.laser.pointer.calibrating import Spots
    from gripmon.laser.pointer.planning import Plan
    from gripmon.laser.pointer.samples import Samples
    from gripmon.laser.pointer.spots import Spot

_SUFFIXES = (".csv", ".yaml", ".yml", ".json")


def read_tables(paths: list[Path]) -> tuple[Samples, list[Path]]:
    """All samples, and the file that each comes from; what is wrong ends the command with exit code 2.  Of several
    tables each sample's name says which.
    """
    from gripmon.laser.pointer.samples import from_rows, joined

    parts, origins = [], []
    for path in paths:
        rows, places = rows_of(path)
        try:
            parts.append(from_rows(rows, places))
        except ValueError as error:
            raise common.CommandFailedError(f"{path}: {error}", common.EXIT_USAGE) from None
        origins += [path] * len(rows)
    try:
        samples = joined(parts, [str(path) for path in paths])
    except ValueError as error:
        raise common.CommandFailedError(str(error), common.EXIT_USAGE) from None
    if len(paths) > 1:
        _check_once(samples, origins)
        samples = replace(
            samples, names=tuple(f"{o.name}, {name}" for o, name in zip(origins, samples.names, strict=True))
        )
    return samples, origins


def _check_once(samples: Samples, origins: list[Path]) -> None:
    """Within a table this is known already."""
    import numpy as np

    seen: dict[tuple[Any, ...], int] = {}
    for k, (uv, pose, image) in enumerate(zip(samples.uv_px, samples.base_T_ee, samples.images, strict=True)):
        file = None if image is None else str(origins[k].parent / image)
        spot = () if np.isnan(uv).any() else tuple(uv.tolist())
        first = seen.setdefault((file, *spot, *np.round(pose, 9).ravel().tolist()), k)
        if first != k:
            raise common.CommandFailedError(
                f"{origins[k]}: {samples.names[k]}: is the same sample as {origins[first]}: {samples.names[first]}; "
                "each sample once",
                common.EXIT_USAGE,
            )


def rows_of(path: Path) -> tuple[list[dict[str, Any]], list[str]]:
    """A table's rows, and where each stands; what is wrong ends the command with exit code 2."""
    if path.suffix.lower() not in _SUFFIXES:
        raise common.CommandFailedError(f"{path}: is no table; a .csv, .yaml or .json file", common.EXIT_USAGE)
    if path.suffix.lower() == ".csv":
        return _csv_rows(path)
    values = _json(path) if path.suffix.lower() == ".json" else _yaml(path)
    samples = values.get("samples") if isinstance(values, dict) else values
    if not isinstance(samples, list) or not all(isinstance(sample, dict) for sample in samples):
        raise common.CommandFailedError(
            f"{path}: samples is no list of samples; samples: [{{u_px, v_px, base_T_ee}}, ...]", common.EXIT_USAGE
        )
    return samples, [f"sample {k + 1}" for k in range(len(samples))]


def _csv_rows(path: Path) -> tuple[list[dict[str, Any]], list[str]]:
    import csv

    reader = csv.DictReader(_text(path).splitlines(), skipinitialspace=True)
    try:
        return _rows_of(path, reader)
    except csv.Error as error:
        raise common.CommandFailedError(
            f"{path}: line {reader.line_num}: {error} (an open quote?); a table of samples", common.EXIT_USAGE
        ) from None


def _rows_of(path: Path, reader: csv.DictReader[str]) -> tuple[list[dict[str, Any]], list[str]]:
    rows: list[dict[str, Any]] = []
    places = []
    header = reader.fieldnames or []
    separator = next((sign for sign in ";\t" if len(header) == 1 and sign in header[0]), None)
    if separator is not None:
        shown = {";": "semicolons", "\t": "tabs"}[separator]
        raise common.CommandFailedError(
            f"{path}: columns are separated by {shown}; commas, and points in numbers", common.EXIT_USAGE
        )
    for row in reader:
        if None in row or None in row.values():
            count = len(reader.fieldnames or ())
            raise common.CommandFailedError(
                f"{path}: line {reader.line_num} has another number of fields than the header; {count}",
                common.EXIT_USAGE,
            )
        rows.append({str(key).strip(): value.strip() for key, value in row.items()})
        places.append(f"line {reader.line_num}")
    if not rows:
        raise common.CommandFailedError(
            f"{path}: holds no sample; a header line, then a line for each spot", common.EXIT_USAGE
        )
    return rows, places


def _json(path: Path) -> Any:
    import json

    try:
        return json.loads(_text(path))
    except (ValueError, RecursionError) as error:
        raise common.CommandFailedError(f"{path}: not JSON: {error}; a JSON file", common.EXIT_USAGE) from None


def _yaml(path: Path) -> Any:
    from gripmon.daemon.config.errors import ConfigError
    from gripmon.daemon.config.yaml_file import read_yaml

    try:
        return read_yaml(path)
    except ConfigError as error:
        raise common.CommandFailedError(str(error), common.EXIT_USAGE) from None


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise common.CommandFailedError(
            f"{path}: there is no such file; a table of samples", common.EXIT_USAGE
        ) from None
    except UnicodeDecodeError:
        raise common.CommandFailedError(f"{path}: is not text; a table of samples", common.EXIT_USAGE) from None
    except OSError as error:
        raise common.CommandFailedError(
            f"{path}: can't be read ({error.strerror}); a table of samples", common.EXIT_USAGE
        ) from None


def write_plan(planned: Plan, path: Path) -> None:
    """A table as those that are read, with the expected spots; whole or not at all."""
    import csv
    import io

    from gripmon.calibrate.tables import POSITION, QUATERNION
    from gripmon.model.atomic import write_atomically
    from gripmon.model.geometry import quaternion_xyzw

    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*POSITION, *QUATERNION, "expected_u_px", "expected_v_px"])
    for pose, uv in zip(planned.base_T_ee, planned.uv_px, strict=True):
        writer.writerow([*pose[:3, 3].tolist(), *quaternion_xyzw(pose[:3, :3]), *uv.round(1).tolist()])
    try:
        write_atomically(path, text.getvalue().encode())
    except OSError as error:
        raise common.not_writable(path, error, "--plan") from None


def image_files(samples: Samples, origins: list[Path]) -> list[Path]:
    """All image files that are looked at, relative to their tables."""
    out = []
    for k in _unseen(samples):
        out += [origins[k].parent / name for name in (samples.images[k], samples.laser_off[k]) if name is not None]
    return list(dict.fromkeys(out))


def _unseen(samples: Samples) -> list[int]:
    import numpy as np

    return np.flatnonzero(np.isnan(samples.uv_px).any(axis=1)).tolist()


def find_spots(samples: Samples, origins: list[Path], size_px: tuple[int, int]) -> tuple[Spots, list[int], list[str]]:
    """Spots in the images of those samples that don't have theirs; indices of samples with a spot, and why the others
    have none.
    """
    import numpy as np

    from gripmon.calibrate.sighting import NotFound
    from gripmon.laser.pointer.calibrating import Spots
    from gripmon.laser.pointer.spots import find_spots as in_image

    unseen = set(_unseen(samples))
    uv_px, covariances, others = samples.uv_px.copy(), np.tile(np.eye(2), (len(samples), 1, 1)), []
    kept, missing = [], []
    with common.progress_bar(len(samples), "spot") as step:
        for k, name in enumerate(samples.names):
            step()
            others.append(np.empty((0, 2)))
            if k in unseen:
                image = _image(origins[k].parent / str(samples.images[k]), size_px)
                off = samples.laser_off[k]
                found = in_image(image, None if off is None else _image(origins[k].parent / off, size_px))
                if isinstance(found, NotFound):
                    missing.append(f"{name}: {found.reason}")
                    continue
                uv_px[k], covariances[k] = found[0].uv_px, found[0].covariance_px
                others[k] = np.array([spot.uv_px for spot in found[1:]]).reshape(-1, 2)
            elif not (-0.5 <= uv_px[k, 0] <= size_px[0] - 0.5 and -0.5 <= uv_px[k, 1] <= size_px[1] - 0.5):
                u, v = uv_px[k]
                place = name.removeprefix(f"{origins[k].name}, ")
                raise common.CommandFailedError(
                    f"{origins[k]}: {place}: the spot ({u:g}, {v:g}) px is outside of the camera's image of "
                    f"{size_px[0]} x {size_px[1]} px; spots of this camera",
                    common.EXIT_USAGE,
                )
            kept.append(k)
    covariance = covariances[kept] if unseen else None
    return Spots(uv_px[kept], covariance, tuple(others[k] for k in kept) if unseen else ()), kept, missing


def candidates(samples: Samples, origins: list[Path], size_px: tuple[int, int]) -> list[list[Spot] | NotFound]:
    """Of every sample: what may be its spot, or why there is none."""
    from gripmon.laser.pointer.spots import find_spots as in_image
    from gripmon.laser.watch import plain_spot

    unseen = set(_unseen(samples))
    out: list[list[Spot] | NotFound] = []
    with common.progress_bar(len(samples), "spot") as step:
        for k, origin in enumerate(origins):
            step()
            if k not in unseen:
                _check_inside(samples, k, origin, size_px)
                out.append([plain_spot(samples.uv_px[k])])
                continue
            image, off = _image(origin.parent / str(samples.images[k]), size_px), samples.laser_off[k]
            out.append(in_image(image, None if off is None else _image(origin.parent / off, size_px)))
    return out


def _check_inside(samples: Samples, k: int, origin: Path, size_px: tuple[int, int]) -> None:
    u, v = samples.uv_px[k]
    if not (-0.5 <= u <= size_px[0] - 0.5 and -0.5 <= v <= size_px[1] - 0.5):
        raise common.CommandFailedError(
            f"{origin}: {samples.names[k]}: the spot ({u:g}, {v:g}) px is outside of the camera's image of "
            f"{size_px[0]} x {size_px[1]} px; spots of this camera",
            common.EXIT_USAGE,
        )


def _image(path: Path, size_px: tuple[int, int]) -> Any:
    from gripmon.io.sources.folder import read_image

    image, fault = read_image(path)
    if image is None:
        raise common.CommandFailedError(f"{path}: {fault}; an image file", common.EXIT_USAGE)
    if (image.shape[1], image.shape[0]) != size_px:
        raise common.CommandFailedError(
            f"{path}: is {image.shape[1]} x {image.shape[0]} px, the camera {size_px[0]} x {size_px[1]}; images of "
            "this camera",
            common.EXIT_USAGE,
        )
    return image
