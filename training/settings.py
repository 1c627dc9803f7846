"""What decides a run's numbers: the settings of the command line, the
presets that fill them in, and the seeds."""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np

import envs
from envs import BatchEnv, model_path, parse_perturbation, perturb, robot_of, task_of
from rgat import AT_CONFIG, METHODS, GroundingSettings
from training.run_folder import RunError
from trpo import PRESETS, STABLE_BASELINES, TRPOConfig

ALGOS = [*METHODS, "physics", "physics+rgat", "physics+solved"]

# settings that suit each task, where the command line does not say
LARGE = dict(
    pretrain_steps=1_000_000,
    reference_steps=1_000_000,
    at_steps=200_000,
    policy_steps=250_000,
)
DEFAULTS = {
    "InvertedPendulum": dict(
        grounding_steps=5,
        pretrain_steps=80_000,
        reference_steps=200_000,
        at_steps=50_000,
        policy_steps=20_000,
    ),
    "Hopper": dict(grounding_steps=10, **LARGE),
    "HalfCheetah": dict(grounding_steps=20, **LARGE),
}

# "tuned": what was found to work here; "paper": Algorithm 1 as printed, and where the paper is
# silent stable-baselines' defaults, whose policies begin with a standard deviation of 1 in the
# action's own unit
PRESET = {
    "tuned": dict(
        forward_model="residual",
        at_norm="step",
        at_max_kl=AT_CONFIG.max_kl,
        at_gamma=AT_CONFIG.gamma,
        at_entropy=AT_CONFIG.entropy,
        at_std={"InvertedPendulum": 0.05, "Hopper": 0.01, "HalfCheetah": 0.01},
    ),
    "paper": dict(
        forward_model="plain",
        at_norm="raw",
        at_max_kl=1e-4,
        at_gamma=0.99,
        at_entropy=1e-5,
        at_std={"InvertedPendulum": 1 / 6, "Hopper": 1 / 2, "HalfCheetah": 1 / 2},
    ),
}


def option(default, help, **extra):
    """A field of Settings with its line of --help; extra: what argparse is told besides."""
    return field(default=default, metadata={"help": help, **extra})


