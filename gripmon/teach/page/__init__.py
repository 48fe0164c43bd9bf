"""A web page on this machine alone on which a person teaches a gripper: corners dragged onto the fingertips."""

from gripmon.teach.edges.files import Picture
from gripmon.teach.page.desk import Desk, Saving, SavingRefused
from gripmon.teach.page.messages import Saved, SaveOrder
from gripmon.teach.page.rough_desk import RoughDesk
from gripmon.teach.page.server import PageServer

__all__ = ["Desk", "PageServer", "Picture", "RoughDesk", "SaveOrder", "Saved", "Saving", "SavingRefused"]
