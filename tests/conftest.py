"""For all tests."""

from __future__ import annotations

import logging
import os
import pickle
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

# As the command line does it, before NumPy is imported: with a thread for each core, linear algebra takes up to three
# times the processor time beside other tests, and rounds otherwise from machine to machine.
for _threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")

import cv2
import hypothesis
import pytest
import zenoh
from support.commanded import Loop, reply_to
from support.kept import forget_the_oldest
from support.long_files import LONGEST
from support.loopback import free_endpoint, give_default_port_back, plain_session
from support.published import Published

from gripmon.daemon import forecast
from gripmon.io.wire import PublishSettings
from gripmon.monitor import warm_up
from gripmon.teach.visibility import Rig

# No test fails because a machine is slow; a third of the usual examples in every run finds what they find in three.
hypothesis.settings.register_profile("unhurried", deadline=None, max_examples=35)
hypothesis.settings.load_profile("unhurried")

cv2.setNumThreads(1)

# A shell's background job ignores Ctrl-C, and so would the processes that tests start and interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_configure(config: pytest.Config) -> None:
    """Machine code is made once, before workers and the processes of tests would make it, each for itself."""
    if not hasattr(config, "workerinput"):
        warm_up()


def pytest_sessionfinish(session: pytest.Session) -> None:
    if not hasattr(session.config, "workerinput"):
        forget_the_oldest()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Workers take file after file in this order; what is marked slow says why."""
    for item in items:
        if any(len(mark.args) != 1 for mark in item.iter_markers("slow")):
            raise pytest.UsageError(f'{item.nodeid}: @pytest.mark.slow("<seconds> s; what guards the same in less")')
    rank = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(rank)))


@pytest.fixture(autouse=True)
def _default_port_is_given_back() -> Iterator[None]:
    yield
    give_default_port_back()


@pytest.fixture(autouse=True)
def _state_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No test finds what another one, or the user's own monitor, keeps over restarts."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state-home"))


@pytest.fixture(autouse=True)
def _log_as_at_first() -> None:
    """Commands that other tests, or what a file prepares, ran in this process sent the log elsewhere, or silenced parts
    of it.
    """
    logger = logging.getLogger("gripmon")
    logger.handlers, logger.propagate = [], True
    for each in (logger, *logging.root.manager.loggerDict.values()):
        if isinstance(each, logging.Logger) and each.name.partition(".")[0] == "gripmon":
            each.setLevel(logging.NOTSET)


@pytest.fixture(scope="session", autouse=True)
def _a_view_is_examined_once() -> Iterator[None]:
    """How far the camera and the jaw may move in a view takes most of ``check``, and tests check few different ones."""

    def once(examine: Callable[..., object]) -> Callable[..., object]:
        found: dict[bytes, object] = {}

        def examined(rig: Rig, *place: object) -> object:
            key = pickle.dumps((rig._replace(gripper=rig.gripper.model), *place))
            if key not in found:
                found[key] = examine(rig, *place)
            return found[key]

        return examined

    with pytest.MonkeyPatch.context() as patch:
        for name in ("freedom", "over_jaw"):
            patch.setattr(forecast, name, once(getattr(forecast, name)))
        yield


TOOLS = Path(__file__).resolve().parent.parent / "tools"


@pytest.fixture
def tools_importable(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The packages in ``tools``, also in processes that a test starts; each test imports them again."""
    monkeypatch.setenv("PYTHONPATH", f"{TOOLS}:{TOOLS.parent}")
    monkeypatch.syspath_prepend(str(TOOLS))
    yield
    packages = {path.name for path in TOOLS.iterdir() if path.is_dir()}
    for name in [name for name in sys.modules if name.partition(".")[0] in packages]:
        del sys.modules[name]


@pytest.fixture
def endpoint() -> str:
    """An address on loopback that no one listens at."""
    return free_endpoint()


@pytest.fixture
def publisher(endpoint: str) -> Iterator[Published]:
    """The monitor ``arm/wrist``, without a camera, listening there."""
    made = Published(PublishSettings(listen=(endpoint,)), "arm", "wrist")
    yield made
    made.close()


@pytest.fixture
def loop(publisher: Published) -> Iterator[Loop]:
    """What carries out that monitor's commands."""
    made = Loop(publisher.commands, reply_to)
    yield made
    made.end()


@pytest.fixture
def session(publisher: Published, endpoint: str) -> Iterator[zenoh.Session]:
    """Someone else on the network, connected to that monitor."""
    with plain_session(connect=endpoint) as opened:
        yield opened
