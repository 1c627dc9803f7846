"""Mechanisms to hide effects in: a nominal MJCF, an experiment, and where each effect can sit.

    mechanism = MECHANISMS["arm2"]
    model = mechanism.spec().compile()
    control = mechanism.controller(numpy.random.default_rng(0), model)
    u = control(0.01, qpos_measured)          # (nu,)

All are small machines one could build: each is excited for a few seconds by sines, steps or a
chirp, open-loop or through a feedback that sees only the noisy positions.
"""

from dataclasses import dataclass
from pathlib import Path

import gymnasium
import mujoco
import numpy as np

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"

PENDULUM = """
<mujoco model="pendulum">
  <option timestep="0.002"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="arm" pos="0 0 1">
      <joint name="pivot" type="hinge" axis="0 1 0" damping="0.02"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.4" size="0.01" mass="0.2"/>
      <geom name="bob" type="sphere" pos="0 0 -0.4" size="0.05" mass="0.5"/>
    </body>
  </worldbody>
  <actuator><motor name="drive" joint="pivot" ctrllimited="true" ctrlrange="-3 3"/></actuator>
</mujoco>"""

CART_POLE = """
<mujoco model="cart_pole">
  <option timestep="0.0025"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="cart" pos="0 0 1">
      <joint name="rail" type="slide" axis="1 0 0" damping="0.5"/>
      <geom name="cart" type="box" size="0.1 0.05 0.05" mass="1"/>
      <body name="pole">
        <joint name="hinge" type="hinge" axis="0 1 0" damping="0.002"/>
        <geom name="pole" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.3"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="drive" joint="rail" gear="10" ctrllimited="true" ctrlrange="-2 2"/></actuator>
</mujoco>"""

ARM2 = """
<mujoco model="arm2">
  <option timestep="0.002"/>
  <default><geom contype="0" conaffinity="0"/><joint damping="0.05" armature="0.01"/></default>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" type="hinge" axis="0 1 0"/>
      <geom name="upper" type="capsule" fromto="0 0 0 0 0 -0.35" size="0.03" mass="1"/>
      <body name="fore" pos="0 0 -0.35">
        <joint name="elbow" type="hinge" axis="0 1 0"/>
        <geom name="fore" type="capsule" fromto="0 0 0 0 0 -0.3" size="0.025" mass="0.6"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder_motor" joint="shoulder" ctrllimited="true" ctrlrange="-12 12"/>
    <motor name="elbow_motor" joint="elbow" ctrllimited="true" ctrlrange="-6 6"/>
  </actuator>
</mujoco>"""

SERVO_ARM = """
<mujoco model="servo_arm">
  <option timestep="0.002" integrator="implicitfast"/>
  <default><geom contype="0" conaffinity="0"/><joint damping="0.1" armature="0.02"/></default>
  <worldbody>
    <body name="base" pos="0 0 0.5">
      <joint name="yaw" type="hinge" axis="0 0 1"/>
      <geom name="base" type="cylinder" size="0.06 0.05" mass="1"/>
      <body name="upper" pos="0 0 0.05">
        <joint name="pitch" type="hinge" axis="0 1 0"/>
        <geom name="upper" type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="0.8"/>
        <body name="fore" pos="0.3 0 0">
          <joint name="elbow" type="hinge" axis="0 1 0"/>
          <geom name="fore" type="capsule" fromto="0 0 0 0.25 0 0" size="0.025" mass="0.5"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="yaw_servo" joint="yaw" kp="25" kv="1.5"/>
    <position name="pitch_servo" joint="pitch" kp="60" kv="3"/>
    <position name="elbow_servo" joint="elbow" kp="25" kv="1"/>
  </actuator>
</mujoco>"""

