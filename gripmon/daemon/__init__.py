"""From a configuration to a running monitor.

:mod:`~gripmon.daemon.config` reads a configuration, :mod:`~gripmon.daemon.api` makes a monitor and a source of frames
from it, :mod:`~gripmon.daemon.starting` opens all that it names, :mod:`~gripmon.daemon.running` runs the supervised
loop.
Nothing is imported here: reading a configuration needs neither Zenoh nor rerun.
"""
