"""``rclpy``, found and checked, and a node of it in a thread of its own, which opens it again after a fault."""

from __future__ import annotations

import contextlib
import importlib
import importlib.machinery
import importlib.util
import logging
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from gripmon.model.errors import one_line

_log = logging.getLogger(__name__)

_Handle = Callable[[Any], None]
_PACKAGES = ("rclpy", "geometry_msgs.msg", "sensor_msgs.msg", "diagnostic_msgs.msg", "std_srvs.srv")
_GET = (
    "an environment that sees the robot's own (python3 -m venv --system-site-packages), or the wheels: "
    "pip install '.[ros2]' in gripmon's checkout (x86-64, Python 3.11 or 3.12)"
)
_MOST_DOMAIN_ID = 232
_SPIN_S, _TEND_S, _FIRST_PAUSE_S, _LONGEST_PAUSE_S, _CLOSE_S, _CHECK_S = 0.1, 0.5, 0.5, 10.0, 2.0, 30.0


class Ros2Missing(ImportError):
    """This Python can't speak ROS 2; the text is ``what is wrong; what would be right``."""


def check_rclpy() -> None:
    """Import ``rclpy`` and the messages.  Raises :class:`Ros2Missing`."""
    found = importlib.util.find_spec("rclpy")
    if found is None or found.origin is None:
        raise Ros2Missing(f"needs rclpy, which {sys.executable} doesn't have; {_GET}")
    folder = Path(found.origin).parent
    built = sorted(path.name for path in folder.glob("_rclpy_pybind11.*.so"))
    if built and f"_rclpy_pybind11{importlib.machinery.EXTENSION_SUFFIXES[0]}" not in built:
        wrong = f"the rclpy in {folder} is of another Python ({built[0]}), this one is {sys.version_info.major}."
        raise Ros2Missing(f"{wrong}{sys.version_info.minor}; that Python, or {_GET}")
    if name := os.environ.get("RMW_IMPLEMENTATION"):
        # ROS ends a process that loads another middleware than this variable names: it is tried in one for that.
        tried = [sys.executable, "-c", "import rclpy; rclpy.get_rmw_implementation_identifier()"]
        if subprocess.run(tried, capture_output=True, timeout=_CHECK_S, check=False).returncode:
            raise Ros2Missing(f"RMW_IMPLEMENTATION is {name}, which this rclpy can't load; one that it has, or none")
    for package in _PACKAGES:
        try:
            importlib.import_module(package)
        except Exception as error:
            raise Ros2Missing(f"{package} can't be imported ({one_line(error):.200}); {_GET}") from error


def domain_of(domain_id: int | None) -> int:
    """The domain as configured, else of the environment.  Raises :class:`Ros2Missing` for one that can't be."""
    text = str(domain_id) if domain_id is not None else os.environ.get("ROS_DOMAIN_ID") or "0"
    if not text.isdecimal() or int(text) > _MOST_DOMAIN_ID:
        raise Ros2Missing(f"ROS_DOMAIN_ID is {text:.40}; 0 to {_MOST_DOMAIN_ID}")
    return int(text)


class RosNode:
    """A node in a thread that opens it, handles its callbacks and, after any fault, opens it again after a pause.

    It has a context of its own, and takes no signals: several domains in one process don't know of each other.
    """

    def __init__(
        self, name: str, namespace: str, domain_id: int | None, set_up: _Handle, tend: _Handle = lambda _: None
    ) -> None:
        """``set_up(node)`` declares its topics and services; ``tend(node)`` is called twice a second.  Both are called
        in the thread, as all callbacks are.
        """
        self.domain_id = domain_of(domain_id)
        self._name, self._namespace = name, namespace
        self._set_up, self._tend = set_up, tend
        self._closed = threading.Event()
        self._failed: Exception | None = None
        self._fault = ""
        self._thread = threading.Thread(target=self._run, name=f"ros2 {name}", daemon=True)
        self._thread.start()

    def fault(self) -> str:
        """Why there is no node at present, in a few words for a person; empty if there is."""
        return self._fault

    def failed(self, error: Exception) -> None:
        """Have it opened again, since using it failed."""
        self._failed = error

    def close(self) -> None:
        """Leave the graph.  Calling it twice does nothing more."""
        self._closed.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(_CLOSE_S)

    def _run(self) -> None:
        pause_s = _FIRST_PAUSE_S
        while not self._closed.is_set():
            try:
                with self._opened() as (node, executor):
                    self._failed = None
                    self._set_up(node)
                    self._fault, pause_s = "", _FIRST_PAUSE_S
                    self._spin(node, executor)
            except Exception as error:  # noqa: BLE001  whatever the middleware does, the monitor goes on
                fault = f"ROS 2 fails: {one_line(error):.200}"
                if fault != self._fault:
                    _log.error("%s", fault)
                    _log.debug("ROS 2 node %s", self._name, exc_info=error)
                self._fault = fault
                self._closed.wait(pause_s)
                pause_s = min(2.0 * pause_s, _LONGEST_PAUSE_S)

    def _spin(self, node: Any, executor: Any) -> None:
        next_s = 0.0
        while not self._closed.is_set():
            if (now_s := time.monotonic()) >= next_s:
                next_s = now_s + _TEND_S
                self._tend(node)
            executor.spin_once(timeout_sec=_SPIN_S)
            if self._failed is not None:
                error, self._failed = self._failed, None
                raise error

    @contextlib.contextmanager
    def _opened(self) -> Iterator[tuple[Any, Any]]:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.signals import SignalHandlerOptions

        with contextlib.ExitStack() as opened:
            context = rclpy.Context()
            rclpy.init(
                args=[], context=context, domain_id=self.domain_id, signal_handler_options=SignalHandlerOptions.NO
            )
            opened.callback(rclpy.try_shutdown, context=context)
            node = rclpy.create_node(
                self._name, context=context, namespace=self._namespace, enable_rosout=False,
                start_parameter_services=False, use_global_arguments=False,
            )  # fmt: skip
            opened.callback(node.destroy_node)
            executor = SingleThreadedExecutor(context=context)
            executor.add_node(node)
            opened.callback(executor.shutdown, timeout_sec=_CLOSE_S)
            yield node, executor