FURUTA = """
<mujoco model="furuta">
  <option timestep="0.002"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="arm" pos="0 0 1">
      <joint name="arm" type="hinge" axis="0 0 1" damping="0.01" armature="0.002"/>
      <geom name="arm" type="capsule" fromto="0 0 0 0.25 0 0" size="0.01" mass="0.25"/>
      <body name="pendulum" pos="0.25 0 0">
        <joint name="pendulum" type="hinge" axis="1 0 0" damping="0.0005"/>
        <geom name="pendulum" type="capsule" fromto="0 0 0 0 0 -0.3" size="0.008" mass="0.15"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="drive" joint="arm" ctrllimited="true" ctrlrange="-1 1"/></actuator>
</mujoco>"""

GANTRY = """
<mujoco model="gantry">
  <option timestep="0.002" integrator="implicitfast"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="trolley" pos="0 0 2">
      <joint name="trolley" type="slide" axis="1 0 0" damping="2" armature="0.5"/>
      <geom name="trolley" type="box" size="0.1 0.1 0.05" mass="3"/>
      <body name="load">
        <joint name="cable" type="hinge" axis="0 1 0" damping="0.005"/>
        <geom name="bar" type="capsule" fromto="0 0 0 0 0 -0.7" size="0.005" mass="0.1"/>
        <geom name="load" type="sphere" pos="0 0 -0.7" size="0.06" mass="1.5"/>
      </body>
    </body>
  </worldbody>
  <actuator><velocity name="trolley_servo" joint="trolley" kv="40"/></actuator>
</mujoco>"""

SAIL = """
<mujoco model="sail">
  <option timestep="0.004" density="1.2"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="sail" pos="0 0 1">
      <joint name="mast" type="hinge" axis="0 1 0" damping="0.001"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.6" size="0.004" mass="0.03"/>
      <geom name="sheet" type="box" pos="0 0 -0.45" size="0.002 0.15 0.15" mass="0.04"/>
    </body>
  </worldbody>
  <actuator><motor name="drive" joint="mast" ctrllimited="true" ctrlrange="-0.5 0.5"/></actuator>
</mujoco>"""

SLIDER = """
<mujoco model="slider">
  <option timestep="0.002" cone="elliptic" impratio="20"/>
  <default><geom solref="-4000 -90" solimp="0.95 0.99 0.001"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1" friction="0.5 0.005 0.0001"/>
    <body name="block" pos="0 0 0.05">
      <joint name="x" type="slide" axis="1 0 0" damping="0.3"/>
      <joint name="z" type="slide" axis="0 0 1" damping="0.3"/>
      <geom name="block" type="box" size="0.08 0.08 0.05" mass="1" friction="0.5 0.005 0.0001"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="push" joint="x" gear="10" ctrllimited="true" ctrlrange="-2 2"/>
    <motor name="lift" joint="z" gear="10" ctrllimited="true" ctrlrange="-2 2"/>
  </actuator>
</mujoco>"""

BALL = """
<mujoco model="ball">
  <option timestep="0.002" density="1.2"/>
  <default><geom solref="-6000 -12" solimp="0.95 0.99 0.001" friction="0.6 0.005 0.0001"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="20 20 0.1"/>
    <body name="ball" pos="0 0 1.5">
      <freejoint name="ball"/>
      <geom name="ball" type="sphere" size="0.12" mass="0.15"/>
    </body>
  </worldbody>
</mujoco>"""

CONTROL_EFFECTS = ("gain", "bias", "delay", "lag", "saturation", "back_emf", "dead_zone")
JOINT_EFFECTS = (
    "armature",
    "viscous_damping",
    "quadratic_damping",
    "coulomb_friction",
    "stribeck_friction",
    "stiffness",
    "nonlinear_stiffness",
    "spring_offset",
)
CONTACT_EFFECTS = ("contact_friction", "contact_stiffness", "contact_damping", "ground_height")
SENSOR_EFFECTS = ("sensor_bias", "sensor_scale", "sensor_delay")
UNKNOWNS = ("friction_patch", "periodic_torque", "detent", "one_way_drag", "fading_gain")


