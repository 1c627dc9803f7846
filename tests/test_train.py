"""The command: every algorithm end to end, a run cut off anywhere and
resumed, bad input, replay."""

import csv
import errno
import json
import resource
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

ROOT = str(Path(__file__).resolve().parents[1])
import rgat
import train
import trpo
from diagnosis.common.atomic_files import write_whole
from envs import BatchEnv, EnvError
from models import GaussianPolicy
from rgat import GroundedEnv
from training import physics_grounding, run_folder
from training.settings import ALGOS

pytestmark = pytest.mark.filterwarnings("ignore")

ENV = "InvertedPendulum-v4"
TINY = (
    "--pretrain-steps 4000 --grounding-steps 2 --at-steps 1024 --policy-steps 4096 "
    "--real-trajectories 4 --eval-episodes 2 --num-envs 4 --threads 1 --seed 3"
).split()
PROGRESS = (
    "grounding_step,real_transitions,real_transitions_judging,sim_steps,"
    "real_return_deterministic,real_return_deterministic_se,real_return_stochastic,"
    "forward_model_error,at_one_step_error,identity_one_step_error,delta_action_rms,at_std,kl,"
    "rolled_back_to,seconds"
)


def command(out, algo="rgat", env=ENV, *more):
    return ["--env", env, "--algo", algo, "--out", str(out), *TINY, *more]


def table(path):
    return list(csv.DictReader(path.open(newline="")))


def contents(folder):
    """Every file below a folder, by name, as bytes."""
    return {
        str(p.relative_to(folder)): p.read_bytes()
        for p in sorted(Path(folder).rglob("*"))
        if p.is_file()
    }


def tensors(saved, prefix=""):
    """A checkpoint's leaves by path."""
    if isinstance(saved, dict):
        return {k: v for key in saved for k, v in tensors(saved[key], f"{prefix}/{key}").items()}
    if isinstance(saved, (list, tuple)):
        return {k: v for i, x in enumerate(saved) for k, v in tensors(x, f"{prefix}/{i}").items()}
    return {prefix: saved}


def assert_same_run(ours, theirs):
    """Two run folders hold the same numbers, but for the seconds."""
    drop = lambda rows: [{k: v for k, v in row.items() if k != "seconds"} for row in rows]
    assert drop(table(ours / "progress.csv")) == drop(table(theirs / "progress.csv"))
    assert (ours / "train.csv").read_bytes() == (theirs / "train.csv").read_bytes()
    for name in ("lines.json", "best.json"):
        assert json.loads((ours / name).read_text()) == json.loads((theirs / name).read_text())
    names = sorted(p.name for p in theirs.glob("*.pt"))
    assert names == sorted(p.name for p in ours.glob("*.pt"))
    for name in names:
        a, b = (tensors(torch.load(f / name, weights_only=True)) for f in (ours, theirs))
        assert a.keys() == b.keys()
        for key in a:
            assert torch.equal(a[key], b[key]) if torch.is_tensor(a[key]) else a[key] == b[key], (
                name,
                key,
            )
    for path in theirs.glob("real_*.npz"):
        with np.load(path) as a, np.load(ours / path.name) as b:
            assert all(np.array_equal(a[k], b[k]) for k in ("s", "a", "s_next"))


@pytest.fixture(scope="module", autouse=True)
def diagnosed_once():
    """The same recordings have the same diagnosis: each is worked out once."""
    known, whole = {}, physics_grounding.diagnose

    def diagnose(path, recordings):
        arrays = [a for r in recordings for a in vars(r).values() if isinstance(a, np.ndarray)]
        key = Path(path).read_bytes(), *(a.tobytes() for a in arrays)
        if key not in known:
            known[key] = whole(path, recordings)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(physics_grounding, "diagnose", diagnose)
        yield


