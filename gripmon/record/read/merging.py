"""A run's files put together: frames in order, nothing twice, and in words what is missing or contradicts itself."""

from __future__ import annotations

import re
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import (
    AlertRecord,
    FrameRecord,
    Meta,
    RecordedCommand,
    RecordedConfiguration,
    ReferenceRecord,
    StateRecord,
)
from gripmon.record.read import entities
from gripmon.record.read.container import Block
from gripmon.record.read.contents import Contents
from gripmon.record.read.table import FrameTable, IntArray, TableBuilder

UNKNOWN = "unknown"
_NUMBERED = re.compile(r"-(\d{4,})$")
_T = TypeVar("_T", bound=Hashable)


@dataclass(frozen=True)
class Merged:
    """``rows_block`` (n,) says of each row of ``table`` in which of ``blocks`` (a part's number and a block of its
    file) it lies.
    """

    parts: tuple[Contents, ...]
    meta: Meta | None
    robot: str
    camera: str
    table: FrameTable
    rows_block: IntArray
    blocks: list[tuple[int, Block]]
    alerts: tuple[AlertRecord, ...]
    references: tuple[ReferenceRecord, ...]
    commands: tuple[RecordedCommand, ...]
    states: tuple[StateRecord, ...]
    configuration: RecordedConfiguration | None
    image_seqs: IntArray
    faults: tuple[str, ...]
    gaps: tuple[str, ...]


def merge(contents: Sequence[Contents]) -> Merged:
    """All parts of one recording."""
    parts = tuple(sorted(contents, key=_place_in_run))
    faults = [f"{part.path}: {fault}" for part in parts for fault in part.faults]
    # The last file of a run was begun and got none: nothing is lost.
    empty = [part for part in parts if not len(part.frames) and (part is not parts[-1] or len(parts) == 1)]
    faults += [f"{part.path}: holds no frames" for part in empty]
    faults += _missing_files(parts)
    meta = next((part.meta for part in parts if part.meta is not None), None)
    states = tuple(sorted(_events(parts, entities.STATE), key=attrgetter("seq")))
    robot, camera = _names(parts, meta, states)
    table, rows_block, blocks, said = _frames(parts)
    faults += said
    gaps = _gaps(parts, table, rows_block, blocks)
    faults += gaps
    faults += _backwards(parts, table, rows_block, blocks)
    seqs = [part.image_seqs for part in parts]
    return Merged(
        parts=parts,
        meta=meta,
        robot=robot,
        camera=camera,
        table=table,
        rows_block=rows_block,
        blocks=blocks,
        alerts=_alerts(parts, robot, camera),
        references=tuple(sorted(_events(parts, entities.REFERENCE), key=attrgetter("revision"))),
        commands=tuple(sorted(_events(parts, entities.COMMAND), key=attrgetter("seq"))),
        states=states,
        configuration=next((c for part in parts for c in part.events.get(entities.CONFIGURATION, ())), None),
        image_seqs=np.unique(np.concatenate(seqs)),
        faults=tuple(faults),
        gaps=tuple(gaps),
    )


def _number(part: Contents) -> int | None:
    """Of a file in its run."""
    if part.meta is not None:
        return part.meta.file_number
    found = _NUMBERED.search(part.path.stem)
    return int(found[1]) if found else None


def _place_in_run(part: Contents) -> tuple[int, int, str]:
    return _number(part) or 0, part.frames.first_seq, str(part.path)


def _missing_files(parts: Sequence[Contents]) -> list[str]:
    """Numbers that are missing, where frames are missing there, too: files may have been put together."""
    numbered = [(number, part) for part in parts if (number := _number(part)) is not None and len(part.frames)]
    said = []
    before, last = 0, -1
    for number, part in numbered:
        if number > before + 1 and part.frames.first_seq > last + 1:
            which = f"number {number - 1} is" if number == before + 2 else f"numbers {before + 1} to {number - 1} are"
            said.append(f"{part.path}: is file {number} of its run, and {which} not there; the others were used")
        before, last = number, part.frames.last_seq
    return said


def _events(parts: Sequence[Contents], entity: str) -> list[Any]:
    return _distinct(event for part in parts for event in part.events.get(entity, ()))


def _distinct(events: Iterable[_T]) -> list[_T]:
    return list(dict.fromkeys(events))


def _names(parts: Sequence[Contents], meta: Meta | None, states: Sequence[StateRecord]) -> tuple[str, str]:
    """Robot and camera."""
    if meta is not None:
        return meta.robot, meta.camera
    alerts = _events(parts, entities.ALERT)
    for said in (*states[:1], *alerts[:1]):
        return said.robot, said.camera
    return next((part.about for part in parts if part.about is not None), (UNKNOWN, UNKNOWN))


