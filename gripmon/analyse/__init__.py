"""Recordings analysed afterwards: the report and the off-line smoother.  Programs call :mod:`gripmon.analyse.api`."""
