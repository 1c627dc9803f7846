"""Classes: what takes a finding's place, what is told beside it, and what is neither."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from plants import DRIVEN_PENDULUM, recorded

from diagnosis.effects.unmodelled import Unknown
from diagnosis.selection import rivals
from diagnosis.selection.criterion import PRICE, Score
from diagnosis.selection.identification import Identification
from diagnosis.selection.missing_force import MissingForce
from diagnosis.simulation.simulator import World


class Named:
    """As much of a Candidate as the choice looks at."""

    def __init__(self, name, units):
        self.name = name
        known = {"overrides": lambda what: False, "id": lambda model, name: 0}
        known["twin"] = lambda model, i: None
        self.effect = SimpleNamespace(simplicity=units - 1, name=name, numerical=False, **known)
        self.parameters, self.place = (None,), SimpleNamespace(name="elbow")
        self.when, self.lasting = None, self


DRY, CURVED = Named("coulomb", 1), Named("stribeck", 4)


def test_bodies_meet_at_the_joints_that_carry_both():
    link = """<body name="{0}"><joint name="of_{0}"/><geom size=".1"/>{1}</body>"""
    hand = link.format("hand", "")
    bodies = link.format("arm", hand) + link.format("other", "")
    world = World(mujoco.MjSpec.from_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>"))
    mass = {name: world.candidate("mass", name) for name in ("arm", "hand", "other")}
    damping = {name: world.candidate("viscous_damping", f"of_{name}") for name in ("arm", "hand")}
    meets = lambda a, b: rivals.meet(world, a, b)
    assert meets(mass["arm"], mass["hand"]) and meets(mass["hand"], damping["arm"])
    assert not meets(mass["hand"], mass["other"]) and not meets(mass["arm"], damping["hand"])
    assert meets(damping["arm"], world.candidate("gravity", "world"))


def chosen(monkeypatch, fitted, losses, asked=None):
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
    world = SimpleNamespace(model=None)
    silent = SimpleNamespace(chain=SimpleNamespace(world=world))
    held = SimpleNamespace(setting=None)
    monkeypatch.setattr(rivals, "_along", lambda *args: held)
    monkeypatch.setattr(rivals, "MissingForce", lambda *args: silent)
    monkeypatch.setattr(rivals, "_late", lambda *args: [])
    start = Judge().fit({names[fitted]: (2.0,)})
    found, told = rivals.classes([DRY, CURVED], Judge(), silent, start, None, asked)
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


def test_only_the_classes_that_are_asked_are_told(monkeypatch):
    close = {"stribeck": 0.0, "coulomb": 0.2}
    assert chosen(monkeypatch, "stribeck", close, asked=[]) == (["stribeck"], {})
    assert chosen(monkeypatch, "stribeck", close, asked=[CURVED])[0] == ["coulomb"]


FEET = """<mujoco><worldbody><geom name="floor" type="plane" size="5 5 .1"/>
  <body pos="0 0 .1"><joint type="slide" axis="0 0 1"/><joint type="slide" axis="1 0 0"/>
  <geom name="left" type="box" size=".1 .1 .1" pos="-.5 0 0"/>
  <geom name="right" type="box" size=".1 .1 .1" pos=".5 0 0"/></body></worldbody></mujoco>"""


def test_the_floor_is_tried_for_a_foot_at_the_findings_own_value_and_no_other_foot(monkeypatch):
    """Two geoms of one contact share its numbers; feet that are alike do not."""
    world, begun = World(mujoco.MjSpec.from_string(FEET)), []
    foot, floor, right = (
        world.candidate("contact_friction", n) for n in ("left", "floor", "right")
    )
    assert foot.nominal == floor.nominal == right.nominal
    damping = world.candidate("contact_damping", "floor")
    judge = SimpleNamespace(
        fit=lambda setting, **how: begun.append(setting) or SimpleNamespace(settled=False)
    )
    monkeypatch.setattr(rivals, "_alike", lambda *args: [(damping, (5.0,)), (floor, (0.9,))])
    monkeypatch.setattr(rivals, "MissingForce", lambda *args: None)
    before = SimpleNamespace(chain=SimpleNamespace(world=world))
    fitted = SimpleNamespace(setting={foot: (0.2,)})
    rivals._members(world.candidates, judge, before, fitted, foot, None)
    assert begun == [{floor: (0.2,)}, {damping: (5.0,)}]


GAIN, DAMPING, MASS, ARMATURE = (
    Named(name, units)
    for name, units in (("gain", 1), ("damping", 1), ("mass", 1), ("armature", 2))
)
CURVE = Named("curve", 2)
CURVE.effect = Unknown("velocity:elbow", np.array([-1.0, 1.0]))


def set_of(loss, *candidates):
    """A Fitted set that predicts as well as others of its loss, and no other."""
    score = Score(loss, loss + np.linspace(-1e-6, 1e-6, 4), np.full(4, 4 * loss), ())
    setting = {c: (loss,) for c in candidates}
    return SimpleNamespace(setting=setting, score=score, loss=loss, settled=True)


BEST = set_of(-2.0, GAIN, DAMPING)


@pytest.mark.parametrize(
    "judged, good",
    [
        (set_of(-1.95, MASS, ARMATURE), True),
        (set_of(-2.5, MASS, ARMATURE), True),  # better, but for a price that it is not worth
        (set_of(-1.8, MASS, ARMATURE), False),  # worse
        (set_of(-2.0, MASS, DAMPING), True),  # one effect in the place of another
        (set_of(-2.0, GAIN, DAMPING, MASS), False),  # more of the same
        (set_of(-2.0, GAIN), False),
        (set_of(-2.0, CURVE, MASS), False),  # no name
        (set_of(-2.0, MASS, ARMATURE, CURVED), False),  # much more complex
    ],
)
def test_a_set_of_other_effects_that_predicts_as_well_is_carried_on(judged, good):
    assert rivals.as_good([BEST, judged], BEST) == ([judged] if good else [])


def test_sets_of_an_earlier_round_are_judged_as_they_are_and_with_what_is_new():
    asked, now = [], set_of(-1.0, GAIN)
    judge = SimpleNamespace(fit=lambda setting, steps, near: asked.append((set(setting), near)))
    rivals.carried(judge, [set_of(-1.0, MASS, ARMATURE)], now, BEST)
    assert asked == [({MASS, ARMATURE}, BEST), ({MASS, ARMATURE, DAMPING}, BEST)]
    asked.clear()
    rivals.carried(judge, [set_of(-1.0, MASS)], BEST, BEST)
    assert asked == [({MASS}, BEST)]
    asked.clear()
    rivals.carried(judge, [set_of(-1.0, MASS, DAMPING)], now, BEST)
    assert asked == [({MASS, DAMPING}, BEST)]  # it has what is new


def test_the_same_effects_judged_twice_are_carried_on_once():
    first, again = set_of(-1.95, MASS, ARMATURE), set_of(-1.96, ARMATURE, MASS)
    assert rivals.as_good([BEST, first, again], BEST) == [again]


def test_a_set_that_stands_for_several_findings_is_told_beside_each():
    single = {GAIN: [(MASS, (3.0,))], DAMPING: []}
    told = rivals.together(single, BEST, [set_of(-1.95, MASS, ARMATURE)])
    assert told == {
        GAIN: [(MASS, (3.0,)), (ARMATURE, (-1.95,))],
        DAMPING: [(MASS, (-1.95,)), (ARMATURE, (-1.95,))],
    }
    assert rivals.together(single, BEST, [set_of(-1.5, MASS, ARMATURE)]) == single


def test_another_effect_is_begun_at_the_value_that_it_takes_not_near_its_starts(monkeypatch):
    """Damping of the drive for a little more damping of the joint, where all starts are large."""
    more = 0.002  # N·m·s/rad
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.01, mass=0.5)))
    runs = [recorded(f"{k}.csv", k, 0.01 + more, seconds=8.0) for k in (0, 1)]
    damping = world.candidate("viscous_damping", "pivot")
    back_emf = world.candidate("back_emf", "drive")
    search = Identification(world, runs)
    judge = search.begin({}, search.locate({})[0])
    fitted = judge.fit({damping: (0.01 + more,)})
    missing = MissingForce(search.screen, {})
    held = rivals._along(search.screen, judge, fitted.setting)
    monkeypatch.setattr(
        rivals, "likely", lambda missing, starts, alone=False: [s for s in starts if s.whole]
    )
    [(other, (value,))] = rivals._alike(judge, missing, damping, [back_emf], held)
    assert other is back_emf and value == pytest.approx(more, rel=0.1)
