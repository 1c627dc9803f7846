"""Columns along the measured motion, against the missing force and against the simulator."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from plants import DRIVEN_PENDULUM, NOISE, SIZES, arm, record, recorded

from diagnosis.estimation.ahead import Ahead, cut_ahead
from diagnosis.estimation.chain import Chain, _as_heavy
from diagnosis.estimation.smoother import Smoother
from diagnosis.selection.columns import Columns
from diagnosis.selection.criterion import Evidence
from diagnosis.selection.plausibility import Usual
from diagnosis.selection.starts import Starts
from diagnosis.simulation import rows
from diagnosis.simulation.simulator import World

VISCOUS, DRY = {"viscous_damping": (0.2,)}, {"coulomb_friction": (0.1,)}


def located(friction):
    """(world, setting of the truth, chain at its recordings): a model that lacks its friction."""
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.0, mass=0.5)))
    truth = {world.candidate(name, "pivot"): values for name, values in friction.items()}
    level = friction.get("coulomb_friction", (0.0,))[0]
    dry = lambda time, q, v: -level * np.tanh(v / 0.02)
    runs = [recorded(f"{k}.csv", k, damping=0.2, push=dry, seconds=8.0) for k in range(2)]
    chain = Chain(world, cut_ahead(runs), np.array([NOISE]))
    chain.start(Smoother(world, runs).locate({}))
    return world, truth, chain


@pytest.fixture(scope="module")
def here():
    return located(VISCOUS | DRY)


def test_what_the_true_effects_do_in_each_row_is_what_is_missing_whatever_their_size(here):
    _, truth, chain = here
    nominal, whole = chain.residual([{}, truth])
    assert np.sqrt(np.mean(nominal**2)) > 100 * NOISE
    assert np.sqrt(np.mean(whole**2)) < 0.05 * np.sqrt(np.mean(nominal**2))
    alone = chain.residual([{c: v} for c, v in truth.items()])
    apart = sum(nominal - one for one in alone)
    cosine = np.sum(apart * nominal) / np.sqrt(np.sum(apart**2) * np.sum(nominal**2))
    assert cosine > 0.999


def test_small_changes_are_those_of_the_simulator_where_it_keeps_to_the_motion():
    """But for dry friction that holds a joint: the chain moves on."""
    world, truth, chain = located(VISCOUS)
    close = Chain(world, chain.windows, chain.noise)
    runs = list(chain.trajectory.first)
    close.start(Smoother(world, runs).locate(truth))
    ahead = Ahead(world, chain.windows, chain.noise)
    ahead.start(close.trajectory)
    gain = world.candidate("gain", "drive")
    for candidate, values in ((gain, (1.001,)), (world.candidate("armature", "pivot"), (2e-4,))):
        some = [truth, {**truth, candidate: values}]
        (a, b), (c, d) = close.residual(some), ahead.residual(some)
        x, y = (a - b).ravel(), (c - d).ravel()
        assert x @ y / np.sqrt((x @ x) * (y @ y)) > 0.999


def test_what_a_heavier_joint_lacks_does_not_hang_by_what_else_is_missing(here):
    """Effects superpose as forces: an accelerated armature needs its torque whatever brakes it."""
    world, truth, chain = here
    heavy = {world.candidate("armature", "pivot"): (0.03,)}
    nominal, alone, beside, both = chain.residual([{}, heavy, truth, {**truth, **heavy}])
    x, y = (nominal - alone).ravel(), (beside - both).ravel()
    assert np.sqrt(np.mean((x - y) ** 2)) < 0.06 * np.sqrt(np.mean(x**2))  # but where it sticks


def test_what_is_no_force_is_simulated(here):
    world, _, chain = here
    sensor = world.candidate("sensor_scale", "pivot")
    ahead = Ahead(world, chain.windows, chain.noise)
    ahead.start(chain.trajectory)
    along, simulated = (a.residual([{}, {sensor: (1.1,)}]) for a in (chain, ahead))
    np.testing.assert_allclose(along[1] - along[0], simulated[1] - simulated[0], atol=1e-12)


def test_a_finer_time_step_has_a_column(here):
    world, _, chain = here
    step = {world.candidate("time_step", "world"): (0.00125,)}
    ahead = Ahead(world, chain.windows, chain.noise)
    ahead.start(chain.trajectory)
    along, simulated = (a.residual([{}, step]) for a in (chain, ahead))
    np.testing.assert_allclose(along[1] - along[0], simulated[1] - simulated[0], atol=1e-12)
    rough = chain.rough([{}, step])
    np.testing.assert_array_equal(rough[0], rough[1])


def test_a_start_state_moves_predictions_as_in_the_simulator():
    world, truth, chain = located(VISCOUS)
    trajectory = Smoother(world, list(chain.trajectory.first)).locate(truth)
    along, ahead = (kind(world, chain.windows, chain.noise) for kind in (Chain, Ahead))
    along.start(trajectory, truth)
    ahead.start(trajectory, truth)
    for k in range(2):  # where it is, how fast it goes
        x, y = (a.freedom()[..., k].ravel() for a in (along, ahead))
        assert x @ y / np.sqrt((x @ x) * (y @ y)) > 0.999
        assert np.sqrt((x @ x) / (y @ y)) == pytest.approx(1.0, abs=0.01)
    moved = Ahead(world, chain.windows, chain.noise)
    moved.start(trajectory, truth)
    moved.qvel = moved.qvel + trajectory.qvel_sd[trajectory.begin(chain.windows)]
    change = ahead.residual([truth])[0] - moved.residual([truth])[0]
    np.testing.assert_allclose(change, ahead.freedom()[..., 1], atol=1e-9)


def test_what_is_more_than_a_row_hardly_changes_with_what_stands_beside_it():
    world, truth, chain = located(VISCOUS)
    off = {**truth, world.candidate("sensor_scale", "pivot"): (1.02,)}
    trajectory = Smoother(world, list(chain.trajectory.first)).locate(off)
    close, ahead = (kind(world, chain.windows, chain.noise) for kind in (Chain, Ahead))
    close.start(trajectory, off)
    ahead.start(trajectory)
    some = [off, {**off, world.candidate("gain", "drive"): (1.001,)}]
    (a, b), (c, d) = close.residual(some), ahead.residual(some)
    x, y = (a - b).ravel(), (c - d).ravel()
    assert x @ y / np.sqrt((x @ x) * (y @ y)) > 0.998
    np.testing.assert_allclose(close.residual(some[1:])[0], b, atol=1e-12)  # whatever came before


def test_what_effects_do_in_beginnings_is_worked_out_once(here, monkeypatch):
    world, truth, chain = here
    mass = {world.candidate("mass", "arm"): (0.6,)}
    first = chain.beginnings(4, 0.3)
    expected = Chain.residual(first, [truth, {**truth, **mass}])
    short = chain.beginnings(4, 0.3)
    plain, asked = short.missing, []
    monkeypatch.setattr(short, "missing", lambda s, rows: asked.append(s) or plain(s, rows))
    np.testing.assert_allclose(short.residual([truth, {**truth, **mass}]), expected, atol=1e-7)
    assert asked == [{}]  # beside which effects are known


def test_coarse_steps_invent_nothing_under_the_effects_that_located_the_motion(here, monkeypatch):
    world, truth, chain = here
    trajectory = Smoother(world, list(chain.trajectory.first)).locate(truth)
    found = []
    for steps in (1, 1000):  # a row is two of the simulator's own steps
        monkeypatch.setattr(rows, "STEPS", steps)
        some = Chain(world, chain.windows, chain.noise)
        some.start(trajectory, truth)
        more = {**truth, world.candidate("gain", "drive"): (1.1,)}
        found.append(some.residual([truth, more]))
    rough, fine = found
    np.testing.assert_allclose(rough[0], fine[0], atol=1e-9)
    x, y = (rough[1] - rough[0]).ravel(), (fine[1] - fine[0]).ravel()
    assert x @ y / np.sqrt((x @ x) * (y @ y)) > 0.999


@pytest.mark.parametrize("kp", [0.0, 40.0, 4000.0])
def test_coarse_steps_are_no_longer_than_the_stiffest_servo_allows(kp):
    xml = DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)
    spec = mujoco.MjSpec.from_string(xml)
    if kp:
        spec.actuators[0].set_to_position(kp=kp)
    world = World(spec)
    own = world.model.opt.timestep
    runs, inertia = [recorded("run.csv", 1, seconds=2.0)], 1 / world.model.dof_invweight0[0]
    [(_, (step,))] = rows.coarse(world, runs).items()
    assert own < step + 1e-12 <= max(own, 0.3 / np.sqrt(max(kp, 1e-9) / inertia)) + 2e-12
    assert (step > own) == (kp < 1000)


BOUNCING = """<mujoco><option timestep="0.001"/><worldbody>
  <geom name="ground" type="plane" size="5 5 .1" solref="{solref}"/>
  <body name="ball" pos="0 0 .3"><joint name="drop" type="slide" axis="0 0 1" damping="0.2"/>
    <geom type="sphere" size=".1" mass="1" solref="{solref}"/></body>
