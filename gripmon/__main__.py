"""``python -m gripmon``."""

import sys

from gripmon.cli import main

if __name__ == "__main__":
    sys.exit(main())
