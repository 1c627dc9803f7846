"""Sim and "real" in batches: gymnasium's MuJoCo tasks on `mujoco.batch`.

    sim = BatchEnv("Hopper-v4", num_envs=32)
    real = BatchEnv("Hopper-v4", num_envs=32, perturbation=parse_perturbation("torso:mass*1.27"))
    obs, _ = sim.reset(seed=0)
    obs, reward, terminated, truncated, info = sim.step(actions)  # info["next_obs"]: before resets

Every environment of a batch is one row of a `mujoco.batch.Batch`, so a step is one call on all
cores. Observations, rewards, ends and resets equal `gymnasium.make(id)`, seed for seed.
"""

import copy
import importlib.util
import re
from dataclasses import dataclass, replace
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from mujoco.batch import Batch


class EnvError(ValueError):
    """A request about an environment that cannot be met; the message says what to do instead."""


# --- the three tasks of the paper -----------------------------------------------------------------


@dataclass(frozen=True)
class Task:
    """What gymnasium's environment class adds to the MJCF file; a subclass changes what it must.

    xml, frame_skip: the model and the physics steps per action. skip_root_x: how many of the first
    qpos observations leave out. clip_velocity: bound on observed qvel. reset_noise: half-width of
    the uniform start noise; normal_qvel draws qvel from a normal instead. forward_weight,
    ctrl_weight, healthy_reward: the reward's terms; pays_on_end: the last of them is paid for the
    step that falls too (None: in v4, not in v5). time_limit: steps of an episode (0: gymnasium's
    1000). real: the perturbation that makes the paper's "real" world.
    """

    xml: str
    frame_skip: int
    reset_noise: float
    real: str
    skip_root_x: int = 1
    clip_velocity: float = np.inf
    normal_qvel: bool = False
    forward_weight: float = 1.0
    ctrl_weight: float = 0.0
    healthy_reward: float = 0.0
    pays_on_end: bool | None = None
    time_limit: int = 0

    def unhealthy(self, qpos, qvel):
        """Which of the states (N, nq), (N, nv) end an episode: (N,) bool."""
        return np.zeros(len(qpos), bool)

    def observe(self, qpos, qvel):
        """Observations (N, nobs) of states (N, nq), (N, nv), as gymnasium's _get_obs."""
        return np.concatenate(
            (qpos[:, self.skip_root_x :], np.clip(qvel, -self.clip_velocity, self.clip_velocity)),
            axis=1,
        )

    def state(self, obs, model):
        """qpos (N, nq) and qvel (N, nv) of observations, what they leave out being 0: the inverse
        of observe."""
        position, velocity = np.split(obs, [model.nq - self.skip_root_x], axis=1)
        return np.pad(position, ((0, 0), (self.skip_root_x, 0))), velocity

    def start(self, rng, model):
        """qpos (nq,) and qvel (nv,) that an episode begins with, in gymnasium's order of draws."""
        noise = self.reset_noise
        qpos = model.qpos0 + rng.uniform(-noise, noise, model.nq)
        if self.normal_qvel:
            return qpos, noise * rng.standard_normal(model.nv)
        return qpos, rng.uniform(-noise, noise, model.nv)

    def place(self, env):
        """Where each robot is, (N,) m: its speed is what forward_weight pays."""
        return env.qpos[:, 0].copy()

    def reward(self, env, actions, speed, ended):
        """The rewards (N,) of a step: actions (N, nu) as the policy chose them, speed (N,) of
        place(), ended (N,) bool: the episodes that this step terminated."""
        paid = np.zeros(len(speed))
        if self.forward_weight:
            paid += self.forward_weight * speed
        if self.healthy_reward:
            on_end = env.env_id.endswith("v4") if self.pays_on_end is None else self.pays_on_end
            paid += self.healthy_reward if on_end else self.healthy_reward * ~ended
        if self.ctrl_weight:
            paid -= self.ctrl_weight * np.square(actions).sum(axis=1)
        return paid