</worldbody></mujoco>"""


@pytest.mark.parametrize(
    "solref, rate",
    [("0.02 1", 50.0), ("0.02 4", 50 / 4), ("-10000 -20", 100.0), ("-100 -90", 90.0)],
)
def test_coarse_steps_are_no_longer_than_a_contact_allows(solref, rate):
    world = World(mujoco.MjSpec.from_string(BOUNCING.format(solref=solref)))
    time = 0.1 * np.arange(50)
    runs = [SimpleNamespace(time=time)]
    [(_, (free,))] = rows.coarse(world, runs).items()
    [(_, (touching,))] = rows.coarse(world, runs, touching=True).items()
    assert free == pytest.approx(0.05)
    # the joint has MuJoCo's own limit, a time constant of 20 ms
    assert touching == pytest.approx(0.3 / max(rate, 50.0))


def test_the_same_damping_in_a_drive_and_in_a_joint_does_the_same_in_a_row():
    """A stiff one, of a model that Euler's method steps."""
    spec = mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.0, mass=0.5))
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    world = World(spec)
    runs = [recorded("run.csv", 1, seconds=2.0)]
    step = rows.coarse(world, runs)
    ahead = []
    for effect, place in (("viscous_damping", "pivot"), ("back_emf", "drive")):
        row = rows.RowMap(world, runs, {**step, world.candidate(effect, place): (2.0,)})
        start = np.zeros((1, 1)), np.ones((1, 1)), np.zeros((1, 1))
        ahead.append(row.ahead(np.zeros(1, int), *start)[1])
    assert abs(ahead[0] - ahead[1]).max() < 1e-9 < abs(1 - ahead[0]).max()