@dataclass(frozen=True)
class Settings:
    """Everything that decides a run's numbers, but for --out."""

    env: str = option("Hopper-v4", "task: InvertedPendulum, Hopper or HalfCheetah, -v4 or -v5")
    task: str = option(
        "", "a Python file that defines another TASK (see training/tasks), for --env"
    )
    algo: str = option(
        "rgat",
        "how to ground: rgat, gat, ane, oracle, solved (rgat's transformer with a label instead of "
        "a reward), "
        "physics (diagnose.py), and physics+rgat or physics+solved for what has no name; "
        "sim and real train in that world alone",
        choices=ALGOS,
    )
    preset: str = option(
        "tuned",
        "what fills in the settings left open: tuned, or paper (Algorithm 1 as printed, "
        "stable-baselines' TRPO)",
        choices=list(PRESET),
    )
    seed: int = option(0, "seed of everything random")
    real: str = option(
        None,
        "how the real world differs, e.g. torso:mass*1.27,foot_joint:damping=2 (default: the "
        "paper's)",
    )
    real_data: str = option(
        "",
        "folder of recordings of the actual robot, in the diagnosis' formats, in the place of a "
        "real world to roll out in; nothing is judged then",
    )
    policy: str = option(
        "deep",
        "hidden layers of the target policy: deep 2x64, shallow 1x4",
        choices=["deep", "shallow"],
    )
    pretrain_steps: int = option(
        None, "steps in the raw sim before the first grounding step (default: by task)"
    )
    reference_steps: int = option(
        None,
        "steps on real, from scratch, of the policy that is the reference line (default: by task, "
        "or --pretrain-steps if given without --policy-from)",
    )
    grounding_steps: int = option(None, "rounds of Algorithm 1 (default: by task)")
    real_trajectories: int = option(
        None,
        "real episodes recorded per grounding step (default: 50; physics: 1, or more until they "
        "hold 200 steps)",
    )
    at_steps: int = option(
        None, "sim steps per grounding step for the action transformer (default: by task)"
    )
    policy_steps: int = option(
        None, "grounded-sim steps per grounding step for the policy (default: by task)"
    )
    eval_episodes: int = option(
        20, "real episodes per evaluation, deterministic and again stochastic"
    )
    roll_back: float = option(
        0.0,
        "go on from the best policy so far where the return on real falls below this part of the "
        "best (0: never)",
    )
    num_envs: int = option(32, "simulations stepped at once")
    at_max_kl: float = option(
        None, "rgat: trust region of the action transformer (default: by preset)"
    )
    at_gamma: float = option(None, "rgat: discount of the action transformer (default: by preset)")
    at_entropy: float = option(
        None, "rgat: entropy coefficient of the action transformer (default: by preset)"
    )
    at_std: float = option(
        None,
        "rgat: its initial standard deviation, as a part of the action range (default: by preset "
        "and task)",
    )
    at_norm: str = option(
        None,
        "rgat, oracle, solved: R_AT in units of each dimension's change in a real step, or raw "
        "(default: by preset)",
        choices=["step", "raw"],
    )
    forward_model: str = option(
        None,
        "rgat, gat, solved: f_psi corrects the sim's own prediction (residual), or (plain) is the "
        "paper's network of "
        "(s, a) alone (default: by preset)",
        choices=["residual", "plain"],
    )
    threads: int = option(
        0,
        "cores for the simulations (default: all); they change no number: seeds side by side do "
        "best with 1 each",
    )
    pretrained: str = option(
        "", "folder that keeps policies trained from scratch, for other runs to share"
    )
    policy_from: str = option(
        "",
        "a policy.pt to begin with instead of training one in the raw sim; --pretrain-steps are "
        "then its critic's",
    )
    ane_width: float = option(
        GroundingSettings.ane_width,
        "ane: standard deviation of the action noise, as a part of half the action range",
    )

    @property
    def robot(self):
        return robot_of(self.env)

    def completed(self):
        """These settings with the preset's and the task's defaults filled in.

        Raises EnvError or RunError for impossible ones."""
        if self.task:
            return dataclasses.replace(self, env=load_task(self.task))._filled()
        return self._filled()

    def _filled(self):
        real, preset = task_of(self.env).real, PRESET[self.preset]
        defaults = {
            **DEFAULTS[self.robot],
            **preset,
            "at_std": preset["at_std"].get(self.robot, preset["at_std"]["Hopper"]),
            "real": real,
            "real_trajectories": 1 if self.algo.startswith("physics") else 50,
        }
        if self.real_data:
            defaults |= {"grounding_steps": 1, "reference_steps": 0}
        elif self.pretrain_steps is not None and not self.policy_from:  # then they are the critic's
            defaults["reference_steps"] = self.pretrain_steps
        done = dataclasses.replace(
            self, **{k: v for k, v in defaults.items() if getattr(self, k) is None}
        )
        done.check()
        return done

    def check(self):
        """Raises EnvError or RunError for settings that no run can have."""
        for name, least in COUNTS.items():
            value, shown = getattr(self, name), name.replace("_", "-")
            if value < least:
                raise RunError(f"--{shown} is {value}: it must be at least {least}")
        for name in ("at_max_kl", "at_std"):
            value, shown = getattr(self, name), name.replace("_", "-")
            if not 0 < value < np.inf:
                raise RunError(f"--{shown} is {value}: it must be positive")
        if not 0 <= self.at_gamma < 1:
            raise RunError(f"--at-gamma is {self.at_gamma}: it must be at least 0 and below 1")
        if not 0 <= self.roll_back <= 1:
            raise RunError(f"--roll-back is {self.roll_back}: it must be between 0 and 1")
        if self.real_data and (self.algo in ("oracle", "real") or self.roll_back):
            raise RunError(
                "--real-data gives recordings alone: --algo oracle and real, and --roll-back, need "
                "a real world to act in"
            )
        if not 0 <= self.ane_width < np.inf or not 0 <= self.at_entropy < np.inf:
            raise RunError("--ane-width and --at-entropy must be 0 or more")
        model = mujoco.MjModel.from_xml_path(str(model_path(self.env)))
        perturb(model, parse_perturbation(self.real))  # are the names the model's?

    @property
    def grounding(self):
        """What the grounding methods are told: GroundingSettings."""
        at = STABLE_BASELINES if self.preset == "paper" else AT_CONFIG
        at = dataclasses.replace(
            at, max_kl=self.at_max_kl, gamma=self.at_gamma, entropy=self.at_entropy
        )
        return GroundingSettings(
            at,
            self.at_std,
            residual=self.forward_model == "residual",
            per_step=self.at_norm == "step",
            ane_width=self.ane_width,
        )

    @property
    def target(self):
        """TRPOConfig of the target policy."""
        return STABLE_BASELINES if self.preset == "paper" else PRESETS[self.robot]


