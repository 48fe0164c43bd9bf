"""What the monitor says on the network, and the jaw opening that it hears there.

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
