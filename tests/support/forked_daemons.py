"""``gripmon run`` again and again without starting Python each time: CONFIG.

Everything is imported once; each line on stdin forks a process that runs the command.  Its number is printed when it
has been forked, "ended" when it is gone.
"""

from __future__ import annotations

import os
import sys

from gripmon.cli import main

if __name__ == "__main__":
    config = sys.argv[1]
    import cv2

    cv2.setNumThreads(1)
    for _ in sys.stdin:
        pid = os.fork()
        if pid == 0:
            os._exit(main(["run", config]))
        print(pid, flush=True)
        os.waitpid(pid, 0)
        print("ended", flush=True)