def _alerts(parts: Sequence[Contents], robot: str, camera: str) -> tuple[AlertRecord, ...]:
    """Those of the frames' records and the daemon's own, by the frames they belong to."""
    records: dict[int, FrameRecord] = {}
    for part in parts:
        for record in part.alerting:
            records.setdefault(record.seq, record)
    found = [
        AlertRecord(
            robot=robot,
            camera=camera,
            seq=record.seq,
            stamp_ns=record.stamp_ns,
            state=record.state,
            reference_id=record.reference_id,
            revision=record.revision,
            **msgspec.structs.asdict(alert),
        )
        for record in records.values()
        for alert in record.alerts
    ]
    return tuple(sorted(_distinct([*found, *_events(parts, entities.ALERT)]), key=attrgetter("seq")))


def _frames(parts: Sequence[Contents]) -> tuple[FrameTable, IntArray, list[tuple[int, Block]], list[str]]:
    """All parts' frames in the order of their numbers, each once; the first file's where several have it."""
    blocks: list[tuple[int, Block]] = []
    rows_block: list[IntArray] = []
    for number, part in enumerate(parts):
        rows_block.append(part.record_block + len(blocks))
        blocks += [(number, block) for block in part.record_blocks]
    table = TableBuilder.join([part.frames for part in parts])
    of_rows = np.concatenate(rows_block)
    if np.all(np.diff(table.seq) > 0):
        return table, of_rows, blocks, []
    order = np.argsort(table.seq, kind="stable")
    again = np.concatenate([[False], np.diff(table.seq[order]) == 0])
    said = _repeated(parts, table, order, again, np.array([part for part, _ in blocks])[of_rows])
    kept = order[~again]
    return table.take(kept), of_rows[kept], blocks, said


def _repeated(
    parts: Sequence[Contents], table: FrameTable, order: IntArray, again: NDArray[np.bool_], rows_part: IntArray
) -> list[str]:
    """``again`` (n,) marks those of the rows in ``order`` whose number the row before has, too."""
    twice = np.flatnonzero(again)
    first = order[np.maximum.accumulate(np.where(again, 0, np.arange(len(order))))][twice]
    second = order[twice]
    same = (table.stamp_ns[first] == table.stamp_ns[second]) & (
        (table.cam_T_grip[first] == table.cam_T_grip[second]) | np.isnan(table.cam_T_grip[first])
    ).all(axis=1)
    said = []
    for number, part in enumerate(parts):
        mine = rows_part[second] == number
        if not mine.any():
            continue
        others = np.unique(rows_part[first[mine]])
        who = ", ".join("the same file" if o == number else parts[o].path.name for o in others)
        text = f"{part.path}: {mine.sum()} of its frames stand in {who}, too; each was used once"
        differing = second[mine & ~same]
        if len(differing):
            text += f", though {len(differing)} differ (the first is frame {table.seq[differing].min()})"
        said.append(text)
    return said


def _gaps(
    parts: Sequence[Contents], table: FrameTable, rows_block: IntArray, blocks: list[tuple[int, Block]]
) -> list[str]:
    missing = np.diff(table.seq) - 1
    places = np.flatnonzero(missing > 0)
    if not len(places):
        return []
    largest = places[np.argmax(missing[places])]
    path = parts[blocks[rows_block[largest]][0]].path
    total, where = int(missing[places].sum()), "one place" if len(places) == 1 else f"{len(places)} places"
    most = "" if len(places) == 1 else f", most of them ({missing[largest]})"
    lost = f"{total} frames of the run are missing in {where}{most} after frame {table.seq[largest]}"
    return [f"{path}: {lost}; the {len(table)} that are there were used"]


def _backwards(
    parts: Sequence[Contents], table: FrameTable, rows_block: IntArray, blocks: list[tuple[int, Block]]
) -> list[str]:
    steps_ns = np.diff(table.stamp_ns)
    places = np.flatnonzero(steps_ns < 0)
    if not len(places):
        return []
    path = parts[blocks[rows_block[places[0] + 1]][0]].path
    often = "" if len(places) == 1 else f" ({len(places)} times in all)"
    said = f"time runs backwards by {-1e-9 * steps_ns[places[0]]:.3g} s at frame {table.seq[places[0] + 1]}{often}"
    return [f"{path}: {said}; frames were taken in the order of their numbers"]