@dataclass(frozen=True)
class Mechanism:
    """One machine and its experiment.

    interval: seconds between recorded rows; seconds: length of each recording; train, held_out:
    how many recordings; amplitude: of the open-loop control or, with gains, of the reference
    followed; gains: (kp, kd) of the feedback, per actuator; frequency: of the excitation, Hz;
    places: {effect: names of joints, bodies, geoms or actuators}.
    """

    name: str
    places: dict
    xml: str | None = None
    env: tuple[str, str] | None = None  # gymnasium id, asset file
    interval: float = 0.01
    seconds: float = 4.0
    train: int = 3
    held_out: int = 1
    amplitude: tuple = ()
    gains: tuple | None = None
    frequency: tuple = (0.2, 2.0)

    def spec(self):
        """A fresh mujoco.MjSpec of the nominal model."""
        if self.xml is not None:
            return mujoco.MjSpec.from_string(self.xml)
        return mujoco.MjSpec.from_file(str(ASSETS / self.env[1]))

    def start(self, rng, model):
        """Initial qpos (nq,) and qvel (nv,)."""
        qpos, qvel = model.qpos0.copy(), np.zeros(model.nv)
        if self.name == "ball":
            qpos[2] = rng.uniform(0.5, 1.2)
            qvel[:3] = rng.uniform([1, -2, -1], [4, 2, 2])
            qvel[3:] = rng.uniform(-15, 15, 3)
        elif self.name == "slider":
            qpos[1] = rng.uniform(0.05, 0.3)
        elif self.name.startswith("inverted_pendulum"):
            qpos[1] = rng.uniform(-0.15, 0.15)
        elif self.name == "half_cheetah":
            qpos[:] += rng.uniform(-0.1, 0.1, model.nq)
            qvel[:] = rng.normal(0, 0.1, model.nv)
        elif self.name in ("pendulum", "sail", "cart_pole", "gantry"):
            qpos[-1] = rng.uniform(-1.2, 1.2)
        return qpos, qvel

    def controller(self, rng, model):
        """A function (seconds, measured qpos (nq,)) -> ctrl (nu,), excited as `rng` draws."""
        signal = excitation(rng, model.nu, self.frequency)
        limited = model.actuator_ctrllimited.astype(bool)
        low = np.where(limited, model.actuator_ctrlrange[:, 0], -np.inf)
        high = np.where(limited, model.actuator_ctrlrange[:, 1], np.inf)
        amplitude = np.asarray(self.amplitude) * rng.uniform(0.7, 1.2)
        if self.name == "hopper":
            law = stand_and_bounce(model, signal, amplitude)
        elif self.name.startswith("inverted_pendulum"):
            law = balance(signal, amplitude, np.array(self.gains))
        elif self.gains is None:
            law = lambda t, qpos, qvel: amplitude * signal(t)
        else:
            driven = model.jnt_qposadr[model.actuator_trnid[:, 0]]
            kp, kd = np.asarray(self.gains, dtype=float)
            law = lambda t, qpos, qvel: (
                kp * (amplitude * signal(t) - qpos[driven]) - kd * qvel[driven]
            )
        last = [None, None, np.zeros(model.nq)]  # time, qpos, filtered velocity

        def control(t, qpos):
            if last[0] is not None and t > last[0]:
                last[2] = last[2] + 0.5 * ((qpos - last[1]) / (t - last[0]) - last[2])
            last[0], last[1] = t, np.array(qpos)
            return np.clip(law(t, qpos, last[2]), low, high)

        return control


