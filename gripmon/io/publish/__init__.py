"""What the monitor publishes on the network, and the robot's messages that it subscribes to there.

Keys, all below ``gripmon/<robot>/<camera>``, payloads JSON of the records (:mod:`gripmon.model.records`):

``transform``  every frame; express, real-time priority, dropped on a congested link; a ``get`` returns the last one
``state``      once a second and on every change; late joiners get the last one
``reference``  on every new revision; late joiners get the last one
``alert``      when there is one; an advanced subscriber with history gets the last 32
``alive``      liveliness token, vanishes with the process; ``alive/<id>`` another one, for this start of the process
``jaw``        read, not written: ``{"stamp_ns": …, "opening_m": …}`` from the robot
``cmd/<name>`` queryable: an operator's commands, see :mod:`gripmon.io.publish.commands`

Late joiners get the last one in two ways: by a plain ``get`` on the key (answered by a queryable), and by an advanced
subscriber with history (``zenoh.ext``).
"""
