"""How much of the product one frame passes from the source to its published transform: files, functions and constants,
counted.

Counts don't depend on the machine, as times do.  They may only fall: lower the limits when they have.
"""

from __future__ import annotations

import ast
import sys
from pathlib import Path
from types import CodeType, FrameType

from support.loopback import free_endpoint

import gripmon
from gripmon.daemon.config import builtin_config, load_config
from gripmon.daemon.running import run
from gripmon.io.publish.publisher import ZenohPublisher
from gripmon.io.wire import Link, PublishSettings
from gripmon.model.outputs import Event, Notes, Output, Trace
from gripmon.model.records import Frame, FrameRecord, Verdict
from gripmon.monitor import Monitor
from gripmon.record.recorder import Recorder
from gripmon.simulate import Scenario

COUNTED = range(40, 56)  # past the start's checks; one drift test's refresh falls among 16 frames
MOST_FILES, MOST_FUNCTIONS, MOST_CALLS = 51, 230, 288
"""With what the fingers show along themselves in every frame: five files, for one way less in which valid could lie;
with old pixels beside the edges, which were valid 4.5 mm off: a file, five functions, seven calls; with both bounds,
knocks of all sizes and ends looked at in three frames of four: six files and 52 functions; with knocks during an
exposure, which were valid 4 mm off: a file, two functions, two calls; the weigher in two, of 460 lines: a file.
"""
MOST_CONSTANTS = 377
"""Named at the top of the rooms that a frame passes: what can't be justified goes, and one idea has one number.
Three for a file whose plane may be tilted, and what an edge is that wasn't taught; two for knocks
during an exposure."""
PACKAGE = str(Path(gripmon.__file__).parent)


class Counted(Output):
    """A source and a publisher around the daemon's loop that count what runs between them."""

    live, connected, dropped = False, True, 0

    def __init__(self, frames: list[Frame], publisher: ZenohPublisher) -> None:
        self._frames, self._publisher = iter(frames), publisher
        self.passed: list[list[CodeType]] = []
        self.verdicts: list[Verdict] = []

    def read(self) -> Frame | None:
        frame = next(self._frames, None)
        if frame is not None and frame.seq in COUNTED:
            self.passed.append([])
            sys.setprofile(self._count)
        return frame

    def frame(self, frame: Frame, record: FrameRecord, trace: Trace, notes: Notes | None = None) -> None:
        self._publisher.frame(frame, record, trace, notes)
        sys.setprofile(None)
        self.verdicts.append(record.verdict)

    def event(self, event: Event) -> None:
        self._publisher.event(event)

    def close(self) -> None: ...

    def _count(self, frame: FrameType, event: str, _argument: object) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(PACKAGE):
            self.passed[-1].append(frame.f_code)


def test_the_way_of_a_frame_gets_no_longer():
    config = load_config(builtin_config("demo.yaml"), check_source=False)
    settings = config.settings
    simulator = config.scene.simulator(Scenario(name="way", duration_s=2.0, fps=60.0), 1)
    link = Link(PublishSettings(listen=(free_endpoint(),)))
    publisher = ZenohPublisher(link, settings.robot, settings.camera_name)
    counted = Counted([simulator.frame(k) for k in range(COUNTED.stop)], publisher)
    try:
        monitor = Monitor(config.camera, config.gripper, settings.monitor, config.reference)
        run(
            monitor, source=counted, outputs=(counted,), recorder=Recorder(), settings=settings.daemon,
            robot=settings.robot, camera=settings.camera_name,
        )  # fmt: skip
    finally:
        sys.setprofile(None)
        publisher.close()
        link.close()
    assert counted.verdicts[-len(COUNTED) :] == [Verdict.VALID] * len(COUNTED)
    passed = sorted(counted.passed, key=len)
    usual, longest = passed[len(passed) // 2], passed[-1]
    files = {code.co_filename for code in usual}
    functions = {(code.co_filename, code.co_qualname) for code in usual}
    said = f"{len(files)} files, {len(functions)} functions, {len(usual)} calls; at most {len(longest)} calls"
    assert len(files) <= MOST_FILES, said
    assert len(functions) <= MOST_FUNCTIONS, said
    assert len(usual) <= MOST_CALLS, said


def constants_of(source: str) -> list[str]:
    """Upper-case names that a module's top level assigns."""
    targets = []
    for node in ast.parse(source).body:
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets += node.targets if isinstance(node, ast.Assign) else [node.target]
    names = [name for target in targets for name in (target.elts if isinstance(target, ast.Tuple) else [target])]
    return [name.id for name in names if isinstance(name, ast.Name) and name.id.isupper()]


def test_the_rooms_of_a_frame_get_no_more_constants():
    assert constants_of("A, _B = 1, 2\nC: int = 3\nd = 4\nfor E in (): ...") == ["A", "_B", "C"]
    rooms = [Path(PACKAGE, room) for room in ("track", "judge", "monitor")]
    beside = ("shadow.py", "edge_lines.py", "ends_told.py")
    passed = [path for room in rooms for path in room.rglob("*.py") if path.name not in beside]
    found = [name for path in passed for name in constants_of(path.read_text())]
    assert len(found) <= MOST_CONSTANTS, f"{len(found)} constants"
