"""Refits in the simulator recover what was put into stock MuJoCo; equals are told as a class."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from diagnosis.estimation.ahead import Ahead, cut_ahead
from diagnosis.estimation.chain import Chain
from diagnosis.estimation.smoother import Smoother
from diagnosis.recordings.recording import Recording
from diagnosis.selection import rivals
from diagnosis.selection.criterion import Score, paired
from diagnosis.selection.judge import FARTHER, Judge, _least_told, moved_setting, without
from diagnosis.selection.missing_force import MissingForce
from diagnosis.selection.plausibility import Usual, plausible
from diagnosis.simulation.simulator import World

PENDULUM = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
  <body name="arm">
  <joint name="pivot" axis="0 1 0" damping="{damping}" frictionloss="{friction}"
    solreffriction="0.004 1" solimpfriction="0.999 0.9999 0.001"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass="0.5" contype="0"/></body></worldbody>
  <actuator><motor name="drive" joint="pivot" gear="{gear}"/></actuator></mujoco>"""


def run(seed, damping=0.05, friction=0.0, gear=1.0, rows=800, noise=3e-4, stops=""):
    """A Recording of the pendulum in stock MuJoCo, rows 10 ms apart."""
    rng = np.random.default_rng(seed)
    xml = PENDULUM.format(damping=damping, friction=friction, gear=gear)
    xml = xml.replace('name="pivot"', f'name="pivot" {stops}')
    model = mujoco.MjModel.from_xml_string(xml)
    data, time = mujoco.MjData(model), 0.01 * np.arange(rows)
    period, phase = rng.uniform(0.6, 1.5, 3), rng.uniform(0, 6, 3)
    ctrl = (0.3 * np.sin(2 * np.pi * time[:, None] / period + phase)).sum(1, keepdims=True)
    qpos = np.empty((rows, 1))
    for t in range(rows):
        qpos[t], data.ctrl[:] = data.qpos, ctrl[t]
        mujoco.mj_step(model, data, 5)
    noisy = qpos + noise * rng.normal(size=qpos.shape)
    return Recording(f"{seed}.csv", time, noisy, np.full(qpos.shape, np.nan), ctrl)


def judge_of(limits="", **hidden):
    """Judge on two runs of a pendulum whose model lacks what is hidden; limits: of its drive."""
    xml = PENDULUM.format(damping=0.05, friction=0, gear=1).replace("<motor", f"<motor {limits}")
    world = World(mujoco.MjSpec.from_string(xml))
    runs = [run(k, **hidden) for k in range(2)]
    smoother = Smoother(world, runs)
    trajectory = smoother.locate({}, passes=2)
    ahead = Ahead(world, cut_ahead(runs), smoother.position_noise)
    ahead.start(trajectory)
    return Judge(ahead, Usual(world, runs, smoother.scale))


def along(judge):
    """The Chain along the motion of a Judge's recordings."""
    ahead = judge.ahead
    chain = Chain(ahead.world, ahead.windows, ahead.noise)
    chain.start(Smoother(ahead.world, judge.usual.recordings).locate({}))
    return chain


def test_friction_and_gain_are_recovered_from_afar():
    judge = judge_of(friction=0.06, gear=0.8)
    friction, gain = (
        judge.ahead.world.candidate(*c) for c in (("coulomb_friction", "pivot"), ("gain", "drive"))
    )
    fitted, bare = judge.fit({friction: (0.02,), gain: (1.0,)}), judge.fit({})
    assert fitted.setting[friction][0] == pytest.approx(0.06, rel=0.02)
    assert fitted.setting[gain][0] == pytest.approx(0.8, rel=0.02)
    assert paired(bare.score, fitted.score).p_value < 1e-6
    half = judge.fit({friction: (0.02,)})
    assert fitted.loss < half.loss < bare.loss
    assert paired(half.score, fitted.score).p_value < 1e-4


def test_a_stop_that_had_one_side_may_have_another_one_later():
    """What one side alone does not show may show with other values."""
    low, high = -0.5, 0.6
    judge = judge_of(stops=f'range="{np.degrees(low)} {np.degrees(high)}"')
    stop = judge.ahead.world.candidate("joint_stop", "pivot")
    judge.fit({stop: (-0.4, 1e6)}, steps=0)
    fresh = Judge(judge.ahead, judge.usual, judge.reference)
    again, anew = (one.fit({stop: (-0.48, 0.57)}).setting[stop] for one in (judge, fresh))
    assert again == pytest.approx(anew, abs=1e-4) and anew == pytest.approx((low, high), abs=0.01)


def test_small_changes_do_not_tell_what_a_limit_is_without():
    """Its slope at 0.2 N·m says nothing of 13 N·m, which is never met."""
    judge = judge_of(limits='forcerange="-13 13"')
    of = judge.ahead.world.candidate
    limit, friction = of("saturation", "drive"), of("coulomb_friction", "pivot")
    fitted = judge.fit({limit: (0.2,), friction: (0.05,)}, steps=0)
    assert without(fitted, limit).loss == -np.inf
    assert np.isfinite(without(fitted, friction).loss)


