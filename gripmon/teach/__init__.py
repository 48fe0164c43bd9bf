"""Teach a gripper: its model and edges from images, and what to expect of a view.  Programs call
:mod:`gripmon.teach.api`.
"""
