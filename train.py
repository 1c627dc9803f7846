"""Train a policy in simulation that works on the "real" robot: Algorithm 1 of the RGAT paper, and its rivals.

python train.py --env Hopper-v4 --algo rgat
python train.py --env InvertedPendulum-v4 --algo gat --seed 3 --out runs/pendulum
python train.py --resume runs/pendulum
python train.py --replay runs/pendulum
"""

import argparse
import dataclasses
import hashlib
import json
import sys
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np
import torch

from diagnosis.common.atomic_files import WriteError, write_whole
from diagnosis.common.mujoco_warnings import quiet
from envs import BatchEnv, EnvError, model_path, parse_perturbation, perturb, task_of
from models import DEEP, SHALLOW, GaussianPolicy, Value, load_checkpoint
from rgat import AT_CONFIG, METHODS, GroundedEnv, GroundingSettings, identity, one_step_error
from training.physics_grounding import Physics
from training.run_folder import Bar, Run, RunError, animate, save_whole, versions
from trpo import PRESETS, TRPO, Transitions, rollouts

# settings that suit each task, where the command line does not say
LARGE = dict(
    pretrain_steps=1_000_000,
    reference_steps=1_000_000,
    at_steps=200_000,
    policy_steps=250_000,
    at_std=0.01,
)
DEFAULTS = {
    "InvertedPendulum": dict(
        grounding_steps=5,
        pretrain_steps=80_000,
        reference_steps=200_000,
        at_steps=50_000,
        policy_steps=20_000,
        at_std=0.05,
    ),
    "Hopper": dict(grounding_steps=10, **LARGE),
    "HalfCheetah": dict(grounding_steps=20, **LARGE),
}


UNSOUND = (
    AttributeError,
    IndexError,
    KeyError,
    RuntimeError,
    TypeError,
    ValueError,
)  # what a checkpoint of something else raises


def option(default, help, **extra):
    return field(default=default, metadata={"help": help, **extra})


