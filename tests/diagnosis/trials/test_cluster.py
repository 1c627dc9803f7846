"""Trials on a Ray cluster of two nodes, one of which is killed half-way. Skipped without ray."""

import shutil
import time
from pathlib import Path

import pytest

ray = pytest.importorskip("ray")
cluster_utils = pytest.importorskip("ray.cluster_utils")

from diagnosis.trials import table  # noqa: E402
