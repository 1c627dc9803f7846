"""What is said of a run: the version of the code that made it."""

from training.run_folder import statements

CODE = '''
"""A module."""
RATE = 0.5  # a comment

def step(x):
    """A docstring."""
    return x * RATE + 1.0
'''


def test_layout_comments_and_docstrings_are_no_other_version():
    other = "RATE = (\n    0.5\n)\ndef step(x):\n    return (\n        x * RATE\n        + 1.0)\n"
    assert statements(CODE) == statements(other)


def test_a_changed_number_is_another_version():
    assert statements(CODE) != statements(CODE.replace("0.5", "0.6"))
    assert statements(CODE) != statements(CODE.replace("* RATE", "/ RATE"))
