"""Teaching a robot that has no configuration yet, or only one: from files to a session, from a session to a
configuration that runs.  It stands here because it knows configurations, which the room ``teach`` does not.
"""

from gripmon.daemon.teaching.inputs import Inputs, Named, live_settings, outline_session, read_inputs, read_rough
from gripmon.daemon.teaching.saving import FileSaving
from gripmon.daemon.teaching.written import name_taught

__all__ = [
    "FileSaving",
    "Inputs",
    "Named",
    "live_settings",
    "name_taught",
    "outline_session",
    "read_inputs",
    "read_rough",
]
