"""The beam on made columns: which sets it meets."""

from types import SimpleNamespace

import numpy as np
import pytest
from synthetic import clustered, evidence_of, scene

from diagnosis.effects.unmodelled import Unknown
from diagnosis.selection import beam as beam_module
from diagnosis.selection.beam import LEAST, Beam
from diagnosis.selection.columns import Option
from diagnosis.selection.plausibility import Prior


class Named:
    """As much of a Candidate as a beam reads."""

    def __init__(self, name):
        self.name, self.parameters, self.nominal = name, (None,), (0.0,)
        possible = lambda values, nominal: True
        self.when, self.lasting = None, self
        self.effect = SimpleNamespace(name=name, simplicity=0, possible=possible, bounds=False)


def test_two_that_explain_all_are_met_beside_many_that_each_lower_squares_more():
    rng, ahead = np.random.default_rng(0), scene()
    strong, weak, wrong = (clustered(rng, ahead, share=0.0) for _ in range(3))
    weak *= np.where(np.arange(16) % 2 == 0, 0.04, 0.4)[ahead.group][:, None, None]
    residual = strong + weak
    named = [("strong", strong), ("weak", weak)]
    named += [(f"near {k // 3}", residual + 0.22 * wrong) for k in range(12)]  # starts of four
    named += [(f"rough {k}", residual + 0.24 * wrong) for k in range(4)]
    columns = np.stack([column for _, column in named], -1)
    every = {name: Named(name) for name, _ in named}
    vague = Prior(np.zeros(1), np.full(1, np.inf), np.full(1, -9.0), np.full(1, 9.0))
    bounds = np.full(1, -9.0), np.full(1, 9.0)
    options = [
        Option(every[name], np.zeros(1), np.ones((1, 1)), *bounds, vague, columns=(k,))
        for k, (name, _) in enumerate(named)
    ]
    evidence = evidence_of(ahead, residual, columns)
    beam = Beam(SimpleNamespace(options=options, setting={}), evidence)
    start, nodes = beam.nodes()
    gains = beam.gains(start)
    # a look at squares leaves them out
    assert max(gains[0], gains[1]) < min(gains[k] for k in gains if k > 1)
    met = [{options[k].candidate.name for k in node.options} for node in nodes]
    assert met[0] == {"strong", "weak"}


def test_a_curve_is_met_alone_and_not_beside_others():
    rng, ahead = np.random.default_rng(1), scene()
    first, second = (clustered(rng, ahead, share=0.0) for _ in range(2))
    curve, name = Named("curve"), Named("name")
    curve.effect = Unknown("time", (0.0, 1.0))
    columns = np.stack([first, second], -1)
    vague = Prior(np.zeros(1), np.full(1, np.inf), np.full(1, -9.0), np.full(1, 9.0))
    bounds = np.full(1, -9.0), np.full(1, 9.0)
    options = [
        Option(c, np.zeros(1), np.ones((1, 1)), *bounds, vague, columns=(k,))
        for k, c in enumerate((curve, name))
    ]
    noise = 0.1 * clustered(rng, ahead, share=0.0)
    beam = Beam(
        SimpleNamespace(options=options, setting={}),
        evidence_of(ahead, 5 * first + 0.01 * second + noise, columns),
    )
    met = {frozenset(options[k].candidate.name for k in n.options) for n in beam.nodes()[1]}
    assert met == {frozenset(), frozenset({"curve"}), frozenset({"name"})}


def made(named, residual, ahead, prices=(), inside=()):
    """A Beam over columns {name: column}, with what each is more than a first thing to think of;
    inside: names of effects of the model, each at 1."""
    rows = enumerate(named)
    vague = Prior(np.zeros(1), np.full(1, np.inf), np.full(1, -9.0), np.full(1, 9.0))
    bounds = np.full(1, -9.0), np.full(1, 9.0)
    base = lambda name: np.full(1, 1.0 if name in inside else 0.0)
    options = [
        Option(Named(n), base(n), np.ones((1, 1)), *bounds, vague, columns=(k,)) for k, n in rows
    ]
    setting = {o.candidate: (1.0,) for o in options if o.candidate.name in inside}
    for option, simplicity in zip(options, prices):
        option.candidate.effect.simplicity = simplicity
    columns = np.stack(list(named.values()), -1)
    given = SimpleNamespace(options=options, setting=setting)
    beam = Beam(given, evidence_of(ahead, residual, columns))
    return beam, lambda node: {options[k].candidate.name for k in node.options}


