"""What is hidden by other code than the catalogue's: it can be named where it is, and the answer,
put into the nominal model, is the machine."""

import mujoco
import numpy as np
import pytest

from diagnosis.recordings.recording import Recording
from diagnosis.simulation.simulator import Window, World
from diagnosis.trials.drawing import Unfit, choose, told_item
from diagnosis.trials.groups import FIELDS, LAWS, MIMICS, ONE_LAW, WRONG_AXIS
from diagnosis.trials.hiding import Usage, hide, places
from diagnosis.trials.mjcf import to_mjcf
from diagnosis.trials.robots import FINAL, draw_robot
from diagnosis.trials.truth import TrueSystem

ROW, ROWS = 0.005, 40
# what acts whatever is touched; a stop is a limit, and no value of a candidate
PLAIN = [e for e in FIELDS if not e.startswith(("contact", "ground", "joint_stop"))]


@pytest.mark.parametrize("effect", ["coupled_friction", "coupled_inertia"])
def test_a_pair_of_joints_that_hides_an_effect_can_be_named(effect):
    rng, hidden = np.random.default_rng(0), 0
    for _ in range(20):
        robot = draw_robot(rng, FINAL)
        world = World(mujoco.MjSpec.from_string(to_mjcf(robot)))
        named = {c.place.name for c in world.candidates if c.effect.name == effect}
        links = robot.links
        for spot in places(robot, effect):
            pair = f"{links[spot.other].joint_name}+{links[spot.link].joint_name}"
            assert pair in named
            hidden += 1
    assert hidden > 5


def test_an_axis_is_wrong_only_where_another_joint_can_tell():
    """One hinge alone moves alike with another centre of mass and a rotor."""
    rng, number = np.random.default_rng(0), []
    for _ in range(30):
        robot = draw_robot(rng, FINAL)
        number.append(len(robot.links))
        assert bool(places(robot, WRONG_AXIS)) == (len(robot.links) > 1)
    assert min(number) == 1 < max(number)


def test_no_joint_hides_two_effects_of_one_law():
    """gain g and load friction (a, b) act as g (1 - a) and g (1 + b) alone."""
    for one, other in MIMICS:
        assert not any(one in family and other in family for family in ONE_LAW)
    rng, both = np.random.default_rng(0), 0
    for _ in range(600):
        try:
            chosen = choose(rng, "many", draw_robot(rng, FINAL))
        except Unfit:
            continue
        at = {effect: spot.link for effect, spot in chosen}
        for family in ONE_LAW:
            links = [at[effect] for effect in family if effect in at]
            both += len(links) > 1
            assert len(set(links)) == len(links)
    assert both  # in two joints they may be


def hidden_in(effect, removed, number=2):
    """[(nominal Robot, true Robot, laws, item as told)]: an effect hidden in drawn robots that
    touch nothing."""
    rng, out = np.random.default_rng(1), []
    size = 5.0 if effect == "gain_fade" else 0.5  # that one takes its time
    while len(out) < number:
        robot = draw_robot(rng, FINAL)
        spots = places(robot, effect)
        if robot.ground or not spots:
            continue
        for i in range(len(robot.actuators)):  # what is told is relative to the nominal gain
            robot = robot.with_actuator(i, gain=1.4)
        spot, usage = spots[rng.integers(len(spots))], usage_of(robot)
        if effect == "stribeck_friction":  # beside what friction there is
            robot = robot.with_link(spot.link, frictionloss=0.1 * usage.load[spot.link])
        nominal, true, laws, item = hide(effect, spot, size, removed, robot, robot, usage, rng)
        out.append((nominal, true, laws, told_item(item, nominal, true)))
    return out


def usage_of(robot):
    """As if every joint went to and fro once a second."""
    model = mujoco.MjModel.from_xml_string(to_mjcf(robot))
    inertia = np.array([model.dof_M0[model.joint(k.joint_name).dofadr[0]] for k in robot.links])
    n, load = len(inertia), 5 * inertia
    return Usage(
        spread=np.full(n, 0.5),
        speed=np.full(n, 3.0),
        load=load,
        inertia=inertia,
        quantiles=np.tile(np.linspace(-1, 1, 101), (n, 1)),
        torque_quantiles=load[:, None] * np.linspace(0, 2, 101),
        control=np.array([1.0 if a.kind != "motor" else load[a.link] for a in robot.actuators]),
    )


