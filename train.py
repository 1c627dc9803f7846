"""Train a policy in simulation for the "real" robot: Algorithm 1 of the RGAT paper, and its rivals.

python train.py --env Hopper-v4 --algo rgat
python train.py --env InvertedPendulum-v4 --algo gat --seed 3 --out runs/pendulum
python train.py --resume runs/pendulum
python train.py --replay runs/pendulum
"""

import argparse
import copy
import dataclasses
import hashlib
import importlib.util
import json
import sys
from functools import partial
from pathlib import Path

import numpy as np
import torch

from diagnosis.common.atomic_files import WriteError, write_whole
from diagnosis.common.mujoco_warnings import quiet
from envs import BatchEnv, EnvError, parse_perturbation
from models import DEEP, SHALLOW, GaussianPolicy, Value, load_checkpoint, torch_threads
from rgat import METHODS, RGAT, GroundedEnv, Solved, identity, one_step_error
from training.physics_grounding import Physics, PhysicsThen
from training.real_data import RealData
from training.run_folder import (
    Bar,
    Run,
    RunError,
    animate,
    save_whole,
    tensorboard,
    versions,
)
from training.settings import Settings, kind_of, seed_for, settings_of
from trpo import TRPO, Transitions, rollouts

GROUNDINGS = {
    **METHODS,
    "physics": Physics,
    "physics+rgat": partial(PhysicsThen, RGAT),
    "physics+solved": partial(PhysicsThen, Solved),
}
# what a checkpoint of something else raises
UNSOUND = (AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError)


# --- Algorithm 1 ----------------------------------------------------------------------------------


@torch_threads(1)
def algorithm_1(s, run, bar):
    """Algorithm 1 of the paper under settings s: its results are left in
    run, begun earlier or not."""
    sim = BatchEnv(s.env, s.num_envs, nthread=s.threads)
    real = RealData(s.real_data, sim) if s.real_data else real_world(s)
    learner, grounding, tau_real = start(s, run, sim, real, bar)
    policy = learner.policy

    # 1: while the policy improves on real: here a fixed number of times
    for step in range(len(run.progress), s.grounding_steps + 1):
        seeds = lambda purpose: seed_for(s.seed, step, purpose)
        # 2: collect tau_real, and keep what was collected before
        tau_new = collect(s, grounding, policy, real, seeds("collect"))
        tau_real += tau_new
        # 3: train f_psi with tau_real
        stats = grounding.fit(tau_real, seeds("model"))
        # 4: update g_phi by optimize1
        stats |= update_transformer(
            s, grounding, policy, sim, real, seeds, bar.phase(step, "transformer")
        )
        # 5: update pi_theta by optimize2, in the simulator that g_phi grounds
        grounded_sim = GroundedEnv(grounding.sim, grounding.transformer)
        learner.learn(
            grounded_sim, s.policy_steps, seeds("policy"), on_update=bar.phase(step, "policy")
        )
        # 6: end while; the run keeps the best policy
        record(s, run, step, learner, grounding, real, tau_new, stats, bar)


def real_world(s):
    """The world that stands for the real one: the sim with what --real says."""
    return BatchEnv(s.env, s.num_envs, parse_perturbation(s.real), nthread=s.threads)


def collect(s, grounding, policy, real, seed):
    """tau_real of one grounding step, for the methods that learn from it: episodes of the
    stochastic policy, or what was recorded since the last step."""
    if not grounding.learns_from_real:
        return nothing(grounding.sim)
    if s.real_data:
        return real.collect()
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
    """The action transformer goes on, or begins anew, as the method has it.

    Returns its statistics: among them the one-step errors with it and without, on real transitions
    that nothing is fitted on."""
    stats = grounding.update(policy, s.at_steps, seeds("transformer"), log)
    if s.real_data:
        held_out = real.held_out()
    else:
        held_out = rollouts(policy, real, s.eval_episodes, seeds("held out"))[1]
    error, change = one_step_error(grounding.sim, grounding.transformer, held_out)
    untouched = one_step_error(sim, identity, held_out)[0]
    return {
        **stats,
        "at_one_step_error": error,
        "identity_one_step_error": untouched,
        "delta_action_rms": change,
        "real_transitions_judging": len(held_out),
    }