@pytest.fixture(autouse=True)
def drawn_end_to_end_alone(request, monkeypatch):
    """Figures are a third of a small run's time: elsewhere a file stands for them."""
    if "end_to_end" not in request.node.name:
        stands = lambda run: write_whole(run.folder / "progress.png", b"a figure")
        monkeypatch.setattr(run_folder.Run, "plot", stands)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """finished(algo): the folder of an undisturbed run, made once."""
    folders = {}

    def make(algo):
        if algo not in folders:
            folder = tmp_path_factory.mktemp("runs") / algo
            assert train.main(command(folder, algo)) == 0
            folders[algo] = folder
        return folders[algo]

    return make


# --- end to end -----------------------------------------------------------------------------------


@pytest.mark.parametrize("algo", [algo for algo in ALGOS if "+" not in algo])
def test_every_algorithm_runs_end_to_end(algo, finished):
    folder = finished(algo)
    assert (folder / "progress.csv").read_text().splitlines()[0] == PROGRESS
    rows = table(folder / "progress.csv")
    assert [int(r["grounding_step"]) for r in rows] == [0, 1, 2]
    for row in rows:
        assert (
            float(row["real_return_deterministic"]) > 0 and float(row["real_return_stochastic"]) > 0
        )
    for row in rows[1:]:
        assert float(row["identity_one_step_error"]) > 0 and float(row["at_one_step_error"]) > 0
    real, sim = ([int(r[k]) for r in rows] for k in ("real_transitions", "sim_steps"))
    judging = [int(r["real_transitions_judging"]) for r in rows]
    assert 0 < judging[0] < judging[1] < judging[2]
    if algo not in ("sim", "ane", "real"):
        assert 0 == real[0] < real[1] < real[2]
        for step in (1, 2):
            with np.load(folder / f"real_{step:02d}.npz") as data:
                assert len(data["s"]) == real[step] - real[step - 1]
    spent = [b - a for a, b in zip(sim, sim[1:])]
    if algo in ("sim", "ane", "physics", "real"):
        assert spent == [0 if algo == "real" else 4096] * 2
    elif (
        algo == "rgat"
    ):  # f_psi's guesses: one sim step for each real row, and one beside each step of g_phi
        for n, real_rows in zip(spent, real[1:]):
            assert n == 4096 + 2 * 1024 + -(-real_rows // 4) * 4
    else:
        assert min(spent) > 4096
    assert (real if algo == "real" else sim)[0] == 4096
    config = json.loads((folder / "config.json").read_text())
    assert config["settings"]["algo"] == algo and config["settings"]["real"] == "pole:mass=100"
    assert len({r["phase"] for r in table(folder / "train.csv")}) >= 2
    for step in range(3):
        assert torch.load(folder / f"step_{step:02d}.pt", weights_only=True)
    with Image.open(folder / "progress.png") as image:
        assert image.format == "PNG" and image.width > 600
    assert not list(folder.glob(".*"))  # no half-written files
    lines = json.loads((folder / "lines.json").read_text())
    assert set(lines) == {"trained on real"}
    policy = GaussianPolicy.load(folder / "policy.pt")
    assert policy.sizes == (4, 64, 64, 1)


def test_step_0_is_the_untouched_sim_policy_and_the_saved_policy_the_best(finished):
    folder = finished("rgat")
    rows = table(folder / "progress.csv")
    start = torch.load(folder / "step_00.pt", weights_only=True)
    sim = train.Settings(env=ENV, seed=3, num_envs=4).completed()
    learner = train.new_learner(sim)
    learner.learn(BatchEnv(ENV, 4), 4096, train.seed_for(3, 0, "pretrain"), freeze_normalizer=False)
    assert all(
        torch.equal(v, start["learner"]["policy"][k])
        for k, v in learner.policy.state_dict().items()
    )
    best = int(np.argmax([float(r["real_return_deterministic"]) for r in rows]))
    acting = torch.load(folder / f"step_{best:02d}.pt", weights_only=True)["acting"]
    policy = torch.load(folder / "policy.pt", weights_only=True)
    assert all(torch.equal(v, policy["state"][k]) for k, v in acting["state"].items())
    verdict = json.loads((folder / "best.json").read_text())
    assert verdict["grounding_step"] == best and verdict["episodes"] == 4


@pytest.mark.parametrize("env", ["Hopper-v4", "HalfCheetah-v5"])
def test_the_other_robots_and_the_shallow_policy(env, tmp_path):
    more = [
        "--policy",
        "shallow",
        "--grounding-steps",
        "1",
        "--pretrain-steps",
        "0",
        "--policy-steps",
        "1",
        "--eval-episodes",
        "1",
    ]
    if env.startswith("HalfCheetah"):
        more += ["--real-trajectories", "1"]
    assert train.main(command(tmp_path / "run", "rgat", env, *more)) == 0
    assert len(table(tmp_path / "run" / "progress.csv")) == 2
    assert GaussianPolicy.load(tmp_path / "run" / "policy.pt").sizes[1:-1] == (4,)


def test_pretrained_policies_are_shared(tmp_path, monkeypatch, finished):
    shared = ["--pretrained", str(tmp_path / "shared")]
    assert train.main(command(tmp_path / "a", "sim", ENV, *shared)) == 0
    assert len(list((tmp_path / "shared").glob("*.pt"))) == 2
    phases = []
    phase = train.Bar.phase
    monkeypatch.setattr(
        train.Bar, "phase", lambda self, step, name: phases.append(name) or phase(self, step, name)
    )
    assert train.main(command(tmp_path / "b", "ane", ENV, *shared)) == 0
    assert "pretrain" not in phases and "reference" not in phases
    first = lambda folder: {
        k: v for k, v in table(folder / "progress.csv")[0].items() if k != "seconds"
    }
    assert first(tmp_path / "a") == first(tmp_path / "b") == first(finished("sim"))
    # what another version of the learner left there is not taken for this one's
    monkeypatch.setattr(train, "versions", lambda: {"learner": "older"})
    assert train.main(command(tmp_path / "c", "ane", ENV, *shared)) == 0
    assert {"pretrain", "reference"} <= set(phases)


# --- cut off and resumed --------------------------------------------------------------------------


class Killed(BaseException):
    """A kill: nothing in the program may catch it."""


def cut_off_at(monkeypatch, owner, name, count, error):
    """Make the count-th call of owner.name raise instead."""
    original, calls = getattr(owner, name), []

    def wrapped(*args, **kwargs):
        calls.append(name)
        if len(calls) == count:
            raise error
        return original(*args, **kwargs)

    monkeypatch.setattr(owner, name, wrapped)


# TRPO updates of the rgat run: 1 pretraining, 2 reference, 3 transformer and 4 policy of step 1, 5
# and 6 of step 2
@pytest.mark.parametrize(
    "algo, update",
    [("rgat", k) for k in (1, 2, 4, 5, 6)]
    + [("gat", 4), ("ane", 4), ("oracle", 4), ("physics", 4), ("real", 3), ("solved", 4)],
)
def test_resume_equals_no_interruption(algo, update, tmp_path, finished, monkeypatch):
    folder = tmp_path / "run"
    with monkeypatch.context() as patch:
        cut_off_at(patch, trpo.TRPO, "update", update, KeyboardInterrupt())
        assert train.main(command(folder, algo)) == 130
    assert not (folder / "best.json").exists()
    kept = contents(folder)
    assert train.main(["--resume", str(folder)]) == 0
    assert_same_run(folder, finished(algo))
    steps = [name for name in kept if name.startswith(("step_", "real_"))]
    assert all((folder / name).read_bytes() == kept[name] for name in steps)


@pytest.mark.parametrize("write", [3, 5, 9, 14])
def test_a_kill_while_writing_loses_nothing_that_was_whole(write, tmp_path, finished, monkeypatch):
    folder = tmp_path / "run"
    with monkeypatch.context() as patch, pytest.raises(Killed):
        cut_off_at(patch, run_folder.os, "replace", write, Killed())
        train.main(command(folder))
    assert train.main(["--resume", str(folder)]) == 0
    assert_same_run(folder, finished("rgat"))


# --- what a run leaves to others ------------------------------------------------------------------


@pytest.mark.parametrize("algo", ["rgat", "gat", "ane", "solved", "sim"])
def test_the_grounded_simulator_of_a_finished_run(algo, finished):
    folder = finished(algo)
    env = rgat.grounded_env(folder, num_envs=3)
    obs, _ = env.reset(seed=0)
    assert obs.shape == (3, 4) and env.num_envs == 3
    saved = torch.load(folder / "step_02.pt", weights_only=True)
    grounding = train.GROUNDINGS[algo](
        BatchEnv(ENV, 3), train.Settings(env=ENV).completed().grounding
    )
    grounding.load(saved["grounding"])
    expected = GroundedEnv(grounding.sim, grounding.transformer)
    expected.reset(seed=0)
    a = np.array([[0.5], [-1.0], [2.0]], np.float32)
    for _ in range(5):
        ours, theirs = env.step(a), expected.step(a)
        np.testing.assert_array_equal(ours[0], theirs[0])
    changed = grounding.transformer(theirs[0], a) if algo != "ane" else a + 1
    assert np.array_equal(changed, a) == (algo == "sim")


def test_sb3_trains_in_a_runs_grounded_simulator(finished):
    sb3 = pytest.importorskip("stable_baselines3")
    from sb3_adapter import SB3Env

    model = sb3.PPO("MlpPolicy", SB3Env(rgat.grounded_env(finished("rgat"), 4)), n_steps=64)
    model.learn(512)
    assert model.num_timesteps == 512


def test_a_run_without_that_grounding_step_is_named(finished, tmp_path):
    for folder, step in ((finished("rgat"), 3), (finished("rgat"), 0), (tmp_path, None)):
        with pytest.raises(EnvError, match=str(folder)):
            rgat.grounded_env(folder, step=step)


def test_a_saved_policy_keeps_its_robots_bounds(finished):
    policy = GaussianPolicy.load(finished("rgat") / "policy.pt")
    assert policy.low.tolist() == [-3] and policy.high.tolist() == [3]
    policy.net[-1].bias.data.fill_(50.0)
    assert policy.action(torch.zeros(2, 4)).tolist() == [[3.0]] * 2
    assert (policy.mean(torch.zeros(2, 4)) > 40).all()


def test_a_run_begins_with_the_policy_of_a_file(finished, tmp_path, capfd):
    given = finished("rgat") / "policy.pt"
    told = ["--policy-from", str(given), "--grounding-steps", "1", "--reference-steps", "4000"]
    assert train.main(command(tmp_path / "run", "rgat", ENV, *told)) == 0
    first = torch.load(tmp_path / "run" / "step_00.pt", weights_only=True)
    theirs = torch.load(given, weights_only=True)["state"]
    assert all(torch.equal(v, theirs[k]) for k, v in first["acting"]["state"].items())
    untrained = train.new_learner(train.Settings(env=ENV, seed=3).completed()).value
    weights = first["learner"]["value"]["net.0.weight"]
    assert not torch.equal(weights, untrained.state_dict()["net.0.weight"])
    rows = [r for r in table(tmp_path / "run" / "train.csv") if r["phase"] == "critic"]
    assert rows and {float(r["kl"]) for r in rows} == {0.0}
    refused(command(tmp_path / "b", "rgat", ENV, "--policy-from", "none.pt"), capfd, "none.pt")
    told = ["--policy-from", str(given), "--policy", "shallow"]
    refused(command(tmp_path / "c", "rgat", ENV, *told), capfd, "--policy", "(4, 64, 64, 1)")


def test_the_line_beside_a_given_policy_is_trained_on_real_for_as_long_as_ever(finished, tmp_path):
    given = str(finished("rgat") / "policy.pt")
    s = train.Settings(env=ENV, policy_from=given, pretrain_steps=7).completed()
    assert s.reference_steps == train.Settings(env=ENV).completed().reference_steps
    told = ["--policy-from", given, "--grounding-steps", "0", "--reference-steps", "4000"]
    assert train.main(command(tmp_path / "run", "real", ENV, *told)) == 0
    theirs = json.loads((finished("rgat") / "lines.json").read_text())
    assert json.loads((tmp_path / "run" / "lines.json").read_text()) == theirs
    [row] = table(tmp_path / "run" / "progress.csv")  # the critic's steps, not the line's
    rows = [r for r in table(tmp_path / "run" / "train.csv") if r["phase"] == "critic"]
    assert row["real_transitions"] == rows[-1]["steps"]


def test_tensorboard_on_request(tmp_path, capfd, monkeypatch):
    scalars = []

    class Board:
        def add_scalar(self, name, value, x):
            scalars.append((name, value, x))

    find = train.importlib.util.find_spec
    missing = lambda name: None if name == "tensorboard" else find(name)
    monkeypatch.setattr(train.importlib.util, "find_spec", missing)
    refused(command(tmp_path / "run", "sim", ENV, "--tensorboard"), capfd, "pip install")
    assert not (tmp_path / "run").exists()
    monkeypatch.setattr(train.importlib.util, "find_spec", lambda name: find("json"))
    monkeypatch.setattr(train, "tensorboard", lambda folder: Board())
    told = ["--grounding-steps", "1", "--tensorboard"]
    assert train.main(command(tmp_path / "run", "sim", ENV, *told)) == 0
    row = table(tmp_path / "run" / "progress.csv")[1]
    value = float(row["real_return_deterministic"])
    assert ("on real/real_return_deterministic", value, 1) in scalars
    assert any(name == "01 policy/kl" for name, _, _ in scalars)


# --- cut off, resumed, extended -------------------------------------------------------------------

MORE = "--grounding-steps 4 --policy-steps 2048 --at-steps 512 --real-trajectories 2".split()


@pytest.mark.parametrize("algo", ["rgat", "gat", "solved"])
def test_a_run_killed_after_any_step_goes_on_as_if_undisturbed(algo, tmp_path, monkeypatch):
    """Beyond the first steps: what a step leaves in memory must be what its checkpoint holds."""
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert train.main(command(whole, algo, ENV, *MORE)) == 0
    record = run_folder.Run.record
    for step in (2, 3):
        with monkeypatch.context() as patch, pytest.raises(Killed):

            def killed(run, *a):
                record(run, *a)
                if len(run.progress) == step + 1:
                    raise Killed

            patch.setattr(run_folder.Run, "record", killed)
            train.main(["--resume", str(cut)] if cut.exists() else command(cut, algo, ENV, *MORE))
    assert train.main(["--resume", str(cut)]) == 0
    assert_same_run(cut, whole)


def test_a_finished_run_can_be_extended(tmp_path, finished):
    folder, whole = tmp_path / "run", tmp_path / "whole"
    shutil.copytree(finished("rgat"), folder)
    assert train.main(["--resume", str(folder), "--grounding-steps", "3"]) == 0
    assert train.main(command(whole, "rgat", ENV, "--grounding-steps", "3")) == 0
    assert_same_run(folder, whole)
    assert json.loads((folder / "config.json").read_text())["settings"]["grounding_steps"] == 3


@pytest.mark.parametrize("name", ["learner", "grounding", "torch"])
def test_a_run_of_another_version_is_not_gone_on_with(name, tmp_path, capfd, finished):
    folder = tmp_path / "run"
    shutil.copytree(finished("rgat"), folder)
    config = json.loads((folder / "config.json").read_text())
    config["versions"][name] = "older"
    (folder / "config.json").write_text(json.dumps(config))
    before = contents(folder)
    refused(["--resume", folder], capfd, str(folder), name, "older")
    assert contents(folder) == before


def test_threads_change_no_number(tmp_path, finished):
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        assert train.main(command(tmp_path / "run", "rgat", ENV, "--threads", "2")) == 0
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
    drop = lambda rows: [{k: v for k, v in row.items() if k != "seconds"} for row in rows]
    for name in ("progress.csv", "train.csv"):
        ours, theirs = (drop(table(f / name)) for f in (tmp_path / "run", finished("rgat")))
        assert ours == theirs


def test_a_policy_that_got_worse_is_rolled_back(tmp_path, monkeypatch):
    folder = tmp_path / "run"
    returns, rollouts = iter([50.0, 80.0, 60.0, 90.0]), train.rollouts

    def judged(policy, env, episodes, seed, deterministic=False):
        found, tau = rollouts(policy, env, episodes, seed, deterministic)
        if deterministic and getattr(env, "is_real", True) and judged.counts:
            found = np.full(episodes, next(returns, 10.0))
        return found, tau

    judged.counts = False
    record = train.record

    def counted(*a):
        judged.counts = True
        record(*a)
        judged.counts = False

    monkeypatch.setattr(train, "rollouts", judged)
    monkeypatch.setattr(train, "record", counted)
    more = ["--roll-back", "0.9", "--grounding-steps", "3"]
    assert train.main(command(folder, "sim", ENV, *more)) == 0
    rows = table(folder / "progress.csv")
    assert [r["rolled_back_to"] for r in rows] == ["", "", "1", ""]
    saved = [torch.load(folder / f"step_{k:02d}.pt", weights_only=True) for k in range(4)]
    policy = lambda k: tensors(saved[k]["learner"])
    assert all(torch.equal(policy(2)[k], policy(1)[k]) for k in policy(1) if "policy" in k)
    assert not all(torch.equal(policy(3)[k], policy(1)[k]) for k in policy(1) if "policy" in k)
    tried = saved[2]["acting"]["state"]["net.0.weight"]
    assert not torch.equal(tried, policy(1)["/policy/net.0.weight"])


def test_resuming_a_finished_run_changes_nothing(tmp_path, finished):
    folder = tmp_path / "run"
    shutil.copytree(finished("rgat"), folder)
    before = contents(folder)
    assert train.main(["--resume", str(folder)]) == 0
    assert contents(folder) == before


# --- bad input ------------------------------------------------------------------------------------


def refused(argv, capfd, *says):
    """Exit status 2 and one line on stderr that says so."""
    capfd.readouterr()
    try:
        status = train.main([str(a) for a in argv])
    except SystemExit as leave:  # argparse's way
        status = leave.code
    err = capfd.readouterr().err
    assert status == 2, err
    lines = err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("train.py: "), err
    for words in says:
        assert words in lines[0], err


BAD = {
    "env": (["--env", "Walker2d-v4"], "Hopper-v4"),
    "algo": (["--algo", "sac"], "rgat"),
    "policy": (["--policy", "wide"], "deep"),
    "no perturbation": (["--real", "torso"], "NAME:FIELD"),
    "operator": (["--real", "pole:mass+1"], "NAME:FIELD"),
    "value": (["--real", "pole:mass=heavy"], "pole:mass=heavy"),
    "field": (["--real", "pole:colour=1"], "colour"),
    "body": (["--real", "torso:mass*1.27"], "pole"),
    "joint": (["--real", "knee:damping=1"], "hinge"),
    "too heavy": (["--real", "pole:mass*1e308"], "smaller"),
    "negative mass": (["--real", "pole:mass=-1"], "positive"),
    "seed": (["--seed", "-1"], "--seed"),
    "pretrain": (["--pretrain-steps", "-5"], "--pretrain-steps"),
    "grounding": (["--grounding-steps", "-1"], "--grounding-steps"),
    "trajectories": (["--real-trajectories", "0"], "--real-trajectories"),
    "at steps": (["--at-steps", "-1"], "--at-steps"),
    "policy steps": (["--policy-steps", "-1"], "--policy-steps"),
    "episodes": (["--eval-episodes", "0"], "--eval-episodes"),
    "envs": (["--num-envs", "0"], "--num-envs"),
    "threads": (["--threads", "-2"], "--threads"),
    "a word for a number": (["--num-envs", "many"], "num-envs"),
    "kl": (["--at-max-kl", "0"], "--at-max-kl"),
    "nan": (["--at-std", "nan"], "--at-std"),
    "gamma": (["--at-gamma", "1"], "--at-gamma"),
    "width": (["--ane-width", "-1"], "--ane-width"),
    "option": (["--pole-mass", "100"], "--pole-mass"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_options(name, tmp_path, capfd):
    options, says = BAD[name]
    refused(command(tmp_path / "run", "rgat", ENV, *options), capfd, says)
    assert not (tmp_path / "run").exists()  # the corrected command finds its place free


def test_out_that_cannot_be_used(tmp_path, capfd, finished):
    (tmp_path / "file").write_text("mine")
    refused(command(tmp_path / "file"), capfd, "file", "--out")
    assert (tmp_path / "file").read_text() == "mine"
    refused(command("/proc/run"), capfd, "/proc/run", "--out")
    refused(command(tmp_path / ("x" * 300)), capfd, "--out")
    before = contents(finished("rgat"))
    refused(command(finished("rgat")), capfd, "--resume")
    refused(["--resume", finished("rgat"), "--grounding-steps", "1"], capfd, "--grounding-steps")
    refused([*command(tmp_path / "run"), "--pretrained", tmp_path / "file"], capfd, "--pretrained")
    assert contents(finished("rgat")) == before


def test_out_without_space(tmp_path, capsys):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))
    try:
        status = train.main(command(tmp_path / "run"))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    err = capsys.readouterr().err  # the limit is on pytest's own files too
    assert status == 2 and len(err.splitlines()) == 1 and "cannot write" in err
    assert contents(tmp_path) == {}


@pytest.mark.parametrize("write", [5, 11])
def test_a_disk_that_fills_up_leaves_whole_steps(write, tmp_path, capfd, finished, monkeypatch):
    folder, full = tmp_path / "run", OSError(errno.ENOSPC, "No space left on device")
    with monkeypatch.context() as patch:
        cut_off_at(patch, run_folder.os, "replace", write, full)
        refused(command(folder), capfd, "No space left", "choose another folder")
    assert not list(folder.glob(".*"))
    assert train.main(["--resume", str(folder)]) == 0
    assert_same_run(folder, finished("rgat"))


SETTINGS = {
    "config with a word for a number": ("num_envs", "many"),
    "config with half a seed": ("seed", 0.5),
    "config with another algo": ("algo", "sac"),
    "config with another policy": ("policy", "wide"),
    "config with a number for a change": ("real", 5),
}
LINES = {
    "lines in a list": "[1]",
    "lines of something else": '{"a": 1}',
    "line without a number": '{"trained on real": "high"}',
}


def break_run(folder, how):
    step = folder / "step_02.pt"
    if how == "no run":
        shutil.rmtree(folder)
    elif how == "config of something else":
        (folder / "config.json").write_text('{"name": "web", "version": 2}')
    elif how == "config with foreign settings":
        (folder / "config.json").write_text(
            '{"settings": {"env": "Hopper-v4", "learning_rate": 0.1}}'
        )
    elif how in SETTINGS:
        config = json.loads((folder / "config.json").read_text())
        config["settings"].update([SETTINGS[how]])
        (folder / "config.json").write_text(json.dumps(config))
    elif how in LINES:
        (folder / "lines.json").write_text(LINES[how])
    elif how == "config cut short":
        (folder / "config.json").write_text((folder / "config.json").read_text()[:40])
    elif how == "progress without numbers":
        (folder / "progress.csv").write_text("grounding_step,seconds\n0,\n")
    elif how == "checkpoint that is a tensor":
        torch.save(torch.zeros(3), step)
    elif how == "table cut short":
        (folder / "train.csv").write_text("grounding_step,phase\nx,policy\n")
    elif how == "checkpoint missing":
        step.unlink()
    elif how == "checkpoint cut short":
        step.write_bytes(step.read_bytes()[:1000])
    elif how == "checkpoint of something else":
        torch.save({"weights": torch.zeros(3)}, step)
    elif how == "checkpoint of another robot":
        saved = torch.load(step, weights_only=True)
        saved["learner"]["policy"] = GaussianPolicy(11, 3).state_dict()
        torch.save(saved, step)
    elif how == "checkpoint that is a list":
        torch.save([1, 2], step)
    elif how == "real data missing":
        (folder / "real_01.npz").unlink()
    elif how == "real data broken":
        (folder / "real_01.npz").write_bytes(b"PK\x03\x04 no archive")
    elif how == "policy broken":
        (folder / "policy.pt").write_bytes(b"not a policy")
    elif how == "policy missing":
        (folder / "policy.pt").unlink()


BROKEN = (
    "no run,config of something else,config with foreign settings,config cut short,"
    "table cut short,progress without numbers,checkpoint that is a tensor,"
    "checkpoint missing,checkpoint cut short,checkpoint of something else,"
    "checkpoint of another robot,checkpoint that is a list,"
    "real data missing,real data broken,policy broken,policy missing"
).split(",") + [*SETTINGS, *LINES]


@pytest.mark.parametrize("how", BROKEN)
def test_a_broken_or_foreign_run_is_refused_and_left_alone(how, tmp_path, capfd, finished):
    folder = tmp_path / "run"
    shutil.copytree(finished("rgat"), folder)
    break_run(folder, how)
    before = contents(tmp_path)
    refused(["--resume", folder], capfd, str(folder))
    if how in ("no run", "config of something else", "policy broken", "policy missing"):
        refused(["--replay", folder], capfd, str(folder))
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    "line, says",
    [
        (["--out", "runs/b"], "--out cannot be changed"),
        (["--replay", "runs/b"], "give one of them"),
    ],
)
def test_requests_that_contradict_themselves(line, says, capfd):
    refused(["--resume", "runs/a", *line], capfd, says)