def test_values_stay_inside_what_is_plausible():
    judge = judge_of(friction=0.06)
    gain = judge.ahead.world.candidate("gain", "drive")
    prior = plausible(gain, judge.usual)
    fitted = judge.fit({gain: (50.0,)})
    assert prior.low[0] <= fitted.setting[gain][0] <= prior.high[0]


def test_what_adds_nothing_does_not_earn_its_place():
    judge = judge_of()
    bare = judge.fit({})
    for name, place in (("coulomb_friction", "pivot"), ("gain", "drive"), ("mass", "arm")):
        candidate = judge.ahead.world.candidate(name, place)
        start = np.array(candidate.nominal) + candidate.parameters[0].step
        fitted = judge.fit({candidate: tuple(start)})
        assert bare.loss - fitted.loss < 0.1, name


def test_back_emf_and_viscous_damping_are_one_class():
    judge = judge_of(damping=0.12)
    world = judge.ahead.world
    damping, back_emf = (
        world.candidate(*c) for c in (("viscous_damping", "pivot"), ("back_emf", "drive"))
    )
    names = "viscous_damping", "back_emf", "coulomb_friction", "gain", "stiffness"
    pool = [c for c in world.candidates if c.effect.name in names]
    missing = MissingForce(along(judge), {})
    for found in (damping, back_emf):
        fitted = judge.fit({found: (0.1,)})
        again, others = rivals.classes(pool, judge, missing, fitted, lambda setting: judge)
        [named] = again.setting
        told = {named, *(c for c, _ in others[named])}
        assert {damping, back_emf} <= told
        assert named == damping  # the simplest stands first
        assert again.loss < fitted.loss + 0.03
        members = dict(others[named])
        assert members[back_emf][0] == pytest.approx(0.07, rel=0.1)


def test_what_is_no_equal_is_not_told():
    judge = judge_of(friction=0.06)
    world = judge.ahead.world
    friction = world.candidate("coulomb_friction", "pivot")
    fitted = judge.fit({friction: (0.05,)})
    others = "gain", "stiffness", "mass", "delay", "viscous_damping", "gravity", "bias"
    pool = [c for c in world.candidates if c.effect.name in others]
    missing = MissingForce(along(judge), {})
    again, told = rivals.classes(pool, judge, missing, fitted, lambda setting: judge)
    assert list(again.setting) == [friction]
    assert told[friction] == []


@pytest.mark.parametrize(
    "told, losses, taken, as_told",
    [
        (5.0, (-1.0, -0.5, -0.2), 1, False),  # the whole step
        (5.0, (-1.0, -2.0, -1.5), 1 / 3, False),  # a third, which is better
        (1.2, (-1.0, -2.0, -1.5), 1, True),  # as told: a third is not asked for
        (5.0, (3.0, -0.5, -0.7), 1 / 9, False),  # the whole step is worse than none
        (0.6, (3.0, -0.5, -0.7), 1 / 3, True),
        (0.6, (-1.0, -0.5, -0.2), 1, False),  # more than was told
        (5.0, (3.0, 2.0, 1.0), None, False),
        (1.0, (-1e-4, 1.0, 1.0), None, False),  # not worth a step
    ],
)
def test_a_step_is_taken_as_far_as_it_lowers_the_loss(monkeypatch, told, losses, taken, as_told):
    shares, asked = dict(zip((1.0, 1 / 3, 1 / 9), losses)), []
    judge = object.__new__(Judge)
    judge.ahead = SimpleNamespace(
        residual=lambda settings: asked.extend(settings) or np.array(settings)
    )
    judge.cost = lambda share: 0.0
    bare = lambda ahead, residual: SimpleNamespace(plain=lambda: shares[float(residual)])
    monkeypatch.setattr("diagnosis.selection.judge.Evidence", bare)
    monkeypatch.setattr("diagnosis.selection.judge.moved_setting", lambda columns, share: share)
    evidence = SimpleNamespace(plain=lambda *by: -told if by else 0.0, cells=1, count=[0])
    found, as_it_did = judge._better(SimpleNamespace(setting={}), evidence, [0], 1.0)
    assert (found and found[0]) == taken
    assert as_it_did == as_told
    if as_told:
        assert asked[-1] == taken