class InvertedPendulum(Task):
    """The pole on a cart: an episode ends where it leans."""

    def unhealthy(self, qpos, qvel):
        finite = np.isfinite(qpos).all(1) & np.isfinite(qvel).all(1)
        return ~finite | (np.abs(qpos[:, 1]) > 0.2)


class Hopper(Task):
    """The hopper: an episode ends where it sinks, leans, or is thrown about."""

    def unhealthy(self, qpos, qvel):
        state = np.concatenate((qpos[:, 2:], qvel), axis=1)
        healthy = ((-100.0 < state) & (state < 100.0)).all(1)
        return ~(healthy & (0.7 < qpos[:, 1]) & (-0.2 < qpos[:, 2]) & (qpos[:, 2] < 0.2))


TASKS = {
    "InvertedPendulum": InvertedPendulum(
        "inverted_pendulum.xml",
        2,
        0.01,
        "pole:mass=100",
        skip_root_x=0,
        forward_weight=0.0,
        healthy_reward=1.0,
    ),
    "Hopper": Hopper(
        "hopper.xml",
        4,
        5e-3,
        "torso:mass*1.27",
        clip_velocity=10.0,
        ctrl_weight=1e-3,
        healthy_reward=1.0,
    ),
    "HalfCheetah": Task(
        "half_cheetah.xml", 5, 0.1, "torso:mass*1.15", normal_qvel=True, ctrl_weight=0.1
    ),
}
ENV_IDS = [f"{name}-{version}" for name in TASKS for version in ("v4", "v5")]
TIME_LIMIT = 1000  # steps, as registered in gymnasium for all three
UNSTABLE = ("QPOS", "QVEL", "QACC", "CTRL")  # MuJoCo's warnings of NaN and huge values


def task_of(env_id):
    """The Task of a gymnasium id such as "Hopper-v4", or of a user's file that was loaded. Raises
    EnvError for any other id."""
    if env_id not in ENV_IDS:
        raise EnvError(f"unknown environment {env_id!r}: choose one of {', '.join(ENV_IDS)}")
    return TASKS[robot_of(env_id)]


def robot_of(env_id):
    """An id's name in TASKS: what stands before its version; a user's file may have a hyphen."""
    return env_id if env_id in TASKS else env_id.split("-")[0]


