"""From a camera to a running monitor in one project folder, on a page or step by step: ``gripmon setup``."""

from gripmon.daemon.setup.lines import Line
from gripmon.daemon.setup.project import Project
from gripmon.daemon.setup.site import SetupSite
from gripmon.daemon.setup.steps import STEPS

__all__ = ["STEPS", "Line", "Project", "SetupSite"]
