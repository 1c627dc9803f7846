"""Locate, name, model and show what a simulator lacks.

from diagnosis import diagnose
diagnosis = diagnose("sim.xml", ["run1.csv", "run2.csv"])
"""

__all__ = ["ModelError", "diagnose"]


def __getattr__(name: str):
    # On first use: train.py needs no more of this package than its way to write files.
    if name in __all__:
        from diagnosis import command

        return getattr(command, name)
    raise AttributeError(f"module 'diagnosis' has no attribute {name!r}")