@pytest.mark.parametrize(
    "near, turns, simulated",
    [
        (None, [("a", True), ("b", True)], ["", "b"]),  # carried along, and anew at the end
        (None, [("a", False), ("b", False)], ["", "a", "b"]),  # they told of other steps
        (None, [("a", True), (None, True), (None, True)], ["", "a"]),  # told nothing: asked anew
        (None, [(None, True)], [""]),
        ("look", [("a", True), ("b", True)], [""]),  # enough for a comparison
        ("look", [("a", False), ("b", True)], ["", "a"]),
        ("look", [("a", True), (None, False), (None, True)], ["", "a"]),  # what they told was wrong
        ("look", [(None, True)], [""]),
    ],
)
def test_columns_are_carried_along_with_steps_that_do_what_they_told(near, turns, simulated):
    judge, turns, asked = object.__new__(Judge), iter(turns), []

    def about(setting, residual=None):
        score = SimpleNamespace(plus=lambda *prior: None, amounts=())
        told = SimpleNamespace(reference=None, number=1, score=lambda *given: score)
        columns = SimpleNamespace(setting=setting, residual=residual, options=[])
        columns.evidence, columns.about = lambda reference: told, about
        return columns

    def columns_of(setting, residual=None, near=None):
        asked.append("".join(setting))
        return about(setting, residual)

    def better(columns, *given):
        step, as_told = next(turns)
        return step and ({step: (1.0,)}, "known"), as_told

    judge.reference, judge._columns, judge._better = None, columns_of, better
    judge.cost = lambda setting: 0.0
    judge.fit({}, steps=2, near=near)
    assert asked == simulated


def test_no_step_is_tried_where_small_changes_tell_of_no_gain():
    judge, plain = object.__new__(Judge), iter((2.0, 1.9999))
    evidence = SimpleNamespace(plain=lambda *given: next(plain), cells=1, count=[0])
    # a step would ask for what this judge does not have
    assert judge._better(SimpleNamespace(setting={}), evidence, [0], np.ones(1)) == (None, True)


def test_a_late_sensor_is_told_beside_a_late_drive():
    judge = judge_of()
    world, asked = judge.ahead.world, []
    delay, late = world.candidate("delay", "drive"), world.candidate("sensor_delay", "pivot")

    def fit(setting):
        [c] = setting
        asked.append(c)
        groups = losses[c] + np.linspace(-1e-6, 1e-6, 4) * len(repr(c))  # no chance at all
        return SimpleNamespace(
            setting=setting, settled=True, score=Score(losses[c], groups, 4 * groups, ())
        )

    begun = lambda setting: SimpleNamespace(fit=fit) if late in setting else None
    some = world.candidates, begun, world
    losses = {delay: -1.0, late: -0.95}
    fitted = fit({delay: (0.01,)})
    assert rivals._late(*some, fitted, delay) == [(late, (0.01,))]
    assert asked == [delay, late]
    losses = {delay: -1.0, late: -0.8}
    assert rivals._late(*some, fitted, delay) == []
    friction = judge.fit({world.candidate("coulomb_friction", "pivot"): (0.01,)}, steps=0)
    [named] = friction.setting
    assert rivals._late(*some, friction, named) == []


def test_what_columns_tell_least_of_is_moved_a_quarter_of_a_priors_scale():
    """Not a time step, which has none that a machine gives."""
    judge = judge_of(friction=0.05)
    of = judge.ahead.world.candidate
    friction, gain, step = (
        of("coulomb_friction", "pivot"),
        of("gain", "drive"),
        of("time_step", "world"),
    )
    setting = {friction: (0.05,), gain: (1.0,), step: (0.001,)}
    fitted = judge.fit(setting, steps=0)
    moved = moved_setting(fitted.columns, _least_told(fitted))
    assert moved[step] == setting[step]
    shares = [
        abs(moved[c][0] - v[0]) / plausible(c, judge.usual).scale[0] for c, v in setting.items()
    ]
    assert max(shares[:2]) == pytest.approx(FARTHER, rel=1e-6)
    loss = lambda some: judge.fit(some, steps=0).evidence.plain()
    other = {
        friction: (0.05 + FARTHER * plausible(friction, judge.usual).scale[0],),
        gain: (1.0,),
        step: (0.001,),
    }
    assert loss(moved) < loss(other)  # as far, in a direction that is told better


@pytest.mark.parametrize(
    "losses, settled, chosen",
    [
        ((-1.2, -1.5), True, 1),
        ((-0.5, -0.9), True, None),
        ((-1.2, -1.5), False, None),
    ],
)
def test_of_two_minima_the_lower_one_is_kept(monkeypatch, losses, settled, chosen):
    judge, tries = judge_of(), []
    damping = judge.ahead.world.candidate("viscous_damping", "pivot")
    first = judge.fit({damping: (0.05,)}, steps=0)
    sets = [SimpleNamespace(loss=x, settled=settled, setting=k) for k, x in enumerate(losses)]
    more = SimpleNamespace()

    def fit(setting, steps=None):
        if steps is None:
            assert setting == chosen  # the better one, with more steps
            return more
        tries.append(setting[damping][0])
        return sets[len(tries) - 1]

    monkeypatch.setattr(judge, "fit", fit)
    monkeypatch.setattr(type(first), "loss", -1.0)
    found = judge.elsewhere(first)
    assert found is (first if chosen is None else more)
    assert min(tries) < 0.05 < max(tries)
