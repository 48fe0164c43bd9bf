"""What an ``.rrd`` file holds, read by rerun in a process of its own.

rerun's reader refuses a file that is cut within a message, and damaged bytes can end the process that it runs in (its
native code panics).  So it runs in a child that serves all files and ends when it is idle, or with its parent; what it
can't read is left out of a temporary copy, and the rest is read from that.  The file itself is never written to.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import itertools
import multiprocessing
import os
import tempfile
import threading
import warnings
from collections.abc import Collection, Iterator, Sequence
from importlib.metadata import version
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

from gripmon.model.errors import one_line
from gripmon.model.own_process import OwnProcess
from gripmon.record.container import HEADER_BYTES, MAGIC, STORE_INFO, Message, Walk, is_complete

FRAME = "frame"
"""The timeline of frame numbers."""
_IDLE_S = 20.0


class UnreadableFileError(ValueError):
    """No part of a file can be used; the text gives the reason in a few words, without the file's name."""


class ReadingError(RuntimeError):
    """rerun could not read on; the text says why, as rerun does."""


class Store(NamedTuple):
    """One of the recordings in a file."""

    application: str
    recording_id: str


class Query(NamedTuple):
    """What to read: ``entities`` (none: everything is decoded, and nothing given), of these only the rows of the frames
    ``seqs`` (None: all), and only the component ``component`` (None: all).  ``indexed``: by the file's footer.
    """

    path: str
    indexed: bool
    entities: tuple[str, ...] = ()
    seqs: Any = None
    component: str | None = None


Rows = tuple[Store, str, Any]
"""Of which recording, of which entity, and an Arrow batch with a column per timeline (none if static) and component."""


class RrdFile:
    """A file with recordings, ``stores`` once it was read.  ``faults``, a few words each: what was found wrong."""

    def __init__(self, path: Path) -> None:
        """Raises :class:`UnreadableFileError`, also for errors of the file system."""
        self.path = path
        self.faults: list[str] = []
        self.stores: list[Store] = []
        self._readable, self._repaired = path, False
        try:
            with path.open("rb") as file:
                self._check_header(file.read(HEADER_BYTES))
            self._indexed = is_complete(path)
            if not self._indexed:
                self._note_where_it_ends(Walk(path))
        except OSError as error:
            raise UnreadableFileError(error.strerror or str(error)) from None

    def read(self, entities: Collection[str], seqs: Any = None, component: str | None = None) -> Iterator[Rows]:
        """The rows of some entities, recording by recording, in the order of the file.

        Raises :class:`UnreadableFileError` if there are no recordings in it, OSError if it can't be read any more.
        """
        given = 0
        while True:
            try:
                for rows in itertools.islice(self._read(entities, seqs, component), given, None):
                    yield rows
                    given += 1
                return
            except ReadingError as error:
                os.close(os.open(self.path, os.O_RDONLY))  # OSError: it is gone
                if self._repaired:
                    raise UnreadableFileError(f"can't be read ({error})") from None
                self._repair(error)

    def _read(self, entities: Collection[str], seqs: Any, component: str | None) -> Iterator[Rows]:
        found = _answers(Query(str(self._readable), self._indexed, tuple(entities), seqs, component))
        self.stores = stores = [Store(*each) for each in next(found)]
        if not stores:
            raise UnreadableFileError("is cut short before its recording begins")
        for number, entity, batch in found:
            yield stores[number], entity, batch

    def _check_header(self, header: bytes) -> None:
        if not header:
            raise UnreadableFileError("is empty")
        if header[: len(MAGIC)] != MAGIC:
            raise UnreadableFileError("is not a rerun recording, whatever its name says")
        if len(header) < HEADER_BYTES:
            raise UnreadableFileError("is cut short within its header")
        written = tuple(header[4:7])
        ours = tuple(int("".join(filter(str.isdigit, part)) or 0) for part in version("rerun-sdk").split(".")[:3])
        if written > ours:
            newer, older = (".".join(map(str, numbers)) for numbers in (written, ours))
            self.faults.append(f"was written by rerun {newer}, newer than {older} here; what is understood was used")

    def _note_where_it_ends(self, walk: Walk) -> None:
        if walk.damaged:
            self.faults.append(f"is damaged at byte {walk.end}; the {walk.end / 1e6:.1f} MB before it were used")
        elif walk.cut:
            whole = f"its {walk.end / 1e6:.1f} MB of whole messages were used"
            self.faults.append(f"is cut short in the middle of a message at byte {walk.size}; {whole}")
        else:
            self.faults.append("was not finished (no footer); all its messages were used")
        if not any(message.kind == STORE_INFO for message in walk.messages):
            raise UnreadableFileError("is cut short before its recording begins")
        if walk.damaged or walk.cut or walk.joined:
            self._readable = self._copy(walk.messages)

    def _repair(self, error: ReadingError) -> None:
        """Read from a copy of what can be read from now on."""
        try:
            walk = Walk(self.path)
            infos = self._sound([message for message in walk.messages if message.kind == STORE_INFO], [])
            others = self._sound([message for message in walk.messages if message.kind != STORE_INFO], infos)
            damaged = len(walk.messages) - len(infos) - len(others)
            self._readable = self._copy(sorted([*infos, *others], key=lambda message: message.offset))
        except OSError as wrong:
            raise UnreadableFileError(f"is damaged ({error}), and can't be copied ({wrong.strerror})") from None
        if damaged:
            self.faults.append(f"has {damaged} damaged message{'s' * (damaged > 1)}, which were left out")
        elif self._indexed:
            self.faults.append(f"can't be read by its footer ({error}); its messages were read one by one")
        if walk.damaged and self._indexed:
            self.faults.append(f"is damaged at byte {walk.end}; the {walk.end / 1e6:.1f} MB before it were used")
        self._indexed, self._repaired = False, True

    def _sound(self, messages: Sequence[Message], before: Sequence[Message]) -> list[Message]:
        """Those that rerun can read behind ``before``."""
        if not messages:
            return []
        trial = self._copy([*before, *messages])
        try:
            for _ in _answers(Query(str(trial), indexed=False)):
                pass
            return list(messages)
        except ReadingError:
            pass
        finally:
            trial.unlink()
        middle = len(messages) // 2
        return [*self._sound(messages[:middle], before), *self._sound(messages[middle:], before)] if middle else []

    def _copy(self, messages: Sequence[Message]) -> Path:
        """A file of some messages."""
        descriptor, name = tempfile.mkstemp(suffix=".rrd", dir=self._copies.name)
        with self.path.open("rb") as file, os.fdopen(descriptor, "wb") as copy:
            copy.write(file.read(HEADER_BYTES))
            for message in messages:
                file.seek(message.offset)
                copy.write(file.read(message.size))
        return Path(name)

    @functools.cached_property
    def _copies(self) -> tempfile.TemporaryDirectory[str]:
        return tempfile.TemporaryDirectory(prefix="gripmon-read-", ignore_cleanup_errors=True)


