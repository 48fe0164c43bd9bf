"""Openings that a robot reports, kept by their times: of messages on Zenoh, and of ROS 2's joint states."""

from __future__ import annotations

import bisect
import threading
import time
from typing import NamedTuple

from gripmon.model.jaw import JawError, opening_between

LARGEST_OPENING_M = 0.5
"""Largest opening that a gripper file allows, m."""

BEYOND_TRAVEL_M = 1e-3
"""How far a reported opening may lie beyond the gripper's travel, m; the monitor rejects frames with more."""

MOST_REPORTS = 2048
"""Number of reports kept, for images older than the newest report: two seconds at 1 kHz."""


class ReportedOpening(NamedTuple):
    """An opening, and when the robot measured it (Unix ns; 0 if unknown)."""

    stamp_ns: int
    opening_m: float


class StampedOpenings:
    """Reports in order of their stamps, for interpolating the opening at a given time."""

    def __init__(self) -> None:
        self._reports: list[tuple[ReportedOpening, float]] = []

    def __len__(self) -> int:
        return len(self._reports)

    def add(self, report: ReportedOpening, arrival_s: float, max_age_s: float) -> None:
        """Keep a report; drop those that arrived more than ``max_age_s`` before it (``arrival_s``: monotonic), and all
        reports if the robot's clock was set back by more than that.
        """
        reports = self._reports
        if reports and 1e-9 * (reports[-1][0].stamp_ns - report.stamp_ns) > max_age_s:
            reports.clear()
        while reports and (len(reports) >= MOST_REPORTS or arrival_s - reports[0][1] > max_age_s):
            del reports[0]
        bisect.insort(reports, (report, arrival_s), key=lambda kept: kept[0].stamp_ns)

    def clear(self) -> None:
        self._reports.clear()

    def apart_s(self, stamp_ns: int) -> float:
        """Stamp of the newest report minus ``stamp_ns``, s."""
        return 1e-9 * (self._reports[-1][0].stamp_ns - stamp_ns)

    def at(self, stamp_ns: int) -> float:
        """The opening (m), interpolated linearly between the reports before and after; outside all reports, the opening
        of the nearest one (no extrapolation).
        """
        after = bisect.bisect_left(self._reports, stamp_ns, key=lambda kept: kept[0].stamp_ns)
        if after in (0, len(self._reports)):
            return self._reports[min(after, len(self._reports) - 1)][0].opening_m
        (first, _), (last, _) = self._reports[after - 1 : after + 1]
        return opening_between((first.stamp_ns, first.opening_m), (last.stamp_ns, last.opening_m), stamp_ns)


class Openings:
    """What a robot reports: interpolated at an image's stamp if the reports have stamps of the same clock, else the
    newest.

    Age counts from arrival, so that the robot's clock need not agree with ours.  One thread takes what arrives; any
    thread may read.
    """

    def __init__(self, travel_m: tuple[float, float], max_age_s: float) -> None:
        """``travel_m``: smallest and largest opening; a report that came ``max_age_s`` ago or earlier is not used."""
        self._travel_m = travel_m
        self._max_age_s = max_age_s
        self._lock = threading.Lock()  # guards the attributes below against the thread that takes
        self._newest_m: float | None = None
        self._arrival_s = 0.0
        self._stamped = StampedOpenings()
        self._apart_s: float | None = None  # reports' stamps minus the images', if their clocks differ

    def take(self, reported: ReportedOpening) -> None:
        """Keep a report that has just arrived.  Raises :class:`JawError` for an opening that the gripper can't have."""
        arrival_s = time.monotonic()
        low_m, high_m = self._travel_m
        # Written so that NaN fails as well.
        if not low_m - BEYOND_TRAVEL_M <= reported.opening_m <= high_m + BEYOND_TRAVEL_M:
            raise JawError(f"opening {reported.opening_m:g} m; {low_m:g} to {high_m:g} m as the gripper file says")
        with self._lock:
            self._newest_m, self._arrival_s = reported.opening_m, arrival_s
            if reported.stamp_ns > 0:
                self._stamped.add(reported, arrival_s, self._max_age_s)
            else:
                self._stamped.clear()  # a robot stamps either all its reports or none

    def opening_m(self, stamp_ns: int | None = None) -> float | None:
        """The opening at an image's stamp, or the newest (m); None if none arrived in time.

        Stamps farther apart than that come from different clocks: it then returns the newest; :meth:`fault` says so.
        """
        with self._lock:
            if self._newest_m is None or self._is_old():
                return None
            self._apart_s = None
            if stamp_ns is None or not len(self._stamped):
                return self._newest_m
            apart_s = self._stamped.apart_s(stamp_ns)
            if abs(apart_s) > self._max_age_s:
                self._apart_s = apart_s
                return self._newest_m
            return self._stamped.at(stamp_ns)

    def fault(self) -> str:
        """What is missing or strange, in a few words for a person; empty if nothing is."""
        with self._lock:
            if self._newest_m is None:
                return "no jaw opening received"
            if self._is_old():
                return f"no jaw opening for {self._max_age_s:g} s or longer"
            if self._apart_s is None:
                return ""
            when = "later" if self._apart_s > 0.0 else "earlier"
            return f"jaw openings have stamps {abs(self._apart_s):.3g} s {when} than the images: the newest is taken"

    def _is_old(self) -> bool:
        return time.monotonic() - self._arrival_s > self._max_age_s