def excitation(rng, width, frequency):
    """A random signal of about unit amplitude: seconds -> (width,), faded in over 0.3 s."""
    low, high = frequency
    kind = rng.choice(["sines", "steps", "chirp"])
    if kind == "sines":
        hertz = rng.uniform(low, high, (width, 4))
        phase = rng.uniform(0, 2 * np.pi, (width, 4))
        shape = lambda t: 0.6 * np.sin(2 * np.pi * hertz * t + phase).sum(1)
    elif kind == "steps":
        length = rng.uniform(0.3, 0.7) / high
        levels = rng.uniform(-1.2, 1.2, (512, width))
        shape = lambda t: levels[int(t / length) % 512]
    else:
        rate = rng.uniform(0.3, 1.0, width) * (high - low) / 8.0
        phase = rng.uniform(0, 2 * np.pi, width)
        shape = lambda t: 1.1 * np.sin(2 * np.pi * (low + rate * t / 2) * t + phase)
    return lambda t: shape(t) * min(1.0, t / 0.3)


def balance(signal, amplitude, gain):
    """Keeps the inverted pendulum's pole up while the cart is shaken. gain: of x, angle, and their rates."""
    return lambda t, qpos, qvel: gain @ np.concatenate((qpos, qvel)) + amplitude * signal(t)


def stand_and_bounce(model, signal, amplitude):
    """Holds Hopper's centre of mass over its foot while hip, knee and ankle follow the excitation."""
    data = mujoco.MjData(model)
    torso, foot = model.body("torso").id, model.geom("foot_geom").id
    gain = np.array([[24.0, -145.0, -4.0, -26.0], [-366.0, -100.0, -81.0, 6.0]])  # random search
    pose = np.array([-0.2, -0.4, 0.0])  # a crouch, rad

    def law(t, qpos, qvel):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        lean = data.subtree_com[torso, 0] - data.geom_xpos[foot, 0]
        target = pose * min(1.0, 2 * t) + amplitude * signal(t)
        torque = 150 * (target - qpos[3:]) - 8 * qvel[3:]
        torque[[0, 2]] += gain @ np.array([lean, qvel[0], qpos[2], qvel[2]])
        return torque / 200

    return law


def _places(joints, driven, actuators, bodies, limbs=(), **more):
    """The usual places: every joint, the driven ones, the actuators, the bodies with mass."""
    places = {effect: joints for effect in JOINT_EFFECTS + SENSOR_EFFECTS}
    places |= {effect: actuators for effect in CONTROL_EFFECTS}
    turning = tuple(body for body in bodies if body not in ("cart", "trolley", "block"))
    places |= {
        "cogging": driven,
        "joint_stop": driven,
        "mass": bodies,
        "center_of_mass": turning,
        "inertia": turning,
        "external_force": bodies,
        "payload_change": bodies,
        "link_length": limbs,
        "gravity": ("world",),
        "time_step": ("world",),
    }
    places |= {unknown: joints for unknown in UNKNOWNS}
    places["fading_gain"] = driven
    places |= more
    return {effect: names for effect, names in places.items() if names}


HOPPER_JOINTS = ("thigh_joint", "leg_joint", "foot_joint")
HOPPER_BODIES = ("torso", "thigh", "leg", "foot")
CHEETAH_JOINTS = ("bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot")