def record(s, run, step, learner, grounding, real, tau_new, stats, bar):
    """Judge the policy on real, and write down all that the next step, or a resumed run, needs."""
    returns, judging = judge(s, learner.policy, real, seed_for(s.seed, step, "evaluate"))
    steps, seconds = bar.lap()
    on_real = s.algo == "real"
    extra = grounding.sim.counterfactual_steps + stats.pop("sim_transitions", 0)
    grounding.sim.counterfactual_steps = 0
    spent = {
        "real_transitions": steps if on_real else len(tau_new),
        "real_transitions_judging": stats.pop("real_transitions_judging", 0) + judging,
        "sim_steps": 0 if on_real else steps + extra,
        "seconds": seconds,
    }
    before = run.progress[-1] if run.progress else dict.fromkeys(spent, 0)
    row = {
        "grounding_step": step,
        **{name: type(n)(before[name]) + n for name, n in spent.items()},
        **returns,
        **stats,
    }
    acting = copy.deepcopy(learner.policy).checkpoint()
    row["rolled_back_to"] = roll_back(s, run, learner, returns.get("real_return_deterministic"))
    transformer = grounding.state() if step else {}
    run.record(
        row,
        {
            "learner": learner.state(),
            "grounding": transformer,
            "acting": acting,
            "recordings": real.seen if s.real_data else [],
            "world": {
                "env": s.env,
                "task": str(Path(s.task).resolve()) if s.task else "",
                "algo": s.algo,
                "settings": transforming(s.grounding),
            },
        },
        tau_new,
    )
    bar.scalars("on real", row, step)
    mean, se = (returns.get(f"real_return_deterministic{k}", np.nan) for k in ("", "_se"))
    bar.say(f"step {step}: " + ("not judged" if s.real_data else f"{mean:.0f} ± {se:.0f} on real"))


def judge(s, policy, real, seed):
    """What a policy returns on real, as columns of progress.csv, and the real transitions that it
    took to know; nothing where the real world can only be recorded."""
    if s.real_data:
        return {}, 0
    deterministic, seen = rollouts(policy, real, s.eval_episodes, seed, deterministic=True)
    stochastic, seen_too = rollouts(policy, real, s.eval_episodes, seed)
    returns = {
        "real_return_deterministic": float(deterministic.mean()),
        "real_return_deterministic_se": standard_error(deterministic),
        "real_return_stochastic": float(stochastic.mean()),
    }
    return returns, len(seen) + len(seen_too)


def transforming(settings):
    """What a saved transformer has to be told again, as a dict; how it was trained it need not."""
    return {k: v for k, v in vars(settings).items() if k != "at"}


def roll_back(s, run, learner, reached):
    """The paper's "while the policy improves on real": a policy that got worse is put back.

    Returns the grounding step that the learner was put back to, or "" for none."""
    if not s.roll_back or not run.progress:
        return ""
    best = run.returns()[run.best()]
    if reached >= best - (1 - s.roll_back) * abs(best):
        return ""
    learner.load(run.checkpoint(run.best())["learner"])
    return run.best()


def standard_error(x):
    """Of the mean of x, a vector; 0 of a single number."""
    return float(x.std(ddof=1) / np.sqrt(len(x))) if len(x) > 1 else 0.0


# --- where a run begins ---------------------------------------------------------------------------


def start(s, run, sim, real, bar):
    """The learner, the grounding and tau_real to go on from; step 0 is
    done if there is none yet."""
    world, method = real if s.algo == "real" else sim, GROUNDINGS[s.algo]
    learner = new_learner(s)  # seeds torch for the grounding's networks too
    told = (real.model,) if s.algo == "oracle" else ()
    grounding = method(world, s.grounding, *told)
    tau_real = nothing(sim)
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
        if s.real_data:
            real.seen = list(saved["recordings"])
        for step in range(1, done + 1):
            tau_real += Transitions(*run.real(step))
        bar.skip(int(run.progress[-1]["real_transitions" if s.algo == "real" else "sim_steps"]))
        if not run.lines:
            reference(s, run, learner, real, bar)
        elif s.algo != "real" or s.policy_from:
            bar.skip(s.reference_steps, counts=False)
        bar.lap()
        return learner, grounding, tau_real

    if s.policy_from:
        take_over(s, learner, world, bar)
    else:
        name = "real" if s.algo == "real" else "sim"
        learner.load(pretrained(s, name, world, s.pretrain_steps, bar))
    reference(s, run, learner, real, bar)
    record(s, run, 0, learner, grounding, real, tau_real, {}, bar)
    return learner, grounding, tau_real