def test_whether_a_models_inertia_is_another_one_is_told_of_every_effect():
    """By the inertia matrices themselves, in any position."""
    world, changed = arm("motors")[0], set()
    qpos = np.random.default_rng(0).uniform(-1, 1, world.model.nq)

    def inertia(model):
        data, out = mujoco.MjData(model), np.eye(model.nv)
        data.qpos[:] = qpos
        mujoco.mj_fwdPosition(model, data)
        for column in out:
            mujoco.mj_mulM(model, data, column, column.copy())
        return out

    for candidate in world.candidates:
        if candidate.place.kind != "sensor" and not world.adds_states(candidate):
            setting = {candidate: SIZES[candidate.effect.name]}
            model = rows.RowMap(world, [record(world)], setting).model
            if not np.allclose(inertia(model), inertia(world.model), rtol=1e-9):
                changed.add(candidate.effect.name)
                assert not _as_heavy(model, world.model), candidate
    assert changed >= {"mass", "center_of_mass", "armature", "coupled_inertia", "link_length"}


def test_forces_that_are_left_move_a_lighter_arm_farther():
    """All of its forces and its mass halved, an arm is predicted as before, and errs as much."""
    push = lambda time, q, v: -0.1 * np.tanh(v / 0.01)
    runs = [recorded(f"{k}.csv", k, push=push, seconds=8.0) for k in range(2)]
    world = World(mujoco.MjSpec.from_string(DRIVEN_PENDULUM.format(damping=0.05, mass=0.5)))
    smoother = Smoother(world, runs)
    path, noise = smoother.locate({}), np.array([NOISE])
    chain, ahead = Chain(world, cut_ahead(runs), noise), Ahead(world, cut_ahead(runs), noise)
    chain.start(path)
    ahead.start(path)
    halves = {("mass", "arm"): 0.5, ("gain", "drive"): 1.0, ("viscous_damping", "pivot"): 0.05}
    halves = {world.candidate(*c): 0.5 * value for c, value in halves.items()}
    columns = Columns(chain, {}, Starts(world, {}, Usual(world, runs, smoother.scale)).of(halves))
    options = {o.candidate: o for o in columns.options if not o.whole}
    assert options.keys() == halves.keys()
    evidence = columns.evidence()
    index = [k for o in options.values() for k in o.columns]
    heavier = evidence.heavier[index, 0]
    each = zip(options.values(), (halves[c] for c in options))
    fixed = np.array([(v - o.base[0]) / o.directions[0, 0] for o, v in each])
    free = np.zeros(3)
    score = evidence.score(index, fixed, fixed, free, free)
    simulated = ahead.residual([{}, {c: (v,) for c, v in halves.items()}])
    other = Evidence(ahead, simulated[1], reference=Evidence(ahead, simulated[0]).reference)
    lost = other.at((), np.zeros(0)).loss
    assert abs(lost) < 1e-6 and abs(score.loss) < 0.1
    assert 1 + heavier @ fixed == pytest.approx(0.5)
    assert evidence.at(index, fixed).loss < -0.5  # as columns alone have it