def load_task(path):
    """Make the TASK of a user's file known under the file's name, which is returned.

    The file may also define DEFAULTS, settings that suit the task, and LEARNER, the TRPOConfig of
    its policy. Raises RunError, in one line, for a file that is none or a task that does not work.
    """
    path = Path(path)
    try:
        name, module = envs.load_task(path)
        PRESETS[name] = getattr(module, "LEARNER", TRPOConfig())
        DEFAULTS[name] = {"grounding_steps": 10, **LARGE, **getattr(module, "DEFAULTS", {})}
        env = BatchEnv(name, 2, nthread=1)
        first = env.reset(seed=0)[0]
        obs, reward, *_ = env.step(np.zeros(env.action_space.shape))
    except Exception as error:  # whatever a user's file raises
        said = str(error).splitlines()
        raise RunError(
            f"--task {path}: {type(error).__name__}{': ' * bool(said)}{(said or [''])[0]}"
        ) from None
    if not np.isfinite(first).all() or not np.isfinite(obs).all():
        raise RunError(f"--task {path}: observe() returns NaN or infinite values")
    if np.shape(reward) != (2,) or not np.isfinite(reward).all():
        raise RunError(f"--task {path}: reward() must return a finite number per robot, (N,)")
    qpos, qvel = env.task.state(obs, env.model)
    if (qpos.shape, qvel.shape) != ((2, env.model.nq), (2, env.model.nv)):
        raise RunError(
            f"--task {path}: state() makes qpos {qpos.shape[1:]} and qvel {qvel.shape[1:]} of an "
            f"observation, the model has {env.model.nq} and {env.model.nv}: it must undo observe()"
        )
    return name


COUNTS = {  # the least of each
    **dict.fromkeys(("seed", "pretrain_steps", "reference_steps", "grounding_steps"), 0),
    **dict.fromkeys(("real_trajectories", "at_steps", "eval_episodes", "num_envs"), 1),
    **dict.fromkeys(("policy_steps", "threads"), 0),
}


def settings_of(folder, saved):
    """The Settings in a run's config.json. Raises RunError where it holds something else."""
    try:
        s = Settings(**saved).completed()
        values = [(f, getattr(s, f.name)) for f in dataclasses.fields(Settings)]
        sound = all(
            type(v) in ((float, int) if kind_of(f) is float else (kind_of(f),))
            and v in f.metadata.get("choices", [v])
            for f, v in values
        )
    except (TypeError, AttributeError, KeyError):
        sound = False
    if not sound:
        raise RunError(
            f"{folder}/config.json does not hold this program's settings: start a new run"
        )
    return s


def kind_of(setting):
    """int, float or str: what a field of Settings holds."""
    return {"int": int, "float": float, "str": str}[getattr(setting.type, "__name__", setting.type)]


PURPOSES = (  # their order is part of every seed
    *("networks", "pretrain", "collect", "model", "transformer"),
    *("held out", "policy", "evaluate", "best"),
)


def seed_for(seed, step, purpose):
    """An independent seed for each use in each grounding step, so that a
    resumed run draws the same numbers."""
    entropy = np.random.SeedSequence([seed, step, PURPOSES.index(purpose)])
    return int(entropy.generate_state(1)[0] >> 1)
