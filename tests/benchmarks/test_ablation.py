"""Switching rules off reaches every module that holds the constant; the comparison is paired."""

import sys
import types

import pytest

from benchmarks import ablation


@pytest.fixture
def modules(monkeypatch):
    """A constant's own module, and one that imported it by name."""
    limit = 12.5
    for name in ("diagnosis.one_", "diagnosis.two_"):
        module = types.ModuleType(name)
        module.LIMIT_ = limit
        monkeypatch.setitem(sys.modules, name, module)
    return sys.modules["diagnosis.one_"], sys.modules["diagnosis.two_"]


def test_a_constant_changes_wherever_it_was_imported(modules):
    ablation.switch_off({"diagnosis.one_:LIMIT_": 0.0})
    assert [module.LIMIT_ for module in modules] == [0.0, 0.0]


def test_a_constant_that_is_not_there_is_told(modules):
    with pytest.raises(ablation.UnknownConstant, match="diagnosis.one_:GONE"):
        ablation.switch_off({"diagnosis.one_:GONE": 1})


def test_every_rule_names_constants_that_exist():
    for constants in ablation.RULES.values():
        ablation.switch_off({})
        for address in constants:
            module, name = address.split(":")
            assert hasattr(sys.modules[module], name), address


def row(trial, strict, prediction, false=0):
    counts = {"trial": trial, "strict": strict, "false": false, "found": strict, "needed": 1}
    return counts | {"prediction": prediction, "seconds": "2.0"}


def test_trials_are_compared_pair_by_pair():
    whole = [row(1, 1, "0.5"), row(2, 0, "0.8"), row(3, 1, "0.5")]
    without = [row(2, 1, "0.4"), row(1, 0, "1.2", false=2)]
    got = ablation.compare(ablation.WHOLE, without, whole)
    assert (got["trials"], got["lost"], got["won"], got["false"], got["worse"]) == (2, 1, 1, 2, 1)
    assert float(got["error"]) == pytest.approx((1.2 / 0.5 * 0.4 / 0.8) ** 0.5, abs=1e-3)
