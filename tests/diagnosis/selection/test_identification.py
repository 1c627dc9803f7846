"""The rules of a round: which curves compete, and which set is chosen."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from arm import ARM

from diagnosis.selection import identification, moments
from diagnosis.selection.criterion import PRICE, Comparison, Score
from diagnosis.selection.identification import Identification
from diagnosis.selection.judge import changing
from diagnosis.selection.missing_force import Dependence
from diagnosis.simulation.simulator import World


@pytest.fixture
def search():
    world = World(mujoco.MjSpec.from_string(ARM))
    found = Identification(world, [])
    found.trajectory, found.looked = None, 40.0
    return found


def curves_of(search, monkeypatch, setting):
    """Variables of the curves that compete beside a setting, of four that were located."""
    four = [
        ("elbow", ("velocity:elbow",)),
        ("elbow", ("position:shoulder",)),
        ("elbow", ("time", "velocity:elbow")),
        ("shoulder", ("position:shoulder",)),
    ]
    located = [Dependence(joint, told, 0.9, (joint, told), ()) for joint, told in four]
    monkeypatch.setattr(moments, "dependences", lambda *args: located)
    return [candidate for candidate, _ in search._curves(setting)]


def test_curves_compete_but_for_those_over_the_joints_own_speed(search, monkeypatch):
    told = [variables for _, variables in curves_of(search, monkeypatch, {})]
    assert told == [("position:shoulder",), ("time", "velocity:elbow"), ("position:shoulder",)]


def test_beside_a_name_no_curve_of_its_joint_competes(search, monkeypatch):
    friction = search.world.candidate("coulomb_friction", "elbow")
    left = curves_of(search, monkeypatch, {friction: (0.1,)})
    assert [joint for joint, _ in left] == ["shoulder"]


def fitted(search, names, loss, settled=True):
    """A Fitted of effects in the elbow with a loss that every group shares but for a little."""
    groups = loss + 1e-3 * np.arange(16)
    setting = {search.world.candidate(name, "elbow"): () for name in names}
    score = Score(groups.mean(), groups, 3 * groups, ())
    whole = score.loss + PRICE * identification.complexity(setting)
    return SimpleNamespace(setting=setting, score=score, loss=whole, settled=settled)


def test_a_set_is_chosen_for_its_worth(search):
    now = fitted(search, [], 0.0)
    friction = fitted(search, ["coulomb_friction"], -1.0)
    both = fitted(search, ["coulomb_friction", "viscous_damping"], -1.05)
    better = fitted(search, ["coulomb_friction", "viscous_damping"], -1.5)
    bound = fitted(search, ["armature"], -3.0, settled=False)
    little = fitted(search, ["coulomb_friction"], -0.05)
    assert search._choose([now, friction, both, bound], now) is friction
    assert search._choose([now, friction, better], now) is better
    assert search._choose([now, little], now) is now  # not worth its price
    for more, chosen in ((0.9, False), (1.1, True)):  # other effects have to be worth a little
        names = ["armature", "viscous_damping"]
        price = fitted(search, names, 0.0).loss
        other = fitted(search, names, friction.loss - price - more * identification.TIED)
        assert search._choose([now, friction, other], now) is (other if chosen else friction)
    chance = fitted(search, ["armature", "coulomb_friction"], -2.0)
    odd = np.where(np.arange(16) % 2, 4.0, -4.0)
    chance.score = Score(chance.score.loss, chance.score.groups + odd, np.zeros(16), ())
    assert search._choose([now, chance, friction], now) is now  # the best is not earned


@pytest.mark.parametrize(
    "loss, settled, takes", [(-1.2, True, 1), (-1.05, True, 0), (-2, False, 0)]
)
def test_a_set_of_an_earlier_round_takes_over_where_it_is_better(
    search, monkeypatch, loss, settled, takes
):
    best = fitted(search, ["coulomb_friction"], -1.0)
    other = fitted(search, ["viscous_damping"], loss, settled)
    monkeypatch.setattr(identification, "carried", lambda *given: [other])
    bare, needed = fitted(search, [], 0.0), fitted(search, ["viscous_damping"], loss)
    monkeypatch.setattr(search, "pruned", lambda judge, some, now: now is bare and needed)
    judge = SimpleNamespace(fit=lambda setting: bare)
    assert search._beside(judge, [best], best, best) is (needed if takes else best)
    assert search.sets == ([other] if loss == -1.05 else [])  # as good, and carried on


@pytest.mark.parametrize("share, kept", [(1.3, True), (0.8, False)])
def test_an_effect_of_a_set_is_one_of_many_that_were_looked_at(search, share, kept, monkeypatch):
    """In 16 groups gains of 1.3 and 0.8 times their scatter have p-values of 1e-4 and 4e-3: the
    second would be no chance if it were looked at alone."""
    both = fitted(search, ["coulomb_friction", "viscous_damping"], -1.0)
    less = fitted(search, ["coulomb_friction"], -1.0)
    groups = both.score.groups + 0.5 * (share + np.where(np.arange(16) % 2, 1.0, -1.0))
    both.score = Score(both.score.loss, both.score.groups, np.zeros(16), ())
    less.score = Score(groups.mean(), groups, np.zeros(16), ())
    less.loss = less.score.loss + PRICE * identification.complexity(less.setting)
    monkeypatch.setattr(search, "_missed_least", lambda fitted: list(fitted.setting)[:1])
    judge = SimpleNamespace(fit=lambda setting, **how: less)
    now = fitted(search, [], 2.0)
    assert search.pruned(judge, both, now) is (both if kept else less)


def test_a_set_is_one_of_all_the_sets_that_were_looked_at(search):
    """Of 40 columns there are 780 pairs."""
    step = Comparison(1.0, 0.05 / 40 / 20)
    assert search.no_chance(step) and not search.no_chance(step, 2)
    groups = 0.53 * np.where(np.arange(16) % 2, 1.0, -1.0)  # p-value 1.2e-3 of a gain of 0.5
    search.looked = 20.0
    now = fitted(search, [], 0.0)
    for names, earned in (["armature"], True), (["armature", "coulomb_friction"], False):
        after = fitted(search, names, 0.0)
        after.score = Score(-0.5, groups - 0.5, np.zeros(16), ())
        after.loss = -0.1
        assert search.earned(now, after) == earned


def test_what_is_earned_only_together_stays(search, monkeypatch):
    """Neither effect is earned beside the other, and neither is over what there was."""
    now = fitted(search, [], 0.0)
    both = fitted(search, ["coulomb_friction", "viscous_damping"], -0.5)
    alone = fitted(search, ["coulomb_friction"], -0.3)
    odd = np.where(np.arange(16) % 2, 0.9, -0.9)
    both.score = Score(both.score.loss, both.score.groups + odd / 100, np.zeros(16), ())
    noisy = alone.score.groups + odd
    alone.score = Score(alone.score.loss, noisy, np.zeros(16), ())
    monkeypatch.setattr(search, "_missed_least", lambda fitted: list(fitted.setting)[:1])
    judge = SimpleNamespace(fit=lambda setting, **how: alone)
    assert search.earned(now, both)
    assert not search.earned(alone, both) and not search.earned(now, alone)
    assert search.pruned(judge, both, now) is both
    assert search.pruned(judge, both, fitted(search, [], 9.0)) is alone


@pytest.mark.parametrize(
    "loss, settled, kept", [(-1.1, True, True), (-0.4, True, False), (-1.1, False, False)]
)
def test_a_refit_with_more_steps_has_to_predict_better_what_is_left_out(
    search, loss, settled, kept
):
    first = fitted(search, ["coulomb_friction"], -1.0)
    more = fitted(search, ["coulomb_friction"], loss, settled)
    other = fitted(search, ["coulomb_friction"], -9.0)
    asked = []
    judge = SimpleNamespace(fit=lambda setting: more, elsewhere=lambda f: asked.append(f) or other)
    assert search.further(judge, first) is other  # and from what is better it looks elsewhere
    assert asked == [more if kept else first]


@pytest.mark.parametrize("loss, kept", [(-1.1, True), (-0.5, False)])
def test_a_finer_time_step_stands_beside_what_was_chosen_where_that_is_better(search, loss, kept):
    first = fitted(search, ["coulomb_friction"], -1.0)
    step, asked = search.world.candidate("time_step", "world"), []
    finer = SimpleNamespace(setting={**first.setting, step: (0.001,)}, loss=loss)
    judge = SimpleNamespace(fit=lambda setting, steps, near: asked.append(setting) or finer)
    assert search.finer(judge, first) is (finer if kept else first)
    assert asked == [{**first.setting, step: (step.nominal[0] / 4,)}]
    assert search.finer(judge, finer) is finer and len(asked) == 1


def node(losses, price, *names):
    """A Node of a beam with these losses of groups; names: indices of its options."""
    groups = np.array(losses, float)
    score = Score(groups.mean(), groups, 3 * groups, ())
    return SimpleNamespace(options=names, score=score, loss=groups.mean() + price)


def test_finalists_are_worth_their_price_or_no_chance_and_predict_differently(search):
    noise = 1e-3 * np.arange(16)
    named = [search.world.candidates[k] for k in range(5)]
    effects = [SimpleNamespace(candidate=candidate) for candidate in named]
    beam = SimpleNamespace(columns=SimpleNamespace(options=effects))
    start = node(noise, 0.0)
    worth = node(noise - 0.5, 0.1, 0)
    dear = node(noise - 0.4 + 2e-3 * np.arange(16)[::-1], 0.6, 1)  # seen everywhere all the same
    same = node(noise - 0.5 + 1e-3, 0.2, 2)
    luck = node(noise + np.where(np.arange(16) == 3, -3.0, 0.0), 0.6, 3)
    more = node(noise - 0.7, 0.3, 0, 4)
    nodes = sorted([worth, dear, same, luck, more], key=lambda n: n.loss)
    finalists, alone = search._finalists(beam, start, nodes)
    assert finalists == [more, worth, dear]
    assert alone == [same, luck]  # simple sets are judged whatever columns tell of them
    # beside what there was: instead of it, with it, as good as it is, and without it
    start, instead, both = (
        node(noise, 0.1, 0),
        node(noise - 0.8, 0.1, 1),
        node(noise - 0.7, 0.2, 0, 1),
    )
    nodes = [instead, both, node(noise + 1e-3, 0.1, 2), node(noise - 0.5, 0.0)]
    assert search._finalists(beam, start, nodes) == ([instead, both], [])


def test_single_curves_of_a_joint_take_one_place_among_those_that_are_judged(search):
    """Each alone is worth less than its price: simple sets are judged all the same."""
    noise, chance = 1e-3 * np.arange(16), np.where(np.arange(16) == 3, -0.5, 0.0)
    curves = [search.world.curve("elbow", "time", (0.0, 1.0 + k)) for k in range(5)]
    effects = [SimpleNamespace(candidate=c) for c in (*curves, search.world.candidates[0])]
    beam = SimpleNamespace(columns=SimpleNamespace(options=effects))
    nodes = [node(noise + chance, 0.2 + 0.01 * k, k) for k in range(6)]
    assert search._finalists(beam, node(noise, 0.0), nodes) == ([], [nodes[0], nodes[5]])


def limited(search, beyond, kept=()):
    """What is judged, [names], where values of the effects `beyond` end at a bound: of a beam that
    finds two sets of the first four effects, and further ones when it leaves some out."""
    some = [search.world.candidates[k] for k in range(4)]
    left, fits = set(), []

    def fit(setting, steps, near):
        fits.append([some.index(c) for c in setting])
        inside = {c: v for c, v in setting.items() if some.index(c) not in beyond}
        score = Score(0.0, np.zeros(4), np.zeros(4), ())
        return SimpleNamespace(
            setting=setting, inside=inside, settled=inside == setting, loss=0.0, score=score
        )

    def nodes():
        found = [
            n for n in (node([0.0], 0.0, 0, 1), node([0.0], 0.0, 2, 3)) if not left & set(n.options)
        ]
        return None, found or [node([0.0], 0.0, *(k for k in range(4) if k not in left))]

    beam = SimpleNamespace(
        nodes=nodes,
        leave=lambda candidates: left.update(map(some.index, candidates)),
        setting=lambda n: {some[k]: (1.0,) for k in n.options},
    )
    search._finalists = lambda beam, start, nodes: (nodes, [])
    now = SimpleNamespace(
        setting={some[k]: (1.0,) for k in kept}, score=Score(0.0, np.zeros(4), np.zeros(4), ())
    )
    judged = search._judged(SimpleNamespace(fit=fit), beam, now)
    assert judged[0] is now and len(judged) == 1 + len(fits)
    return fits


def test_what_has_no_value_is_left_out_and_sets_are_looked_for_without_it(search):
    assert limited(search, beyond=()) == [[0, 1], [2, 3]]
    assert limited(search, beyond=(0,)) == [[0, 1], [2, 3]]  # nothing is judged twice
    assert limited(search, beyond=(0, 3)) == [[0, 1], [2, 3], [1, 2]]


def test_what_there_was_without_a_value_is_left_out_of_each_set(search):
    assert limited(search, beyond=(0,), kept=(0,)) == [[0, 1], [1], [2, 3]]


def test_what_became_nominal_is_no_finding(search):
    friction, stiffness = (
        search.world.candidate(name, "elbow") for name in ("coulomb_friction", "stiffness")
    )
    asked = []

    def fit(setting, steps):
        asked.append((setting, steps))
        return SimpleNamespace(setting=setting)

    judge, none = SimpleNamespace(fit=fit), SimpleNamespace(options=[])
    both = SimpleNamespace(setting={friction: (0.1,), stiffness: stiffness.nominal}, columns=none)
    assert changing(judge, both).setting == {friction: (0.1,)}
    assert asked == [({friction: (0.1,)}, 0)]
    kept = SimpleNamespace(setting={friction: (0.1,)}, columns=none)
    assert changing(judge, kept) is kept and len(asked) == 1


@pytest.mark.parametrize(
    "shown, left",
    [
        ([[1, 0]], (-0.5, np.inf)),
        ([[0, 1]], (-np.inf, 0.6)),
        ([[1, 0], [0, 1]], (-0.5, 0.6)),
        (None, None),
    ],
)
def test_a_stop_on_a_side_where_none_is_met_is_no_finding(search, shown, left):
    """What moves no prediction, of a joint that has none."""
    stop = search.world.candidate("joint_stop", "shoulder")
    options = [SimpleNamespace(candidate=stop, directions=np.array(shown))] if shown else []
    stopped = SimpleNamespace(setting={stop: (-0.5, 0.6)}, columns=SimpleNamespace(options=options))
    judge = SimpleNamespace(fit=lambda setting, steps: SimpleNamespace(setting=setting))
    assert changing(judge, stopped).setting == ({stop: left} if left else {})


def rounds(search, monkeypatch, something):
    """(Fitted without effects, Fitted that every round ends with, asked): a search whose rounds are
    written down in asked; something(now): whether anything is left."""
    nothing, best, asked = fitted(search, [], 0.0), fitted(search, ["armature"], -1.0), []
    judge = SimpleNamespace(fit=lambda setting, **how: best if setting else nothing)
    monkeypatch.setattr(search, "begin", lambda *given: judge)
    monkeypatch.setattr(search, "locate", lambda setting: ("located", "first"))
    monkeypatch.setattr(search, "something", something)
    search.smoother, search.usual = SimpleNamespace(locate=lambda *given, **how: "moved"), None

    def round_of(judge, now, curves):
        asked.append((now, curves))
        return best

    monkeypatch.setattr(search, "_round", round_of)
    monkeypatch.setattr(search, "_curves", lambda setting: "curves")
    return nothing, best, asked


def test_rounds_go_on_while_they_end_with_other_sets(search, monkeypatch):
    nothing, best, asked = rounds(search, monkeypatch, lambda now: True)
    found = search.run()
    assert asked == [(nothing, "curves"), (best, "curves")] and found.fitted is best
    assert (found.trajectory, found.first) == ("moved", "first")
    search.sets = ["of what was refused"]
    assert search.again({}, "moved") is best and asked[-1] == (nothing, []) and not search.sets


def test_no_round_follows_a_set_beside_which_a_perfect_simulator_is_no_better(search, monkeypatch):
    nothing, best, asked = rounds(search, monkeypatch, lambda now: now is nothing)
    monkeypatch.setattr(identification, "MissingForce", lambda *given: "missing")
    monkeypatch.setattr(identification, "carried", lambda judge, sets, now, best: ["sets"])
    search.screen = None
    found = search.run()
    assert asked == [(nothing, "curves")] and found.fitted is best
    assert (found.missing, found.sets) == ("missing", ["sets"])


def test_what_finer_steps_explain_as_well_is_no_physics(search, monkeypatch):
    """Finer steps stand for it, where they are earned."""
    now, armature = fitted(search, [], 0.0), fitted(search, ["armature"], -1.0)
    fine = fitted(search, [], -1.5)
    monkeypatch.setattr(search, "further", lambda judge, best: best)
    monkeypatch.setattr(search, "pruned", lambda judge, best, now: best)
    monkeypatch.setattr(search, "finer", lambda judge, best: fine if best is now else best)
    assert search._ended(None, armature, now) is fine
    assert search._ended(None, now, now) is fine
    fine.loss, fine.score = now.loss, now.score  # finer steps explain nothing
    assert search._ended(None, armature, now) is armature
    assert search._ended(None, now, now) is now


def test_a_finer_time_step_is_no_candidate_beside_others(search):
    assert search.world.candidate("time_step", "world") not in search.candidates
    assert any(c.effect.name == "gravity" for c in search.candidates)


def test_beside_limits_that_small_changes_do_not_tell_of_the_others_are_tried_too(
    search, monkeypatch
):
    """Two limits, of which it is as if none missed them, leave two places to what is missed
    least."""
    limits = [search.world.candidate("saturation", f"{j}_motor") for j in ("shoulder", "elbow")]
    names = "armature", "stiffness", "viscous_damping"
    others = [search.world.candidate(name, "elbow") for name in names]
    losses = dict(zip([*limits, *others], (-np.inf, -np.inf, -0.9, -0.8, -0.7)))
    whole = SimpleNamespace(setting=dict.fromkeys([*others, *limits], ()), loss=-1.0)
    left = lambda fitted, c: SimpleNamespace(loss=losses[c])
    monkeypatch.setattr(identification, "without", left)
    monkeypatch.setattr(search, "earned", lambda before, after: before.loss == -0.7)
    assert search._missed_least(whole) == [*limits, *others[:2]]
    losses[others[1]] = -0.7  # it is needed, as the last one is
    assert search._missed_least(whole) == [*limits, others[0]]


def test_what_is_missed_least_is_tried_without_though_small_changes_show_it_to_be_needed(
    search, monkeypatch
):
    """A delay and a lag that share one lateness: columns say that the lag is needed, a refit
    without it is as good."""
    names = "armature", "stiffness", "viscous_damping"
    others = [search.world.candidate(name, "elbow") for name in names]
    losses = dict(zip(others, (-0.7, -0.9, -0.8)))
    whole = SimpleNamespace(setting=dict.fromkeys(others, ()), loss=-1.0)
    left = lambda fitted, c: SimpleNamespace(loss=losses[c])
    monkeypatch.setattr(identification, "without", left)
    monkeypatch.setattr(search, "earned", lambda before, after: True)
    assert search._missed_least(whole) == [others[1]]