MECHANISMS = {
    mechanism.name: mechanism
    for mechanism in (
        Mechanism(
            "pendulum",
            _places(("pivot",), ("pivot",), ("drive",), ("arm",)),
            xml=PENDULUM,
            amplitude=(1.6,),
            seconds=5.0,
        ),
        Mechanism(
            "cart_pole",
            _places(("rail", "hinge"), ("rail",), ("drive",), ("cart", "pole")),
            xml=CART_POLE,
            amplitude=(0.35,),
            gains=([3.0], [0.8]),
        ),
        Mechanism(
            "arm2",
            _places(
                ("shoulder", "elbow"),
                ("shoulder", "elbow"),
                ("shoulder_motor", "elbow_motor"),
                ("upper", "fore"),
                ("fore",),
                backlash=("shoulder", "elbow"),
            ),
            xml=ARM2,
            amplitude=(0.8, 1.0),
            gains=([15.0, 6.0], [1.2, 0.4]),
        ),
        Mechanism(
            "servo_arm",
            _places(
                ("yaw", "pitch", "elbow"),
                ("yaw", "pitch", "elbow"),
                ("yaw_servo", "pitch_servo", "elbow_servo"),
                ("upper", "fore"),
                ("fore",),
                backlash=("yaw", "elbow"),
            ),
            xml=SERVO_ARM,
            amplitude=(0.8, 0.6, 0.8),
            train=2,
        ),
        Mechanism(
            "furuta",
            _places(("arm", "pendulum"), ("arm",), ("drive",), ("pendulum",), ("pendulum",)),
            xml=FURUTA,
            amplitude=(0.8,),
            gains=([0.35], [0.05]),
        ),
        Mechanism(
            "gantry",
            _places(("trolley", "cable"), ("trolley",), ("trolley_servo",), ("trolley", "load")),
            xml=GANTRY,
            amplitude=(0.6,),
            frequency=(0.2, 1.2),
        ),
        Mechanism(
            "sail",
            _places(
                ("mast",), ("mast",), ("drive",), ("sail",), air_drag=("world",), wind=("world",)
            ),
            xml=SAIL,
            amplitude=(0.12,),
            interval=0.012,
        ),
        Mechanism(
            "slider",
            _places(
                ("x", "z"),
                ("x",),
                ("push",),
                ("block",),
                joint_stop=(),
                **dict.fromkeys(CONTACT_EFFECTS, ("block",))
                | {"ground_height": ("floor",), "gravity": ()},
            ),
            xml=SLIDER,
            amplitude=(1.1, 0.9),
            frequency=(0.5, 2.0),
        ),
        Mechanism(
            "ball",
            dict.fromkeys(CONTACT_EFFECTS, ("ball",))
            | {
                "ground_height": ("floor",),
                "air_drag": ("world",),
                "wind": ("world",),
                "gravity": ("world",),
                "time_step": ("world",),
                "external_force": ("ball",),
            },
            xml=BALL,
            seconds=1.3,
            train=4,
            held_out=2,
        ),
        Mechanism(
            "inverted_pendulum",
            _places(("slider", "hinge"), (), ("slide",), ("cart", "pole")),
            env=("InvertedPendulum-v4", "inverted_pendulum.xml"),
            interval=0.04,
            seconds=6.0,
            train=1,
            amplitude=(0.3,),
            gains=(0.2, 3.5, 0.4, 1.0),
            frequency=(0.2, 1.2),
        ),
        Mechanism(
            "inverted_pendulum_firm",
            {},  # holds a pole of 100 kg, for that trial alone
            env=("InvertedPendulum-v4", "inverted_pendulum.xml"),
            interval=0.04,
            seconds=6.0,
            train=1,
            amplitude=(0.15,),
            gains=(0.15, 15.0, 0.47, 3.9),
            frequency=(0.2, 1.2),
        ),
        Mechanism(
            "hopper",
            _places(
                HOPPER_JOINTS,
                (),
                ("0", "1", "2"),
                HOPPER_BODIES,
                (),
                contact_friction=("foot_geom",),
                ground_height=("floor",),
            ),
            env=("Hopper-v4", "hopper.xml"),
            interval=0.008,
            seconds=4.0,
            train=1,
            amplitude=(0.1, 0.2, 0.1),
            frequency=(0.5, 2.5),
        ),
        Mechanism(
            "half_cheetah",
            _places(CHEETAH_JOINTS, (), CHEETAH_JOINTS, ("torso", *CHEETAH_JOINTS)),
            env=("HalfCheetah-v4", "half_cheetah.xml"),
            interval=0.05,
            seconds=8.0,
            train=1,
            amplitude=(0.5,) * 6,
            frequency=(0.5, 3.0),
        ),
    )
}