def test_two_that_make_up_for_each_other_are_met_where_neither_is_better_alone():
    """As friction and a damping that was fitted without it."""
    rng, ahead = np.random.default_rng(2), scene()
    one, other, rest = (clustered(rng, ahead, share=0.0) for _ in range(3))
    two = one + 0.05 * other
    beam, names = made({"one": one, "two": two}, one - two + 0.001 * rest, ahead)
    start, nodes = beam.nodes()
    alone = [node for node in nodes if len(node.options) == 1]
    assert min(node.unpriced for node in alone) > start.unpriced - LEAST
    assert names(nodes[0]) == {"one", "two"}


def test_they_are_met_where_others_that_are_better_alone_fill_the_beam(monkeypatch):
    monkeypatch.setattr(beam_module, "WIDTH", 1)
    monkeypatch.setattr(beam_module, "LOOKS", 1)
    rng, ahead = np.random.default_rng(2), scene()
    one, other, rest = (clustered(rng, ahead, share=0.0) for _ in range(3))
    two = one + 0.05 * other
    named = {"one": one, "two": two, "rest": rest}
    beam, names = made(named, one - two + 0.02 * rest, ahead)
    start, nodes = beam.nodes()
    alone = {next(iter(names(n))): n.unpriced for n in nodes if len(n.options) == 1}
    assert min(alone, key=alone.get) == "rest"
    assert names(nodes[0]) >= {"one", "two"}


def test_of_options_that_promise_the_same_the_simplest_is_tried_first(monkeypatch):
    monkeypatch.setattr(beam_module, "LOOKS", 1)
    rng, ahead = np.random.default_rng(3), scene()
    first, second = (clustered(rng, ahead, share=0.0) for _ in range(2))
    named = {"first": first, "far": second, "near": 1.0 * second}
    beam, names = made(named, first + 0.5 * second, ahead, prices=(0, 2, 1))
    node = beam.node((0,))
    assert [beam.columns.options[k].candidate.name for _, k in beam._looks(node)] == ["near"]


def test_sets_are_met_without_what_is_left_out():
    rng, ahead = np.random.default_rng(4), scene()
    first, second, rest = (clustered(rng, ahead, share=0.0) for _ in range(3))
    named = {"first": first, "second": second, "both": first + second + 0.3 * rest}
    beam, names = made(named, first + second + 0.01 * rest, ahead)
    assert "first" in names(beam.nodes()[1][0])
    beam.leave({beam.columns.options[0].candidate})
    start, nodes = beam.nodes()
    assert not any("first" in names(node) for node in nodes) and "both" in names(nodes[0])


@pytest.mark.parametrize("limit", [False, "that there was not", "that there was"])
def test_what_made_up_for_an_effect_goes_when_that_joins(limit):
    """But for a limit, of whose absence columns tell nothing."""
    rng, ahead = np.random.default_rng(6), scene()
    true, other, rest = (clustered(rng, ahead, share=0.0) for _ in range(3))
    mimic = 0.5 * true + 0.5 * other
    named = {"mimic": mimic, "true": true}
    beam, names = made(named, true - mimic + 0.01 * rest, ahead, inside=["mimic"])
    if limit:
        candidate = beam.columns.options[0].candidate
        if limit == "that there was":
            candidate.effect.bounds = True
        else:
            candidate.nominal = (np.inf,)
        beam = Beam(beam.columns, beam.evidence)
    start, nodes = beam.nodes()
    assert names(start) == {"mimic"}
    assert names(nodes[0]) == ({"mimic", "true"} if limit else {"true"})
    setting = {c.name: values for c, values in beam.setting(nodes[0]).items()}
    assert setting.keys() == names(nodes[0])
    assert setting["true"] == pytest.approx((1.0,), rel=0.05)
    if not limit:  # a further look is taken at what is left without it
        assert beam.gains(nodes[0]).keys() <= {0}
