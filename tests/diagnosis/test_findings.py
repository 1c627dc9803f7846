"""Findings: knots of curves and numbers where the contract has numbers, shares of errors."""

from types import SimpleNamespace

import mujoco
import numpy as np
from arm import ARM, arm

from diagnosis import findings
from diagnosis.effects import unmodelled
from diagnosis.simulation.simulator import World


def test_findings_tell_where_a_curve_has_its_knots_and_keep_numbers():
    stop, curve = (
        World(mujoco.MjSpec.from_string(ARM)).candidate("joint_stop", "shoulder"),
        unmodelled.curve(arm(), "elbow", "time", (0.0, 2.0, 3.0)),
    )
    assert [p["at"] for p in findings.parameters_of(curve, (1.0, 2.0, 3.0))] == [0.0, 2.0, 3.0]
    told = lambda *bounds: [
        p["value"] for p in findings.parameters_of(stop, (-np.inf, 0.5), *bounds)
    ]
    least = stop.parameters[0].low  # what is written of a side that is never met
    assert told() == [least, 0.5] and told([None, (0.4, 0.6)]) == [None, 0.5]
    inf = np.inf
    assert [
        findings.removed(*errors)
        for errors in ((3, 1, 4), (inf, 1, inf), (inf, 1, 4), (3, inf, 4), (inf, inf, inf))
    ] == [0.5, 1, 1, -1, 0]
    assert [
        findings.unexplained(*errors)
        for errors in (
            (10, 1, 1, 0),
            (inf, inf, 1, 1),
            (inf, 2, 1, 1),
            (2, inf, 1, 1),
            (10, 6, 4, 0),
            (10, 6, 4, 5),
        )
    ] == [0, 1, 0, 1, 0.2, 0.1]


def test_what_a_motor_at_a_site_depends_on_is_no_joint():
    xml = """<mujoco><worldbody><body name="drone"><freejoint name="root"/><geom size=".1"/><site
    name="s"/></body></worldbody>
      <actuator><motor name="a" site="s" gear="0 0 1 0 0 0"/><motor name="b" site="s" gear="0 0 1 0
      0 .1"/></actuator></mujoco>"""
    world = World(mujoco.MjSpec.from_string(xml))
    for actuator in "ab":
        assert findings.depends_on(world.model, world.candidate("back_emf", actuator)) == []
        assert findings.depends_on(world.model, world.candidate("gain", actuator)) == [
            f"control:{actuator}"
        ]


def test_a_finding_whose_intervals_hold_every_nominal_value_is_not_certain():
    world = World(mujoco.MjSpec.from_string(ARM))
    friction = world.candidate("coulomb_friction", "shoulder")
    nominal = friction.nominal[0]
    assert findings.certain(friction, [(nominal + 0.1, nominal + 0.2)])
    assert not findings.certain(friction, [(nominal, nominal + 0.2)])
    assert not findings.certain(friction, [None])
    ripple = world.candidate("cogging", "shoulder")
    poles, phase = (30.0, 31.0), (0.4, 0.5)
    assert findings.certain(ripple, [(0.1, 0.2), poles, phase])
    assert not findings.certain(ripple, [(-0.1, 0.2), poles, phase])  # of no amplitude


def test_a_condition_is_told_by_the_stamps_of_its_recording():
    runs = [SimpleNamespace(name="one", origin=100.0), SimpleNamespace(name="two", origin=0.0)]
    there = lambda name: findings.stamped({"recording": name, "time": [1.0, 2.5]}, runs)["time"]
    assert (there("one"), there("two"), there(None)) == ([101.0, 102.5], [1.0, 2.5], [1.0, 2.5])
    assert findings.stamped(None, runs) is None


def test_a_mismatch_is_led_by_a_name_and_has_one_that_is_adequate():
    name = lambda adequate: {"effect": "gain", "adequate": adequate}
    unknown = {"effect": "unknown", "adequate": False}
    assert findings.verdict([], something=False) == "match"
    assert findings.verdict([], something=True) == "unresolved"
    assert findings.verdict([name(False), name(True)], something=True) == "mismatch"
    assert findings.verdict([name(False)], something=True) == "unresolved"
    assert findings.verdict([unknown, name(True)], something=True) == "unresolved"
    finer = {"effect": "time_step", "adequate": True}
    assert findings.verdict([finer], something=True) == "unresolved"
    assert findings.verdict([finer], something=False) == "mismatch"
    assert findings.verdict([finer, name(True)], something=True) == "mismatch"
    assert findings.verdict([finer, name(False)], something=True) == "unresolved"


def test_a_value_that_is_changed_is_told_though_no_interval_is_known():
    world = World(mujoco.MjSpec.from_string(ARM))
    step, h = world.candidate("time_step", "world"), world.model.opt.timestep
    [told] = findings.parameters_of(step, (h / 2,), [None])
    assert told["value"] == h / 2 and told["low"] is None and told["high"] is None
    [kept] = findings.parameters_of(step, (h,), [None])
    assert kept["value"] is None
