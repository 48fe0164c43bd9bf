"""The laser pointer: calibrating a second camera and watching it."""