class ChildProcess:
    """The process that reads.  Several passes may be open at a time."""

    def __init__(self) -> None:
        self._connection, theirs = multiprocessing.Pipe()
        # What is wrong comes back as an answer.
        self._process = OwnProcess(serve, theirs.fileno(), inherits=(theirs.fileno(),), quiet=True)
        theirs.close()
        atexit.register(self.close)
        self._lock = threading.Lock()
        self._numbers = itertools.count()

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Also reaps it."""
        return self._process.runs and not self._connection.closed

    def read(self, query: Query) -> Iterator[Any]:
        """The answers to a query."""
        number = next(self._numbers)
        try:
            answer = self._ask(number, query)
            while answer is not None:
                yield answer
                answer = self._ask(number, None)
        finally:
            with contextlib.suppress(OSError), self._lock:
                self._connection.send((number, "closed"))

    def _ask(self, number: int, query: Query | None) -> Any:
        try:
            with self._lock:
                self._connection.send((number, query))
                good, answer = self._connection.recv()
        except (EOFError, OSError):
            self._connection.close()
            code = self._process.wait()
            if code == 0 and query is not None:
                raise _WasIdleError from None
            raise ReadingError(f"rerun's reader ended with {'signal ' * (code < 0)}{abs(code)}") from None
        if not good:
            raise ReadingError(answer)
        return answer

    def close(self) -> None:
        """End it.  An interrupt at the very end of a command has nothing left to stop."""
        self._connection.close()
        with contextlib.suppress(KeyboardInterrupt):
            self._process.wait()


class _WasIdleError(Exception):
    """The child had ended just then."""


_children: dict[int, ChildProcess] = {}  # by the process that it is of: a forked one needs its own


def _answers(query: Query) -> Iterator[Any]:
    """As :func:`_read`, by the child.  Raises :class:`ReadingError`."""
    try:
        yield from child_process().read(query)
    except _WasIdleError:
        yield from child_process().read(query)


def child_process() -> ChildProcess:
    """The one that reads; a new one if there is none."""
    child = _children.get(os.getpid())
    if child is None or not child.alive:
        child = _children[os.getpid()] = ChildProcess()
    return child


def serve(descriptor: int) -> None:
    """The child's side of ``descriptor``: answers until its parent is gone, or asks nothing for a while."""
    connection: Connection[Any, Any] = Connection(descriptor)
    passes: dict[int, Iterator[Any]] = {}
    with contextlib.suppress(EOFError, OSError):
        while passes or connection.poll(_IDLE_S):
            number, asked = connection.recv()
            if asked == "closed":
                passes.pop(number, None)
                continue
            if asked is not None:
                passes[number] = _read(asked)
            try:
                answer = True, next(passes[number], None)
            except BaseException as error:  # noqa: BLE001 - whatever rerun and Arrow raise, a panic, too
                answer = False, one_line(error)
            connection.send(answer)


def _read(query: Query) -> Iterator[Any]:
    """First the application and id of each recording, then (its place among them, entity, batch)."""
    import pyarrow as pa
    import pyarrow.compute as pc
    from rerun.chunk import RrdReader

    with warnings.catch_warnings():
        warnings.simplefilter("error" if query.indexed else "ignore")  # a mark without a footer
        reader = RrdReader(query.path)
        entries = list({(e.application_id, e.recording_id): e for e in reader.recordings()}.items())
        opened = [reader.store(store=entry) if query.indexed else None for _, entry in entries]
    yield [name for name, _ in entries]
    wanted = None if query.seqs is None else pa.array(query.seqs, pa.int64())
    content = [f"/{entity}" for entity in query.entities]
    for number, (_, entry) in enumerate(entries):
        indexed = opened[number]
        stream = reader.stream(store=entry) if indexed is None else indexed.stream()
        for chunk in stream.filter(content=content) if content else stream:
            batch = chunk.to_record_batch()
            batch.validate(full=True)
            if not content:
                continue
            names = [n for n in batch.schema.names if not n.startswith("rerun.")]
            if query.component is not None:
                names = [n for n in names if n in (FRAME, query.component)]
            batch = batch.select(names)
            if wanted is not None and FRAME in names:
                batch = batch.filter(pc.is_in(batch.column(FRAME).cast(pa.int64()), wanted))
            if batch.num_rows:
                yield number, chunk.entity_path.removeprefix("/"), batch