@dataclass(frozen=True)
class Settings:
    """Everything that decides a run's numbers, but for --out."""

    env: str = option("Hopper-v4", "task: InvertedPendulum, Hopper or HalfCheetah, -v4 or -v5")
    algo: str = option(
        "rgat",
        "how to ground: rgat, gat, ane, oracle, physics (diagnose.py); sim and real train in that world alone",
        choices=[*METHODS, "physics"],
    )
    seed: int = option(0, "seed of everything random")
    real: str = option(
        None,
        "how the real world differs, e.g. torso:mass*1.27,foot_joint:damping=2 (default: the paper's)",
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
        "steps on real, from scratch, of the policy that is the reference line (default: by task, or --pretrain-steps if given)",
    )
    grounding_steps: int = option(None, "rounds of Algorithm 1 (default: by task)")
    real_trajectories: int = option(
        None,
        "real episodes recorded per grounding step (default: 50; physics: 1, or more until they hold 200 steps)",
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
    num_envs: int = option(32, "simulations stepped at once")
    at_max_kl: float = option(AT_CONFIG.max_kl, "rgat: trust region of the action transformer")
    at_gamma: float = option(AT_CONFIG.gamma, "rgat: discount of the action transformer")
    at_entropy: float = option(
        AT_CONFIG.entropy, "rgat: entropy coefficient of the action transformer"
    )
    at_std: float = option(
        None,
        "rgat: its initial standard deviation, as a part of the action range (default: by task)",
    )
    forward_model: str = option(
        "residual",
        "rgat, gat: f_psi corrects the sim's own prediction, or (plain) is the paper's network of (s, a) alone",
        choices=["residual", "plain"],
    )
    threads: int = option(
        0, "cores that this run may take (default: all); seeds side by side do best with 1 each"
    )
    pretrained: str = option(
        "", "folder that keeps policies trained from scratch, for other runs to share"
    )
    ane_width: float = option(
        GroundingSettings.ane_width,
        "ane: standard deviation of the action noise, as a part of half the action range",
    )

    def completed(self):
        """These settings with the task's defaults filled in. Raises EnvError or RunError for impossible ones."""
        task = task_of(self.env)
        trajectories = 1 if self.algo == "physics" else 50
        defaults = {
            **DEFAULTS[self.env.split("-")[0]],
            "real": task.real,
            "real_trajectories": trajectories,
        }
        if self.pretrain_steps is not None:
            defaults["reference_steps"] = self.pretrain_steps
        done = dataclasses.replace(
            self, **{k: v for k, v in defaults.items() if getattr(self, k) is None}
        )
        for name, least in COUNTS.items():
            if getattr(done, name) < least:
                raise RunError(
                    f"--{name.replace('_', '-')} is {getattr(done, name)}: it must be at least {least}"
                )
        for name in ("at_max_kl", "at_std"):
            if not 0 < getattr(done, name) < np.inf:
                raise RunError(
                    f"--{name.replace('_', '-')} is {getattr(done, name)}: it must be positive"
                )
        if not 0 <= done.at_gamma < 1:
            raise RunError(f"--at-gamma is {done.at_gamma}: it must be at least 0 and below 1")
        if not 0 <= done.ane_width < np.inf or not 0 <= done.at_entropy < np.inf:
            raise RunError("--ane-width and --at-entropy must be 0 or more")
        perturb(
            mujoco.MjModel.from_xml_path(str(model_path(done.env))), parse_perturbation(done.real)
        )  # are the names the model's?
        return done


COUNTS = {
    "seed": 0, "pretrain_steps": 0, "reference_steps": 0, "grounding_steps": 0, "real_trajectories": 1, "at_steps": 1, "policy_steps": 0,
    "eval_episodes": 1, "num_envs": 1, "threads": 0,
}  # fmt: skip


def seed_for(seed, step, purpose):
    """An independent seed for each use in each grounding step, so that a resumed run draws the same numbers."""
    purposes = (
        "networks",
        "pretrain",
        "collect",
        "model",
        "transformer",
        "held out",
        "policy",
        "evaluate",
        "best",
    )
    return int(
        np.random.SeedSequence([seed, step, purposes.index(purpose)]).generate_state(1)[0] >> 1
    )


# --- Algorithm 1 --------------------------------------------------------------------------------------


def algorithm_1(s, run, bar):
    """Algorithm 1 of the paper under settings s. Its results are left in run; a run begun earlier goes on."""
    if s.threads:
        torch.set_num_threads(s.threads)
    sim = BatchEnv(s.env, s.num_envs, nthread=s.threads)
    real = BatchEnv(s.env, s.num_envs, parse_perturbation(s.real), nthread=s.threads)
    learner, grounding, tau_real = start(s, run, sim, real, bar)
    policy = learner.policy

    for step in range(
        len(run.progress), s.grounding_steps + 1
    ):  # 1: while the policy improves on real: here a fixed number of times
        seeds = lambda purpose: seed_for(s.seed, step, purpose)
        tau_new = collect(s, grounding, policy, real, seeds("collect"))  # 2: collect tau_real ...
        tau_real += tau_new  # ... and keep what was collected before
        stats = grounding.fit(tau_real, seeds("model"))  # 3: train f_psi with tau_real
        stats |= update_transformer(
            s, grounding, policy, sim, real, seeds, bar.phase(step, "transformer")
        )  # 4: update g_phi by optimize1
        grounded_sim = GroundedEnv(grounding.sim, grounding.transformer)
        learner.learn(
            grounded_sim, s.policy_steps, seeds("policy"), on_update=bar.phase(step, "policy")
        )  # 5: update pi_theta by optimize2
        record(
            s, run, step, learner, grounding, real, tau_new, stats, bar
        )  # 6: end while; the run keeps the best policy


def collect(s, grounding, policy, real, seed):
    """tau_real of one grounding step: episodes of the stochastic policy, for the methods that learn from them."""
    if not grounding.learns_from_real:
        return nothing(real)
    tau, episodes = rollouts(policy, real, s.real_trajectories, seed)[1], s.real_trajectories
    while len(tau) < grounding.least_transitions:
        tau, episodes = tau + rollouts(policy, real, 1, seed + episodes)[1], episodes + 1
    return tau


def nothing(env):
    """Transitions of length 0."""
    s, a = (
        np.empty((0, space.shape[0]), np.float32)
        for space in (env.single_observation_space, env.single_action_space)
    )
    return Transitions(s, a, s)


def update_transformer(s, grounding, policy, sim, real, seeds, log):
    """The action transformer goes on (or begins anew, as the method has it). Returns its statistics: among them the one-step
    errors with it and without, on real transitions that nothing is fitted on and that no column counts."""
    stats = grounding.update(policy, s.at_steps, seeds("transformer"), log)
    held_out = rollouts(policy, real, s.eval_episodes, seeds("held out"))[1]
    error, change = one_step_error(grounding.sim, grounding.transformer, held_out)
    untouched = one_step_error(sim, identity, held_out)[0]
    return {
        **stats,
        "at_one_step_error": error,
        "identity_one_step_error": untouched,
        "delta_action_rms": change,
    }


def record(s, run, step, learner, grounding, real, tau_new, stats, bar):
    """Judge the policy on real, and write down everything that the next step, or a resumed run, needs."""
    seed = seed_for(s.seed, step, "evaluate")
    deterministic = rollouts(learner.policy, real, s.eval_episodes, seed, deterministic=True)[0]
    stochastic = rollouts(learner.policy, real, s.eval_episodes, seed)[0]
    before = (
        run.progress[-1] if run.progress else {"real_transitions": 0, "sim_steps": 0, "seconds": 0}
    )
    steps, seconds = bar.lap()
    on_real = s.algo == "real"
    row = {
        "grounding_step": step,
        "real_transitions": int(before["real_transitions"]) + (steps if on_real else len(tau_new)),
        "sim_steps": int(before["sim_steps"])
        + (0 if on_real else steps + stats.get("sim_transitions", 0)),
        "real_return_deterministic": float(deterministic.mean()),
        "real_return_deterministic_se": standard_error(deterministic),
        "real_return_stochastic": float(stochastic.mean()),
        **stats,
        "seconds": round(float(before["seconds"]) + seconds, 1),
    }
    transformer = grounding.state() if step else {}
    run.record(
        row,
        {
            "learner": learner.state(),
            "grounding": transformer,
            "acting": learner.policy.checkpoint(),
        },
        tau_new,
    )
    bar.say(
        f"step {step}: {row['real_return_deterministic']:.0f} ± {row['real_return_deterministic_se']:.0f} on real"
    )


def standard_error(x):
    return float(x.std(ddof=1) / np.sqrt(len(x))) if len(x) > 1 else 0.0


# --- where a run begins -------------------------------------------------------------------------------


def start(s, run, sim, real, bar):
    """The learner, the grounding and tau_real that the next grounding step goes on from; step 0 if there is none yet."""
    world = real if s.algo == "real" else sim
    method = Physics if s.algo == "physics" else METHODS[s.algo]
    at = dataclasses.replace(AT_CONFIG, max_kl=s.at_max_kl, gamma=s.at_gamma, entropy=s.at_entropy)
    settings = GroundingSettings(at, s.at_std, s.forward_model == "residual", ane_width=s.ane_width)
    learner = new_learner(s)  # seeds torch for the grounding's networks too
    grounding = (
        method(world, settings, real.model) if s.algo == "oracle" else method(world, settings)
    )
    tau_real = nothing(real)
    done = len(run.progress) - 1
    if done >= 0:
        saved = run.checkpoint(done)
        try:
            learner.load(saved["learner"])
            if done:
                grounding.load(saved["grounding"])
        except UNSOUND:
            raise RunError(
                f"{run.folder}/step_{done:02d}.pt does not belong to this run: start a new one"
            ) from None
        for step in range(1, done + 1):
            tau_real += Transitions(*run.real(step))
        bar.skip(int(run.progress[-1]["real_transitions" if s.algo == "real" else "sim_steps"]))
        if not run.lines:
            reference(s, run, learner, real, bar)
        elif s.algo != "real":
            bar.skip(s.reference_steps, counts=False)
        bar.lap()
        return learner, grounding, tau_real

    learner.load(pretrained(s, "real" if s.algo == "real" else "sim", world, s.pretrain_steps, bar))
    reference(s, run, learner, real, bar)
    record(s, run, 0, learner, grounding, real, tau_real, {}, bar)
    return learner, grounding, tau_real


def reference(s, run, learner, real, bar):
    """The green line: what a policy trained from scratch on real, for --reference-steps, returns there."""
    if s.algo != "real":
        learner = new_learner(s)
        learner.load(pretrained(s, "real", real, s.reference_steps, bar))
    seed = seed_for(s.seed, 0, "evaluate")
    run.set_lines(
        **{
            "trained on real": float(
                rollouts(learner.policy, real, s.eval_episodes, seed, deterministic=True)[0].mean()
            )
        }
    )


def new_learner(s):
    """Untrained policy and value in their TRPO, with the task's preset."""
    torch.manual_seed(seed_for(s.seed, 0, "networks"))
    env = BatchEnv(s.env, 1)
    nobs, nact = env.single_observation_space.shape[0], env.single_action_space.shape[0]
    policy = GaussianPolicy(nobs, nact, {"deep": DEEP, "shallow": SHALLOW}[s.policy])
    return TRPO(policy, Value(nobs), PRESETS[s.env.split("-")[0]])


def pretrained(s, world, env, steps, bar):
    """TRPO from scratch in a world, "sim" or "real": the learner's state. Runs that name one --pretrained folder share it."""
    preset = PRESETS[s.env.split("-")[0]]
    decides = [
        s.env,
        s.real if world == "real" else "",
        s.policy,
        s.seed,
        steps,
        s.num_envs,
        preset,
        versions(),
    ]
    key = hashlib.sha256(repr(decides).encode()).hexdigest()[:16]
    folder = Path(s.pretrained) if s.pretrained else bar.run.folder
    path = folder / f"{s.env}-{world}-{key}.pt"
    learner = new_learner(s)
    if path.exists():
        whole = learner.batch_steps(env)
        bar.skip(-(-steps // whole) * whole, counts=world == bar.world)
        try:
            learner.load(load_checkpoint(path))
        except UNSOUND:
            raise RunError(f"{path} holds no trained policy of this program: delete it") from None
        return learner.state()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(
            f"cannot make the folder {folder}: {error.strerror}; choose another --pretrained"
        ) from None
    name = "pretrain" if world == bar.world else "reference"
    bar.run.train = [
        row for row in bar.run.train if row["phase"] != name
    ]  # what a cut-off attempt left
    log = bar.phase(0, name)
    learner.learn(
        env, steps, seed_for(s.seed, 0, "pretrain"), freeze_normalizer=False, on_update=log
    )
    bar.run.flush()
    save_whole(path, learner.state())
    return learner.state()


# --- the command line ---------------------------------------------------------------------------------


def verdict(s, run):
    """The best policy judged once more, on real episodes that did not choose it: best.json, and a line that says so."""
    step = max(
        range(len(run.progress)), key=lambda k: float(run.progress[k]["real_return_deterministic"])
    )
    policy = run.policy()
    real = BatchEnv(s.env, s.num_envs, parse_perturbation(s.real), nthread=s.threads)
    returns = rollouts(
        policy, real, 2 * s.eval_episodes, seed_for(s.seed, step, "best"), deterministic=True
    )[0]
    best = {
        "grounding_step": step,
        "episodes": len(returns),
        "real_return_deterministic": float(returns.mean()),
        "se": standard_error(returns),
    }
    write_whole(run.folder / "best.json", json.dumps(best, indent=1))
    shown = f"{best['real_return_deterministic']:.0f} ± {best['se']:.0f} on {len(returns)} fresh episodes"
    untouched, line = (
        float(run.progress[0]["real_return_deterministic"]),
        run.lines["trained on real"],
    )
    return f"{run.folder}: best on real after grounding step {step}: {shown} (before grounding {untouched:.0f}, trained on real {line:.0f})"


def replay(folder):
    """Draw a run's best policy acting in sim and on real into the run's replay.gif."""
    run, saved = Run.open(folder)
    s = settings_of(folder, saved)
    policy = run.policy()
    worlds = {"sim": BatchEnv(s.env, 1), "real": BatchEnv(s.env, 1, parse_perturbation(s.real))}
    if policy.sizes[0] != worlds["sim"].single_observation_space.shape[0]:
        raise RunError(
            f"{folder}/policy.pt was trained on another task than {s.env}: start a new run"
        )
    returns = animate(policy, worlds, run.folder / "replay.gif")
    print(
        f"{run.folder / 'replay.gif'}: "
        + ", ".join(f"{name} {value:.0f}" for name, value in returns.items())
    )


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
    except (TypeError, AttributeError):
        sound = False
    if not sound:
        raise RunError(
            f"{folder}/config.json does not hold this program's settings: start a new run"
        )
    return s


def kind_of(setting):
    """int, float or str: what a field of Settings holds."""
    return {"int": int, "float": float, "str": str}[getattr(setting.type, "__name__", setting.type)]


class Parser(argparse.ArgumentParser):
    def error(self, message):
        raise RunError(f"{message}; see --help")


def parse(argv):
    """The parsed command line: every field of Settings, and what to do with which run. Raises RunError where it makes no sense."""
    parser = Parser(
        prog="train.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for f in dataclasses.fields(Settings):
        shown = (
            ""
            if f.default in (None, "") or "(default:" in f.metadata["help"]
            else f" (default: {f.default})"
        )
        extra = {k: v for k, v in f.metadata.items() if k != "help"}
        parser.add_argument(
            f"--{f.name.replace('_', '-')}",
            type=kind_of(f),
            default=f.default,
            help=f.metadata["help"] + shown,
            **extra,
        )
    parser.add_argument("--out", help="folder of the run (default: runs/ENV-ALGO-sSEED)")
    parser.add_argument(
        "--resume",
        metavar="RUN",
        help="continue the run in this folder, with the settings it began with",
    )
    parser.add_argument(
        "--replay",
        metavar="RUN",
        help="animate the best policy of this run on sim and real, to RUN/replay.gif",
    )
    args = parser.parse_args(argv)
    given = [f.name for f in dataclasses.fields(Settings) if getattr(args, f.name) != f.default] + [
        "out"
    ] * (args.out is not None)
    if given and (args.resume or args.replay):
        raise RunError(
            f"--{given[0].replace('_', '-')} cannot be changed: a run goes on in its folder with the settings it began with; leave it out"
        )
    if args.resume and args.replay:
        raise RunError("--resume and --replay are two things to do: give one of them")
    return args


def main(argv=None):
    """The command; returns its exit status. 0: done; 2: a request that cannot be met, told in one line; 130: Ctrl-C."""
    run = None
    try:
        args = parse(argv)
        if args.replay:
            replay(args.replay)
            return 0
        if args.resume:
            run, saved = Run.open(args.resume)
            s = settings_of(args.resume, saved)
        else:
            s = Settings(
                **{f.name: getattr(args, f.name) for f in dataclasses.fields(Settings)}
            ).completed()
            run = Run.create(args.out or f"runs/{s.env}-{s.algo}-s{s.seed}", dataclasses.asdict(s))
        with quiet():  # MuJoCo's own warnings: an unstable simulation is told below, in one line
            algorithm_1(s, run, Bar(s, run))
            print(verdict(s, run))
        return 0
    except (EnvError, RunError, WriteError) as error:
        print(f"train.py: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(
            f"\nstopped; go on with: python train.py --resume {run.folder}" if run else "\nstopped",
            file=sys.stderr,
        )
        return 130


if __name__ == "__main__":
    sys.exit(main())