def reference(s, run, learner, real, bar):
    """The green line: the return on real of a policy trained there, for --reference-steps."""
    if s.real_data:
        return
    if s.algo != "real" or s.policy_from:  # a given policy is no line: it was not trained there
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
    box, hidden = env.single_action_space, {"deep": DEEP, "shallow": SHALLOW}[s.policy]
    policy = GaussianPolicy(nobs, nact, hidden, low=box.low, high=box.high)
    return TRPO(policy, Value(nobs), s.target)


def check_files(s):
    """Raises RunError where the files that a run is to begin with are none that it can use."""
    if s.real_data:
        RealData(s.real_data, BatchEnv(s.env, 1))
    if s.policy_from:
        given_policy(s, new_learner(s))


def take_over(s, learner, world, bar):
    """Begin with the policy of a file, and give it a critic of the world that it improves in."""
    policy = given_policy(s, learner)
    learner.policy.load_state_dict(policy.state_dict())
    learner.value.normalizer.load_state_dict(policy.normalizer.state_dict())
    seed, log = seed_for(s.seed, 0, "pretrain"), bar.phase(0, "critic")
    learner.learn(world, s.pretrain_steps, seed, on_update=log, critic_alone=True)


def given_policy(s, learner):
    """The policy of --policy-from. Raises RunError for a file without one that fits the learner."""
    try:
        policy = GaussianPolicy.load(s.policy_from)
    except ValueError as error:
        raise RunError(f"--policy-from: {error}") from None
    if policy.sizes != learner.policy.sizes:
        raise RunError(
            f"--policy-from {s.policy_from} has layers of {policy.sizes}, --env {s.env} and "
            f"--policy {s.policy} make {learner.policy.sizes}"
        )
    return policy


