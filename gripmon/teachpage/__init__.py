"""A web page on this machine alone on which a person teaches a gripper: corners dragged onto the fingertips."""

from gripmon.teachpage.desk import Desk, Picture, Saving, SavingRefused
from gripmon.teachpage.messages import Saved, SaveOrder
from gripmon.teachpage.rough_desk import RoughDesk
from gripmon.teachpage.server import PageServer

__all__ = ["Desk", "PageServer", "Picture", "RoughDesk", "SaveOrder", "Saved", "Saving", "SavingRefused"]
