"""Classes: what takes a finding's place, what is told beside it, and what is neither."""

from types import SimpleNamespace

import numpy as np
import pytest

from diagnosis.selection import rivals
from diagnosis.selection.criterion import PRICE, Score


class Named:
    """As much of a Candidate as the choice looks at."""

    def __init__(self, name, units):
        self.name = name
        overrides = {"overrides": lambda what: False}
        self.effect = SimpleNamespace(simplicity=units - 1, name=name, numerical=False, **overrides)
        self.parameters = (None,)


DRY, CURVED = Named("coulomb", 1), Named("stribeck", 4)


def chosen(monkeypatch, fitted, losses):
    """(setting's names, {name: names of others}) after classes; losses: {name: unpriced loss} of
    sets of one effect."""
    names = {c.name: c for c in (DRY, CURVED)}

    class Judge:
        def fit(self, setting, steps=0, near=None):
            (c,) = setting
            units = c.effect.simplicity + 1
            loss = losses[c.name]
            groups = loss + np.linspace(-1e-6, 1e-6, 4) * units  # no chance at all
            score = Score(loss, groups, 4 * groups, ())
            each = {"setting": setting, "score": score, "loss": loss + PRICE * units}
            return SimpleNamespace(**each, settled=True)

    others = [(c, (1.0,)) for c in names.values() if c.name != fitted]
    monkeypatch.setattr(rivals, "_alike", lambda *args: others)
    silent = SimpleNamespace(scores=lambda *settings: None, chain=SimpleNamespace(world=None))
    monkeypatch.setattr(rivals, "_near", lambda *args: [])
    monkeypatch.setattr(rivals, "MissingForce", lambda *args: silent)
    monkeypatch.setattr(rivals, "_late", lambda *args: [])
    start = Judge().fit({names[fitted]: (2.0,)})
    found, told = rivals.classes([DRY, CURVED], Judge(), silent, start, None)
    return [c.name for c in found.setting], {
        c.name: [o.name for o, _ in each] for c, each in told.items()
    }


@pytest.mark.parametrize(
    "fitted, losses, name, others",
    [
        # three units more, at 0.1 nats each, for less than that
        ("stribeck", {"stribeck": 0.0, "coulomb": 0.2}, "coulomb", ["stribeck"]),
        ("stribeck", {"stribeck": 0.0, "coulomb": 0.4}, "stribeck", []),
        ("coulomb", {"stribeck": 0.0, "coulomb": 0.6}, "stribeck", []),
        ("coulomb", {"stribeck": 0.0, "coulomb": 0.35}, "coulomb", ["stribeck"]),
        ("coulomb", {"stribeck": 0.05, "coulomb": 0.0}, "coulomb", ["stribeck"]),
        ("coulomb", {"stribeck": 0.2, "coulomb": 0.0}, "coulomb", []),
    ],
)
def test_the_best_for_its_price_stands_and_what_predicts_as_well_is_told(
    monkeypatch, fitted, losses, name, others
):
    found, told = chosen(monkeypatch, fitted, losses)
    assert found == [name] and told[name] == others


def test_the_same_effect_in_a_like_place_is_tried_at_the_findings_own_value(monkeypatch):
    """Two geoms of one contact share its numbers."""
    foot, ground, elsewhere, other = (Named(n, 1) for n in ("foot", "ground", "else", "other"))
    ground.effect = elsewhere.effect = foot.effect
    foot.nominal = ground.nominal = (100.0,)
    elsewhere.nominal = other.nominal = (50.0,)
    begun = []
    judge = SimpleNamespace(
        fit=lambda setting, **how: begun.append(setting) or SimpleNamespace(settled=False)
    )
    monkeypatch.setattr(rivals, "_alike", lambda *args: [(other, (5.0,)), (ground, (362.0,))])
    monkeypatch.setattr(rivals, "_near", lambda *args: [ground, elsewhere, other])
    monkeypatch.setattr(rivals, "MissingForce", lambda *args: None)
    before = SimpleNamespace(chain=SimpleNamespace(world=None))
    fitted = SimpleNamespace(setting={foot: (220.0,)})
    rivals._members([], judge, before, fitted, foot)
    assert begun == [{ground: (220.0,)}, {other: (5.0,)}]
