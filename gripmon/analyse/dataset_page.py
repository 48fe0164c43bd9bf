"""The report on a dataset: mountings over time, motions and failures, in one HTML file."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from gripmon.analyse.dataset import Results, writing
from gripmon.analyse.page import Table, rendered
from gripmon.analyse.stretches import POSE_COLUMNS
from gripmon.analyse.words import count, millimetres
from gripmon.io.sources.episodes import Episode
from gripmon.model.atomic import write_atomically
from gripmon.model.records import Verdict

_MOST_SHOWN, _MOST_POINTS = 24, 4000
"""Episodes with pictures, points of a plot; the Parquet table has all of them."""
_MOUNTING = ("Mounting", "Camera", "Stretches", "First", "Last", "TCP (mm)", "Farthest from it")
_OF_MOUNTINGS = "Stretches of one mounting aren't told apart by their uncertainties."


def write_page(path: Path, rows: pa.Table, results: Results, episodes: Sequence[Episode], name: str) -> None:
    """Write the report on the dataset ``name``: one HTML file that needs no network.  ``rows``: the table's, in the
    order of its ``episodes``, of which each has one or more.
    """
    from gripmon.analyse.plots import mountings_figure

    cameras, numbers = _filled(rows, "camera", ""), _filled(rows, "mounting", -1)
    groups: dict[tuple[str, int], list[int]] = {}
    for place in np.flatnonzero(numbers >= 0).tolist():
        groups.setdefault((cameras[place], int(numbers[place])), []).append(place)
    named = sorted({camera for camera, _ in groups})
    figures = {
        f"camera-{n}": mountings_figure(*_points(rows, np.flatnonzero((numbers >= 0) & (cameras == camera)), numbers))
        for n, camera in enumerate(named, 1)
    }
    failures = rows.filter(pc.is_null(rows["start_ns"])).select(["reason", "episode"]).to_pylist()
    reasons = Counter(str(row["reason"]).partition(";")[0] for row in failures)
    firsts = {str(row["reason"]).partition(";")[0]: row["episode"] for row in reversed(failures)}
    failed = [(number, reason, firsts[reason]) for reason, number in reasons.most_common()]
    page = rendered(
        "dataset.html.j2",
        figures,
        title=f"{name}: extrinsics",
        summary=_summary(rows, len(groups)),
        cameras=named,
        mountings=Table(_MOUNTING, [_mounting(rows, *key, groups[key]) for key in sorted(groups)], _OF_MOUNTINGS),
        worst=[_shown(results, episodes[number]) for number in _worst_first(rows)[:_MOST_SHOWN]],
        failed=Table(("Episodes", "Why", "The first of them"), failed),
    )
    with writing(path):
        write_atomically(path, page)


def _filled(rows: pa.Table, name: str, null: Any) -> NDArray[Any]:
    return np.array(rows[name].fill_null(null).to_pylist())


def _begins(rows: pa.Table) -> NDArray[np.intp]:
    """The first row of each episode."""
    return np.flatnonzero(_filled(rows, "stretch", 0) == 0)


def _summary(rows: pa.Table, mountings: int) -> str:
    begins = _begins(rows)
    good = np.logical_or.reduceat(_filled(rows, "verdict", "") == Verdict.VALID.value, begins)
    went = int(_filled(rows, "moved", False)[begins].sum())
    cameras = len(pc.unique(rows["camera"]))
    return (
        f"{count(len(good), 'episode')} of {count(cameras, 'camera')}: {good.sum()} with a transform that "
        f"may be used, {(~good).sum() or 'none'} without one; {count(mountings, 'mounting')}; "
        f"the camera moved in {went or 'none'} of them."
    )


def _worst_first(rows: pa.Table) -> list[int]:
    """Numbers of the episodes: by how far the camera moved, then by the share of frames that aren't usable; failures,
    which have a table of their own, last.
    """
    begins, frames = _begins(rows), _filled(rows, "frames", 0)
    far_m = np.maximum(_filled(rows, "motion_m", 0.0), _filled(rows, "crept_m", 0.0))
    far_m[_filled(rows, "start_ns", -1) < 0] = -1.0
    usable = np.add.reduceat(_filled(rows, "valid_share", 1.0) * frames, begins)
    unusable = 1.0 - usable / np.maximum(np.add.reduceat(frames, begins), 1)
    return [int(number) for number in np.lexsort((-unusable, -np.maximum.reduceat(far_m, begins)))]


def _shown(results: Results, episode: Episode) -> dict[str, Any]:
    rows = results.read(episode).to_pylist()
    pictures = [base64.b64encode(row["picture"]).decode() for row in rows if row["picture"] is not None]
    return {"episode": rows[0]["episode"], "camera": rows[0]["camera"], "rows": rows, "pictures": pictures}


def _mounting(rows: pa.Table, camera: str, number: int, places: Sequence[int]) -> tuple[Any, ...]:
    """Its row of the table."""
    at_m, episodes = _tcp_m(rows, places), rows["episode"]
    middle_m = np.median(at_m, axis=0)
    tcp_mm, far_m = " ".join(f"{1e3 * v:.2f}" for v in middle_m), float(np.linalg.norm(at_m - middle_m, axis=1).max())
    first, last = episodes[places[0]].as_py(), episodes[places[-1]].as_py()
    return number, camera, len(places), first, last, tcp_mm, millimetres(far_m)


def _tcp_m(rows: pa.Table, places: Sequence[int] | NDArray[np.intp]) -> NDArray[np.float64]:
    """(n, 3) of some rows."""
    some = rows.select(list(POSE_COLUMNS[:3])).take(places)
    return np.column_stack([column.to_numpy() for column in some.columns])


def _points(
    rows: pa.Table, places: NDArray[np.intp], numbers: NDArray[np.int64]
) -> tuple[list[str], NDArray[np.float64], NDArray[np.int64]]:
    """Names, TCPs (n, 3) relative to the first, m, and mountings (n,) of some rows; thinned if there are many."""
    places = places[:: max(len(places) // _MOST_POINTS, 1)]
    at_m = _tcp_m(rows, places)
    named = rows.select(["episode", "stretch"]).take(places).to_pylist()
    return [f"{row['episode']}, stretch {row['stretch']}" for row in named], at_m - at_m[0], numbers[places]
