"""What is said of a run: the version of the code that made it."""

import shutil

from training import run_folder
from training.experiments import version
from training.run_folder import statements, versions

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


def test_the_diagnosis_is_part_of_a_run_that_it_grounds_alone(tmp_path, monkeypatch):
    for name in ("envs", "models", "trpo", "rgat", "train", "training/physics_grounding"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(run_folder.Path(run_folder.__file__).parents[1] / f"{name}.py", tmp_path / name)
        (tmp_path / name).rename(tmp_path / f"{name}.py")
    (tmp_path / "diagnosis").mkdir()
    (tmp_path / "diagnosis" / "rule.py").write_text("LIMIT = 1")
    monkeypatch.setattr(run_folder, "__file__", str(tmp_path / "training" / "run_folder.py"))
    physics, rgat, rows = versions({"algo": "physics+rgat"}), versions({"algo": "rgat"}), version()
    (tmp_path / "diagnosis" / "rule.py").write_text("LIMIT = 2")
    assert versions({"algo": "physics+rgat"}) != physics
    assert versions({"algo": "rgat"}) == rgat and version() == rows
