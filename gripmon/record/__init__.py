"""Recordings: written, read back, exported."""
