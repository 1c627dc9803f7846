"""Where does a simulator differ from recordings of the real system? See diagnosis/command.py.

python diagnose.py --model sim.xml --recordings real/*.csv --out report/
"""

import sys

from diagnosis.command import main

if __name__ == "__main__":
    sys.exit(main())
