"""python -m diagnosis: the same as diagnose.py and rgat-diagnose."""

import sys

from diagnosis.command import main

if __name__ == "__main__":
    sys.exit(main())