def driven(robot, rng):
    """(qpos, qvel, ctrl (ROWS + 1, nu)): a start near the model's own, and controls that swing."""
    model = mujoco.MjModel.from_xml_string(to_mjcf(robot))
    qpos, size = model.qpos0.copy(), usage_of(robot).control
    mujoco.mj_integratePos(model, qpos, rng.normal(size=model.nv), 0.5)
    swing = np.sin(8 * np.arange(ROWS + 1)[:, None] * ROW + rng.uniform(0, 6, model.nu))
    return qpos, rng.normal(size=model.nv), 2 * size * swing


def shown(robot, laws, qpos, qvel, ctrl):
    """(ROWS + 1, nq): what sensors of the machine show."""
    system = TrueSystem(robot, laws)
    system.reset(qpos, qvel)
    out = [system.reading()]
    for row in ctrl[:-1]:
        system.advance(row, ROW)
        out.append(system.reading())
    return out[0], np.array([qpos for qpos, _ in out])


@pytest.mark.parametrize("effect, removed", [(e, r) for e in PLAIN for r in (False, True)])
def test_a_value_of_the_answer_put_into_the_nominal_model_is_the_machine(effect, removed):
    for seed, (nominal, true, _, told) in enumerate(hidden_in(effect, removed)):
        world = World(mujoco.MjSpec.from_string(to_mjcf(nominal)))
        candidate = world.candidate(effect, told["place"]["name"])
        values = tuple(told["parameters"][p.name] for p in candidate.parameters)
        corrected = world.engine(frozenset()).working.edited([(candidate, values)], nominal.step)
        accelerations = []
        for model in (corrected, mujoco.MjModel.from_xml_string(to_mjcf(true))):
            data = mujoco.MjData(model)
            data.qpos[:], data.qvel[:], ctrl = driven(nominal, np.random.default_rng(seed))
            data.ctrl[:] = ctrl[-1]
            mujoco.mj_forward(model, data)
            accelerations.append(data.qacc.copy())
        np.testing.assert_allclose(*accelerations, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("effect", LAWS)
def test_a_law_of_the_answer_put_into_the_nominal_model_moves_as_the_machine(effect):
    told_by_sensors = 0
    for seed, (nominal, true, laws, told) in enumerate(hidden_in(effect, False)):
        world = World(mujoco.MjSpec.from_string(to_mjcf(nominal)))
        candidate = world.candidate(effect, told["place"]["name"])
        names = [p.name for p in candidate.parameters]
        assert set(told["parameters"]) <= set(names)
        # load friction counts the drive's side alone: external is 0
        setting = {candidate: tuple(told["parameters"].get(n, 0.0) for n in names)}
        qpos, qvel, ctrl = driven(nominal, np.random.default_rng(seed))
        start, moved = shown(true, laws, qpos, qvel, ctrl)
        differs = lambda a, b: np.abs(a - b)[1:].max()
        bare = world_shows(world, {}, start, ctrl)
        own = differs(bare, shown(true, [], *start, ctrl)[1])  # of the two ways to simulate
        assert differs(world_shows(world, setting, start, ctrl), moved) < (
            0.3 * differs(bare, moved) + 5 * own
        ), told["place"]
        told_by_sensors += differs(bare, moved) > 10 * own
    assert told_by_sensors


def world_shows(world, setting, start, ctrl):
    """(ROWS + 1, nq): what the catalogue's simulation shows from where sensors start."""
    none = np.full((ROWS + 1, world.model.nv), np.nan)
    recording = Recording("run", ROW * np.arange(ROWS + 1), none, none, ctrl)
    qpos, qvel = (x[None] for x in start)
    return world.simulate([setting], qpos, qvel, [Window(recording, 0, ROWS)], refine=16)[0][0]
