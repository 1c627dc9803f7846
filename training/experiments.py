"""The paper's experiments as runs of train.py: which arms, on which worlds, with which settings."""

import hashlib
from dataclasses import asdict, dataclass, replace
from itertools import product

from training.run_folder import versions
from training.settings import Settings

WIDTHS = (0.05, 0.1, 0.2, 0.4)  # of the action noise envelope, of which the paper reports the best
FREE = ("seed", "threads", "pretrained", "grounding_steps")  # settings that leave an arm what it is


@dataclass(frozen=True)
class Arm:
    """One line of one figure: a name, and the Settings that every seed of it shares."""

    experiment: str
    name: str
    settings: Settings

    def of(self, seed):
        """The complete Settings of one seed. Raises EnvError or RunError for impossible ones."""
        return replace(self.settings, seed=seed, threads=1).completed()

    @property
    def key(self):
        """A hash of what decides the numbers of this arm beside the seed: runs
        of other settings are other runs."""
        told = {k: v for k, v in asdict(self.of(0)).items() if k not in FREE}
        return hashlib.sha256(repr(sorted(told.items())).encode()).hexdigest()[:8]

    def start(self, seed):
        """What runs with the same first policy and reference line have in common."""
        s = self.of(seed)
        trained = (s.pretrain_steps, s.reference_steps, s.num_envs)
        return s.env, s.real, s.policy, s.seed, s.target, trained


def version():
    """The code that makes the numbers, in short."""
    now = versions()
    return f"{now['learner'][:8]}-{now['grounding'][:8]}"


def methods(experiment, **shared):
    """Every method on one world."""
    plain = "rgat", "gat", "sim", "solved", "real"
    arms = [Arm(experiment, algo, Settings(algo=algo, **shared)) for algo in plain]
    arms += [
        Arm(experiment, f"ane {width:g}", Settings(algo="ane", ane_width=width, **shared))
        for width in WIDTHS
    ]
    paper = Settings(algo="rgat", preset="paper", **shared)
    rolled = Settings(algo="rgat", roll_back=0.9, **shared)
    ceiling = Settings(algo="oracle", **shared)
    return [
        *arms,
        Arm(experiment, "rgat as printed", paper),
        Arm(experiment, "rgat, rolled back", rolled),
        Arm(experiment, "oracle", ceiling),
    ]


def amounts(experiment, algos, counts, **shared):
    """Return against the number of real episodes per grounding step."""
    return [
        Arm(experiment, f"{algo}, {n}", Settings(algo=algo, real_trajectories=n, **shared))
        for algo in algos
        for n in counts
    ]


def setting(kl=1e-2, entropy=1e-5, gamma=0.0):
    """The name of the arm with a setting of the transformer's TRPO, by default ours."""
    return f"KL {kl:g}, H {entropy:g}, gamma {gamma:g}"


def critical(experiment, **shared):
    """Section IV-D: trust region, entropy and discount of the transformer, end to end."""
    arms = []
    for kl, entropy, gamma in product((1e-4, 1e-3, 1e-2), (0.0, 1e-5, 1e-3), (0.0, 0.9, 0.99)):
        name = setting(kl, entropy, gamma)
        at = {"at_max_kl": kl, "at_entropy": entropy, "at_gamma": gamma}
        arms.append(Arm(experiment, name, Settings(algo="rgat", **at, **shared)))
    return arms


def capacity(experiment, envs):
    """What shallow and deep policies reach, trained on real alone."""
    alone = {"algo": "real", "grounding_steps": 0}
    return [
        Arm(experiment, f"{env}, {policy}", Settings(env=env, policy=policy, **alone))
        for env in envs
        for policy in ("shallow", "deep")
    ]


PENDULUM, HOPPER, CHEETAH = "InvertedPendulum-v4", "Hopper-v4", "HalfCheetah-v4"
GAP = "bthigh:gain*0.5,fthigh:gain*0.5"  # a HalfCheetah whose thighs are half as strong
EXPERIMENTS = {
    "pendulum, deep": methods("pendulum, deep", env=PENDULUM, grounding_steps=10),
    "pendulum, shallow": methods(
        "pendulum, shallow", env=PENDULUM, policy="shallow", grounding_steps=10
    ),
    "hopper": methods("hopper", env=HOPPER, grounding_steps=10),
    "cheetah": methods("cheetah", env=CHEETAH, grounding_steps=20),
    "cheetah with a gap": methods("cheetah with a gap", env=CHEETAH, real=GAP, grounding_steps=20),
    "capacity": capacity("capacity", (HOPPER, CHEETAH)),
    "data": amounts(
        *("data", ("rgat", "gat", "solved", "physics"), (1, 5, 10, 25, 50, 100)),
        env=HOPPER,
        grounding_steps=3,
    ),
    "critical": critical("critical", env=PENDULUM, grounding_steps=3),
}