def test_a_broken_shared_policy_is_named(tmp_path, capfd, finished):
    shared = tmp_path / "shared"
    options = ["--pretrained", str(shared), "--grounding-steps", "0"]
    assert train.main(command(tmp_path / "a", "real", ENV, *options)) == 0
    for path in shared.glob("*.pt"):
        path.write_bytes(b"broken")
    refused(command(tmp_path / "b", "real", ENV, *options), capfd, str(shared))
    for path in shared.glob("*.pt"):
        torch.save({"policy": {}}, path)
    refused(command(tmp_path / "c", "real", ENV, *options), capfd, str(shared))


def test_an_unstable_real_world_ends_in_one_line(tmp_path, capfd):
    refused(
        command(tmp_path / "run", "rgat", ENV, "--real", "world:gravity=1e12"),
        capfd,
        "unstable",
        "--real",
    )


def test_help_has_a_line_for_each_setting(capsys):
    with pytest.raises(SystemExit) as leave:
        train.main(["--help"])
    text = capsys.readouterr().out
    assert leave.value.code == 0
    steps = "pretrain-steps grounding-steps at-steps policy-steps real-trajectories eval-episodes"
    for name in f"env algo seed real policy {steps} num-envs out resume replay".split():
        assert f"--{name} " in text


# --- replay ---------------------------------------------------------------------------------------


def test_replay_draws_sim_and_real_side_by_side(tmp_path, finished, capsys):
    folder = tmp_path / "run"
    shutil.copytree(finished("sim"), folder)
    before = contents(folder)
    assert train.main(["--replay", str(folder)]) == 0
    with Image.open(folder / "replay.gif") as gif:
        assert gif.format == "GIF" and gif.n_frames > 1
        frames = []
        for k in (0, gif.n_frames - 1):
            gif.seek(k)
            frames.append(np.asarray(gif.convert("RGB")).astype(int))
        assert gif.width == 2 * 400
    assert np.abs(frames[0] - frames[1]).max() > 50  # something moves
    assert "sim" in capsys.readouterr().out
    after = contents(folder)
    after.pop("replay.gif")
    assert after == before
