"""What the monitor publishes on the network, and the robot's messages that it subscribes to there.

Keys, all below ``gripmon/<robot>/<camera>``, payloads JSON of the records (:mod:`gripmon.model.records`):

``transform``  every frame; express, real-time priority, dropped rather than waited for when a link is congested; a
               ``get`` brings the last one
``state``      once a second and on every change; late joiners get the last one
``reference``  on every new revision; late joiners get the last one
``alert``      when there is one; an advanced subscriber with history gets the last 32
``alive``      liveliness token, gone as soon as the process is; ``alive/<id>`` another one, of this start alone
``spot``       of a second camera in place of ``transform`` and ``reference``: what became of each pulse of the laser
``pulse``      read, not written: the pulses, from the robot's program
``jaw``        read, not written: ``{"stamp_ns": …, "opening_m": …}`` from the robot
``cmd/<name>`` queryable: what an operator tells the monitor, see :mod:`gripmon.io.publish.commands`

"Late joiners get the last one" holds both ways that people ask: a plain ``get`` on the key (a queryable answers it),
and an advanced subscriber with history (``zenoh.ext``).
"""

from gripmon.model.records import AlertRecord, FrameRecord, ReferenceRecord, SpotRecord, StateRecord


class Publisher:
    """Where a loop puts what it has to say; no method waits for the network.  This one says nothing.

    A wrist camera's loop has transforms and references, a second camera's has spots.
    """

    def transform(self, record: FrameRecord) -> None:
        """One frame's record."""

    def reference(self, record: ReferenceRecord) -> None:
        """The reference that is in force from now on."""

    def spot(self, record: SpotRecord) -> None:
        """What became of a pulse."""

    def state(self, record: StateRecord) -> None:
        """The newest state."""

    def alert(self, record: AlertRecord) -> None:
        """An alert, of a frame or of none."""

    def close(self) -> None:
        """Let go of what is held.  Calling it twice does nothing more."""
