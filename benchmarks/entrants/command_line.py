"""The words that every entrant is called with. Without mujoco, so that whoever only starts another
program pays nothing for it.
"""

import argparse
from pathlib import Path


def words(what, **first):
    """The command line MODEL RECORDINGS… OUT as a namespace, behind a word of its own where one is
    given: its name, and the options of add_argument."""
    parser = argparse.ArgumentParser(description=what)
    for name, options in first.items():
        parser.add_argument(name, **options)
    parser.add_argument("model", type=Path, help="the simulator, MJCF")
    parser.add_argument("recordings", type=Path, nargs="+", help="CSV files of the contract")
    parser.add_argument("out", type=Path, help="folder for diagnosis.json and what corrects")
    return parser.parse_args()
