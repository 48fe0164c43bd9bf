"""gripmon of another commit beside this checkout's, to be measured with the same benchmark."""

from __future__ import annotations

import io
import os
import subprocess
import tarfile
from pathlib import Path

from benchmarks.machine import ROOT

_KEPT = ROOT / "build" / "revisions"


def commit_of(revision: str) -> str:
    """Its full hash.  Raises ValueError for none."""
    asked = ["git", "rev-parse", "--verify", "--quiet", f"{revision}^{{commit}}"]
    found = subprocess.run(asked, cwd=ROOT, capture_output=True, text=True, check=False)
    if found.returncode != 0:
        raise ValueError(f"{revision} is no commit of this checkout; a hash, a branch or a tag")
    return found.stdout.strip()


def package_of(revision: str) -> Path:
    """A folder in which ``gripmon`` is as it was; kept, since its compiled code is kept beside it."""
    commit = commit_of(revision)
    folder = _KEPT / commit
    if not folder.exists():
        packed = subprocess.run(["git", "archive", commit, "gripmon"], cwd=ROOT, capture_output=True, check=True).stdout
        unpacked = _KEPT / f"{commit}.{os.getpid()}"
        with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
            archive.extractall(unpacked, filter="data")
        unpacked.rename(folder)
    return folder


def environment(package: Path) -> dict[str, str]:
    """For a process of ``python -P`` whose gripmon is in this folder, and whose benchmarks are these."""
    return {**os.environ, "PYTHONPATH": f"{package}{os.pathsep}{ROOT / 'tools'}"}