def pretrained(s, world, env, steps, bar):
    """TRPO from scratch in a world, "sim" or "real": the learner's state.

    Runs that name one --pretrained folder share it. Raises RunError where it cannot be kept."""
    changes = s.real if world == "real" else ""
    known = {k: v for k, v in versions().items() if k != "grounding"}
    task = Path(s.task).read_text() if s.task else ""
    decides = [
        s.env,
        task,
        changes,
        s.policy,
        s.seed,
        steps,
        s.num_envs,
        s.threads,
        s.target,
        known,
    ]
    key = hashlib.sha256(repr(decides).encode()).hexdigest()[:16]
    folder = Path(s.pretrained) if s.pretrained else bar.run.folder
    path = folder / f"{s.env}-{world}-{key}.pt"
    learner = new_learner(s)
    own = world == bar.world and not s.policy_from  # not of a reference line
    if path.exists():
        whole = learner.batch_steps(env)
        bar.skip(-(-steps // whole) * whole, counts=own)
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
    name = "pretrain" if own else "reference"
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


# --- the command line -----------------------------------------------------------------------------


def verdict(s, run):
    """The best policy judged on real episodes that did not choose it:
    best.json, and a line to print."""
    step, policy = run.best(), run.policy()
    if s.real_data:
        rows, error = run.progress[-1]["real_transitions"], run.progress[-1]["at_one_step_error"]
        return (
            f"{run.folder}: policy.pt is of grounding step {step}, from {rows} recorded "
            f"transitions; one-step error {float(error or 'nan'):.3g}. Record the robot under it, "
            f"add the files to {s.real_data}, and go on: train.py --resume {run.folder} "
            f"--grounding-steps {step + 1}"
        )
    real = real_world(s)
    seed = seed_for(s.seed, step, "best")
    returns, seen = rollouts(policy, real, 2 * s.eval_episodes, seed, deterministic=True)
    best = {
        "grounding_step": step,
        "episodes": len(returns),
        "real_return_deterministic": float(returns.mean()),
        "se": standard_error(returns),
        "real_transitions_judging": len(seen),
    }
    write_whole(run.folder / "best.json", json.dumps(best, indent=1))
    shown = (
        f"{best['real_return_deterministic']:.0f} ± {best['se']:.0f} "
        f"on {len(returns)} fresh episodes"
    )
    untouched, line = (
        float(run.progress[0]["real_return_deterministic"]),
        run.lines["trained on real"],
    )
    return (
        f"{run.folder}: best on real after grounding step {step}: {shown} "
        f"(before grounding {untouched:.0f}, trained on real {line:.0f})"
    )


def replay(folder):
    """Draw a run's best policy acting in sim and on real into the run's replay.gif."""
    run, saved = Run.open(folder)
    s = settings_of(folder, saved)
    policy = run.policy()
    worlds = {"sim": BatchEnv(s.env, 1), "real": BatchEnv(s.env, 1, parse_perturbation(s.real))}
    if s.real_data:
        worlds.pop("real")
    if policy.sizes[0] != worlds["sim"].single_observation_space.shape[0]:
        raise RunError(
            f"{folder}/policy.pt was trained on another task than {s.env}: start a new run"
        )
    returns = animate(policy, worlds, run.folder / "replay.gif")
    print(
        f"{run.folder / 'replay.gif'}: "
        + ", ".join(f"{name} {value:.0f}" for name, value in returns.items())
    )


class Parser(argparse.ArgumentParser):
    """Raises RunError where argparse would end the program."""

    def error(self, message):
        raise RunError(f"{message}; see --help")


def arguments():
    """The Parser of the command line: every Setting, and what to do with a run."""
    parser = Parser(
        prog="train.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for f in dataclasses.fields(Settings):
        words = dict(f.metadata)
        if f.default not in (None, "") and "(default:" not in words["help"]:
            words["help"] += f" (default: {f.default})"
        parser.add_argument(
            f"--{f.name.replace('_', '-')}", type=kind_of(f), default=f.default, **words
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
    parser.add_argument(
        "--tensorboard",
        action="store_true",
        help="write TensorBoard's scalars into the run's folder too",
    )
    return parser


def parse(argv):
    """The parsed command line; raises RunError where it makes no sense."""
    args = arguments().parse_args(argv)
    given = [f.name for f in dataclasses.fields(Settings) if getattr(args, f.name) != f.default]
    given += ["out"] * (args.out is not None)
    if args.resume:
        given = [name for name in given if name != "grounding_steps"]
    if given and (args.resume or args.replay):
        raise RunError(
            f"--{given[0].replace('_', '-')} cannot be changed: a run goes on in its "
            "folder with the settings it began with (but for more --grounding-steps); leave it out"
        )
    if args.tensorboard and importlib.util.find_spec("tensorboard") is None:
        raise RunError("--tensorboard needs TensorBoard: pip install tensorboard")
    if args.resume and args.replay:
        raise RunError("--resume and --replay are two things to do: give one of them")
    return args


def resumed(folder, grounding_steps=None):
    """A run of this version, and its settings up to as many steps (None: as it began with)."""
    run, saved = Run.open(folder)
    s = settings_of(folder, saved)
    run.require_this_version(dataclasses.asdict(s))
    if grounding_steps is not None:
        if grounding_steps < len(run.progress) - 1:
            raise RunError(
                f"{folder} has done {len(run.progress) - 1} grounding steps: "
                "--grounding-steps can only add to them"
            )
        s = dataclasses.replace(s, grounding_steps=grounding_steps)
        run.write_config(dataclasses.asdict(s))
    return run, s


def main(argv=None):
    """The command; returns its exit status.

    0: done; 2: a request that cannot be met, told in one line; 130: Ctrl-C."""
    run = None
    try:
        args = parse(argv)
        if args.replay:
            replay(args.replay)
            return 0
        if args.resume:
            run, s = resumed(args.resume, args.grounding_steps)
        else:
            s = Settings(
                **{f.name: getattr(args, f.name) for f in dataclasses.fields(Settings)}
            ).completed()
            check_files(s)
            run = Run.create(args.out or f"runs/{s.env}-{s.algo}-s{s.seed}", dataclasses.asdict(s))
        with quiet():  # MuJoCo's own warnings: an unstable simulation is told below, in one line
            algorithm_1(s, run, Bar(s, run, args.tensorboard and tensorboard(run.folder)))
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