def load_task(path):
    """Make the TASK of a user's file known under the file's name. Returns the name and the file's
    module; raises whatever the file raises."""
    path = Path(path)
    name = path.stem
    spec = importlib.util.spec_from_file_location(f"task_{name}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    TASKS[name] = replace(module.TASK, xml=str((path.parent / module.TASK.xml).resolve()))
    ENV_IDS.append(name) if name not in ENV_IDS else None
    return name, module


def model_path(env_id):
    """Path of the MJCF file that gymnasium ships for env_id."""
    return Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / task_of(env_id).xml


# --- the "real" world: the sim with named changes -------------------------------------------------

JOINT_FIELDS = {
    "damping": "dof_damping",
    "frictionloss": "dof_frictionloss",
    "armature": "dof_armature",
}
FIELDS = ("mass", *JOINT_FIELDS, "gain", "gravity")


@dataclass(frozen=True)
class Change:
    """One edit of a model: a field of a body, joint or actuator is set to, or scaled by, value."""

    name: str
    field: str
    op: str  # "=" sets, "*" scales
    value: float

    def of(self, old):
        """The new value for an old one, floats. Raises EnvError where it is none."""
        new = self.value if self.op == "=" else float(old) * self.value
        if not np.isfinite(new):
            raise EnvError(
                f"{self.name}:{self.field}*{self.value:g} makes {new} of {old:g}: "
                "choose a smaller factor"
            )
        return new


def parse_perturbation(text):
    """ "torso:mass*1.27,foot_joint:frictionloss=0.5" -> list of Change.

    Fields: mass (of a body), damping, frictionloss, armature (of a joint), gain (of an actuator, or
    of the actuator on a named joint), gravity ("world:gravity*0.9": the downward acceleration). ""
    is no change. Raises EnvError if it does not parse.
    """
    changes = []
    for part in filter(None, (part.strip() for part in text.split(","))):
        match = re.fullmatch(r"([^:]+):(\w+)\s*([=*])\s*(\S+)", part)
        try:
            name, field, op, value = match.groups()
            value = float(value)
        except (AttributeError, ValueError):
            form = "NAME:FIELD=VALUE or NAME:FIELD*FACTOR, e.g. torso:mass*1.27"
            raise EnvError(f"cannot read {part!r}: write {form}") from None
        if field not in FIELDS:
            raise EnvError(
                f"unknown field {field!r} in {part!r}: choose one of {', '.join(FIELDS)}"
            )
        if (
            not np.isfinite(value)
            or (field == "mass" and value <= 0)
            or (field in JOINT_FIELDS and value < 0)
        ):
            raise EnvError(
                f"{part!r}: {value:g} is no possible {field}: "
                f"give a finite{' positive' * (field == 'mass')} number"
            )
        changes.append(Change(name.strip(), field, op, value))
    return changes


def _id_of(model, kind, change):
    count = {"body": model.nbody, "joint": model.njnt, "actuator": model.nu}[kind]
    names = [getattr(model, kind)(i).name for i in range(count)]
    if change.name in names:
        return names.index(change.name)
    known = ", ".join(name for name in names if name and name != "world")
    raise EnvError(f"no {kind} {change.name!r} for its {change.field}: choose one of {known}")


def perturb(model, changes):
    """A copy of a compiled mujoco.MjModel with Changes applied.

    Inertia scales along with mass, and mj_setConst renews what MuJoCo derives from both. Editing
    the compiled model rather than its XML matters for HalfCheetah, whose compiler rescales every
    edit to a total of 14 kg. A servo's gain stands in its bias too: both scale, and it still goes
    where it is told.
    Raises EnvError for a name that the model lacks.
    """
    model = copy.copy(model)
    for change in changes:
        if change.field == "mass":
            body = _id_of(model, "body", change)
            old = model.body_mass[body]
            if old == 0:
                raise EnvError(f"body {change.name!r} has no mass of its own: name a body that has")
            model.body_inertia[body] *= change.of(old) / old
            model.body_mass[body] = change.of(old)
        elif change.field == "gravity":
            if change.name != "world":
                raise EnvError(
                    f"gravity belongs to the world: write world:gravity{change.op}{change.value:g}"
                )
            # acceleration is positive downwards here, so that "=9.81" is the Earth's
            model.opt.gravity[2] = -change.of(-model.opt.gravity[2])
        elif change.field == "gain":
            joints = [model.joint(j).name for j in model.actuator_trnid[:, 0]]
            actuators = [
                i for i in range(model.nu) if change.name in (model.actuator(i).name, joints[i])
            ]
            if not actuators:
                raise EnvError(
                    f"no actuator {change.name!r} for its gain: "
                    f"name its joint, one of {', '.join(joints)}"
                )
            for i in actuators:
                old = model.actuator_gainprm[i, 0]
                model.actuator_biasprm[i, :3] *= change.of(old) / old if old else 1.0
                model.actuator_gainprm[i, 0] = change.of(old)
        else:
            joint = _id_of(model, "joint", change)
            dofs = np.flatnonzero(model.dof_jntid == joint)
            field = getattr(model, JOINT_FIELDS[change.field])
            field[dofs] = [change.of(old) for old in field[dofs]]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


# --- the environment ------------------------------------------------------------------------------


class BatchEnv(VectorEnv):
    """num_envs copies of a gymnasium task, stepped together; see the module's docstring.

    An ended episode starts anew within the same step (AutoresetMode.SAME_STEP): the returned
    observation is the new episode's first, and info["next_obs"] (num_envs, nobs) holds every
    transition's true successor.

    Args:
      env_id: one of ENV_IDS. num_envs: copies. perturbation: Changes that make this world "real".
      model: a mujoco.MjModel to run instead of gymnasium's own: the same
      joints, and its actuators first.
      nthread: threads of the simulator's pool, 0 for all cores.
    Where a step is unstable (NaN or huge values), as a robot thrown about by a bad policy can make
    it, that robot's episode terminates where it last was, unpaid.
    counterfactual_steps: how many steps were simulated from here without
    being taken (peek, predict).
    Raises EnvError: unknown id or name, num_envs < 1, or (in step) every
    simulation unstable at once.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}

    def __init__(self, env_id, num_envs, perturbation=(), model=None, nthread=0):
        if num_envs < 1:
            raise EnvError(f"num_envs is {num_envs}: it must be at least 1")
        self.task = task_of(env_id)
        self.env_id, self.num_envs = env_id, num_envs
        self.spec = gymnasium.spec(env_id) if env_id in gymnasium.registry else None
        nominal = mujoco.MjModel.from_xml_path(str(model_path(env_id)))
        self.model = nominal if model is None else model
        if self.model.nq != nominal.nq or self.model.nu < nominal.nu:
            sizes = (
                f"{self.model.nq} coordinates and {self.model.nu} actuators, "
                f"{env_id} has {nominal.nq} and {nominal.nu}"
            )
            raise EnvError(f"the given model has {sizes}: give one with the same joints")
        if perturbation:
            self.model = perturb(self.model, perturbation)
        self.dt = nominal.opt.timestep * self.task.frame_skip
        self.frame_skip = max(
            1, round(self.dt / self.model.opt.timestep)
        )  # a given model may take finer steps
        self.batch = Batch(self.model, num_envs, nthread)
        self.qpos, self.qvel, ctrl = (self.batch.bind(field) for field in ("qpos", "qvel", "ctrl"))
        self._ctrl = ctrl[:, : nominal.nu]
        self._peek = None
        self._rng = [None] * num_envs
        self.steps = np.zeros(num_envs, int)
        self.counterfactual_steps = 0

        self.task.place(self)  # what it reads is copied out of the batch from now on
        nobs = self.observe().shape[1]
        low, high = nominal.actuator_ctrlrange.astype(np.float32).T
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (nobs,), np.float64)
        self.single_action_space = gymnasium.spaces.Box(low, high, dtype=np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def observe(self):
        """The current observations, (num_envs, nobs)."""
        return self.task.observe(self.qpos, self.qvel)

    def reset(self, *, seed=None, options=None):
        """Start every environment anew; environment i draws from seed + i. Returns (obs, {})."""
        if seed is not None or self._rng[0] is None:
            seeds = (
                [None] * self.num_envs if seed is None else [seed + i for i in range(self.num_envs)]
            )
            self._rng = [seeding.np_random(s)[0] for s in seeds]
        self._restart(np.arange(self.num_envs))
        self.obs = self.observe()
        return self.obs.copy(), {}

    def _restart(self, ids):
        self.batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        for i in ids:
            self.qpos[i], self.qvel[i] = self.task.start(self._rng[i], self.model)
        self.batch.forward(ids)
        self.steps[ids] = 0

    def step(self, actions, applied=None):
        """Advance all environments by one action each.

        Args:
          actions: (num_envs, nu), what the policy chose; the reward is computed on it.
          applied: (num_envs, nu), what drives the joints, if an action transformer changed it.

        Returns:
          obs (num_envs, nobs), reward (num_envs,), terminated, truncated (num_envs,) bool, info
          with "next_obs" and, where episodes ended, gymnasium's "final_obs" and "_final_obs".
        """
        actions = np.asarray(actions)
        if actions.shape != self.action_space.shape:
            raise EnvError(
                f"actions have shape {actions.shape}: {self.env_id} takes {self.action_space.shape}"
            )
        before = self.task.place(self)
        self._ctrl[:] = actions if applied is None else applied
        self.batch.step(nstep=self.frame_skip)
        lost = self._unstable(self.batch)
        self.steps += 1

        terminated = self.task.unhealthy(self.qpos, self.qvel) | lost
        truncated = self.steps >= (self.task.time_limit or TIME_LIMIT)
        speed = (self.task.place(self) - before) / self.dt
        reward = self.task.reward(self, actions, speed, terminated)
        next_obs = self.observe()
        reward[lost], next_obs[lost] = 0.0, self.obs[lost]
        info = {"next_obs": next_obs}
        self.obs = next_obs
        done = terminated | truncated
        if done.any():
            ids = np.flatnonzero(done)
            info["final_obs"] = np.full(self.num_envs, None)
            for i in ids:
                info["final_obs"][i] = next_obs[i]
            info["_final_obs"] = done
            self._restart(ids)
            self.obs = self.observe()
        return self.obs.copy(), reward, terminated, truncated, info

    def predict(self, obs, applied):
        """The next observations, one step under applied from the states
        behind obs (num_envs, nobs).

        What an observation leaves out is set to 0 (root x) or taken as it stands (a clipped
        velocity). The environment must be reset afterwards.
        """
        qpos, qvel = self.task.state(obs, self.model)
        self.batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        self.qpos[:, self.task.skip_root_x :] = qpos[:, self.task.skip_root_x :]
        self.qvel[:] = qvel
        self.batch.forward()
        self.obs = self.observe()
        self._ctrl[:] = applied(self.obs) if callable(applied) else applied
        self.batch.step(nstep=self.frame_skip)
        self.counterfactual_steps += self.num_envs
        return np.where(self._unstable(self.batch)[:, None], self.obs, self.observe())

    def peek(self, actions):
        """The next observations, were actions taken from the present states; nothing moves."""
        if self._peek is None:
            self._peek = Batch(self.model, self.num_envs, self.batch.nthread)
        self._peek.state[:] = self.batch.state
        self._peek.bind("ctrl")[:, : self._ctrl.shape[1]] = actions
        self._peek.step(nstep=self.frame_skip)
        self.counterfactual_steps += self.num_envs
        after = self.task.observe(self._peek.qpos, self._peek.qvel)
        return np.where(self._unstable(self._peek)[:, None], self.observe(), after)

    def _unstable(self, batch):
        """Which rows of a batch became unstable in its last steps: (N,) bool.

        Raises EnvError where all did."""
        if not batch.warning.any():
            return np.zeros(self.num_envs, bool)
        # columns: last offending index, how often; a NaN control counts as unstable too
        fatal = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{x}")) for x in UNSTABLE]
        lost = batch.warning[:, fatal, 1].any(axis=1)
        batch.warning[:] = 0
        if lost.all():
            raise EnvError(
                f"{self.env_id}: the simulation became unstable (NaN or huge values) at step "
                f"{self.steps[0]}, in every environment: if --real changed the model, choose a "
                "smaller change"
            )
        return lost


# --- by name: gymnasium.make_vec("rgat/Hopper-v5", num_envs=32, real="torso:mass*1.27") -----------


def _registered(num_envs, env_id, real="", nthread=0):
    """The BatchEnv of a registered name; real: a perturbation as parse_perturbation reads it."""
    return BatchEnv(env_id, num_envs, parse_perturbation(real), nthread=nthread)


class SingleEnv(gymnasium.Env):
    """One robot of a BatchEnv as a gymnasium.Env: gymnasium.make("rgat/Hopper-v5").

    real: a perturbation as parse_perturbation reads it; "" for the sim.
    """

    metadata = {"render_modes": []}

    def __init__(self, env_id, real=""):
        self.batch = BatchEnv(env_id, 1, parse_perturbation(real), nthread=1)
        self.observation_space = self.batch.single_observation_space
        self.action_space = self.batch.single_action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.batch.reset(seed=seed)[0][0], {}

    def step(self, action):
        _, reward, terminated, truncated, info = self.batch.step(np.asarray(action)[None])
        return info["next_obs"][0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), {}


for _env_id in ENV_IDS:  # on import, as gymnasium asks for it
    gymnasium.register(
        f"rgat/{_env_id}",
        entry_point=SingleEnv,
        vector_entry_point=_registered,
        kwargs={"env_id": _env_id},
    )
