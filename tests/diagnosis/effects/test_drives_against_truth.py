"""Drives on a two-joint arm: the simulator against the trials' true system, which shares no code
with it.

Its laws are integrated by themselves at a tenth of the step; at the law's own values the effect of
that name predicts its motion, and the nominal model does not.
"""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from plants import commanded

from diagnosis.effects.base import joints_of
from diagnosis.simulation.simulator import Window, World
from diagnosis.trials import laws as L
from diagnosis.trials.mjcf import to_mjcf
from diagnosis.trials.robots import Actuator, Link, Robot
from diagnosis.trials.truth import TrueSystem

ROWS, DT = 60, 0.01
MOTORS = (
    Actuator("drive0", 0, "motor", 1.0, 1.0, 9.0),
    Actuator("drive1", 1, "motor", 1.0, 1.0, 4.0),
)
SERVOS = tuple(replace(a, kind="position", kp=12.0, kv=0.3) for a in MOTORS)


def robot(actuators):
    """Two links that swing under gravity about parallel axes, with rotors and damping."""
    first = Link(
        "link0",
        -1,
        "hinge",
        (0.0, 1.0, 0.0),
        (0.0, 0.0, 0.0),
        (0.0, 1.0, 0.0, 0.0),
        0.3,
        0.03,
        0.8,
        (0.0, 0.0, 0.15),
        (0.01, 0.01, 0.002),
        armature=0.02,
        damping=0.1,
    )
    second = replace(
        first,
        name="link1",
        parent=0,
        position=(0.0, 0.0, 0.3),
        quaternion=(1.0, 0.0, 0.0, 0.0),
        mass=0.4,
        center_of_mass=(0.0, 0.0, 0.12),
        inertia=(0.004, 0.004, 0.001),
    )
    return Robot((first, second), actuators, 0.001, 1e-4, "implicitfast")


def excited():
    time = np.arange(ROWS) * DT
    ctrl = np.stack([1.5 * np.sin(7 * time), 0.6 * np.sin(11 * time + 1)], axis=1)
    return commanded(time, ctrl, 2)


def true_motion(machine, laws, recording, start):
    system = TrueSystem(machine, laws)
    system.reset(*start)
    out = [system.reading()]
    for u in recording.ctrl[:-1]:
        system.advance(u, DT)
        out.append(system.reading())
    return np.array([q for q, _ in out])


CASES = {
    "load_friction": (
        MOTORS,
        L.LoadFriction(1, driving=0.4, driven=0.25),
        "joint1",
        (0.4, 0.25, 0.0),
    ),
    "load_friction of a servo": (
        SERVOS,
        L.LoadFriction(0, driving=0.3, driven=0.3),
        "joint0",
        (0.3, 0.3, 0.0),
    ),
    "friction_map": (
        MOTORS,
        L.FrictionMap(1, level=0.1, contrast=0.8, waves=4.0, phase=0.5),
        "joint1",
        (0.1, 0.8, 4.0, 0.5),
    ),
    "presliding": (
        MOTORS,
        L.Presliding(1, frictionloss=0.12, stiffness=2.0),
        "joint1",
        (0.12, 2.0),
    ),
    "joint_elasticity": (
        MOTORS,
        L.JointElasticity(1, stiffness=1.5, damping=0.02),
        "joint1",
        (1.5, 0.02),
    ),
    "rate_limit": (SERVOS, L.RateLimit(1, actuator=1, rate=3.0), "drive1", (3.0,)),
    "torque_speed": (MOTORS, L.TorqueSpeed(1, slope=0.15, stall=0.5), "drive1", (0.15, 0.5)),
    "gain_fade": (SERVOS, L.GainFade(1, rate=0.8), "drive1", (0.8,)),
    "dead_zone": (SERVOS, L.DeadZone(1, actuator=1, width=0.3, servo=True), "drive1", (0.3,)),
    "lag": (MOTORS, L.Lag(1, actuator=1, seconds=0.03), "drive1", (0.03,)),
    "coupled_friction": (
        MOTORS,
        L.CoupledFriction(1, other=0, level=0.15, creep=1e-3),
        "joint0+joint1",
        (0.15,),
    ),
    "coupled_inertia": (
        MOTORS,
        L.CoupledInertia(1, other=0, inertia=0.03),
        "joint0+joint1",
        (0.03,),
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_an_effect_is_the_law_of_its_name(case):
    actuators, law, place, values = CASES[case]
    machine, recording = robot(actuators), excited()
    world = World(mujoco.MjSpec.from_string(to_mjcf(machine)))
    start = np.array([0.4, -0.3]), np.zeros(2)
    truth = true_motion(machine, [law], recording, start)
    candidate = world.candidate(case.partition(" ")[0], place)
    settings, windows = [{candidate: values}, {}], [Window(recording, 0, ROWS - 1)] * 2
    starts = (np.tile(x, (2, 1)) for x in start)
    qpos, nominal = world.simulate(settings, *starts, windows, refine=5)[0]
    size = abs(nominal - truth).max()
    assert size > 0.02
    assert abs(qpos - truth).max() < 0.05 * size


def test_two_joints_by_their_names():
    model = World(mujoco.MjSpec.from_string(to_mjcf(robot(MOTORS)))).model
    assert joints_of(model, "joint0+joint1") == (0, 1) and joints_of(model, "joint1") == (1,)
    with pytest.raises(KeyError, match="no joint joint1\\+elbow"):
        joints_of(model, "joint1+elbow")
