"""Teaching a robot that has no configuration yet, or only one: from files to a session, from a session to a
configuration that runs.  It is here because it needs configurations, which the package ``teach`` doesn't know.
"""

from gripmon.daemon.teaching.inputs import Inputs, outline_page, read_inputs
from gripmon.daemon.teaching.saving import FileSaving, page_session, teach_from_file
from gripmon.daemon.teaching.words import in_words

__all__ = [
    "FileSaving",
    "Inputs",
    "in_words",
    "outline_page",
    "page_session",
    "read_inputs",
    "teach_from_file",
]
