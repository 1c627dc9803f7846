"""Libraries that only one format needs: imported where that format is read."""

import importlib

from diagnosis.recordings.columns import RecordingError


def library(path: str, module: str, extra: str, what: str):
    """The module. Raises RecordingError, which names the extra that brings it, where it is not
    installed."""
    try:
        return importlib.import_module(module)
    except ImportError:
        raise RecordingError(
            f"{path}: {what}, which needs the extra [{extra}]: pip install '.[{extra}]' where "
            f"this program lies, or "
            f"pip install {module.split('.')[0]}"
        ) from None
