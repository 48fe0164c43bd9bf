"""After a failed shift: when did the camera move, how far, what touched it, and what is affected?

:func:`build` makes of recordings what is to be said (:class:`Report`, SI units); :func:`page` shows it to people.
"""

from __future__ import annotations

from gripmon.analyse.report.build import Told, build
from gripmon.analyse.report.content import RecordingReport, Report

__all__ = ["RecordingReport", "Report", "Told", "build"]
