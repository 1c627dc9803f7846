"""The example that the pages of these tests show."""

import pytest
from report_example import example


@pytest.fixture
def diagnosis():
    """A diagnosis as the estimator makes them, numbers made up."""
    return example()


@pytest.fixture
def matched(diagnosis):
    diagnosis.summary = {**diagnosis.summary, "verdict": "match", "findings": [], "warnings": []}
    diagnosis.settings = {}
    return diagnosis
