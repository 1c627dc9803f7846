"""Recordings of the actual robot: what becomes a transition, what is refused, a run on them."""

import csv

import numpy as np
import pytest
import torch

import train
from envs import BatchEnv, parse_perturbation
from models import GaussianPolicy
from training.real_data import RealData
from training.run_folder import RunError

ENV = "InvertedPendulum-v4"
HEAD = ["time", "qpos:slider", "qpos:hinge", "qvel:slider", "qvel:hinge", "ctrl:slide"]
TINY = (
    "--pretrain-steps 4000 --at-steps 1024 --policy-steps 4096 --num-envs 4 --threads 1 --seed 3"
).split()


def names(env):
    joints = [env.model.joint(j).name for j in range(env.model.njnt)]
    return [
        "time",
        *(f"{k}:{j}" for k in ("qpos", "qvel") for j in joints),
        f"ctrl:{env.model.actuator(0).name or 0}",
    ]


def write(path, header, rows):
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])


def record(folder, name, steps=40, seed=0, every=1, velocities=True):
    """An episode of a heavy pole under random actions, as a CSV; every: rows per control period."""
    env = BatchEnv(ENV, 1, parse_perturbation("pole:mass=100"), nthread=1)
    env.frame_skip = env.frame_skip // every
    env.reset(seed=seed)
    rng, rows, action = np.random.default_rng(seed), [], None
    for t in range(steps):
        action = rng.uniform(-1, 1, (1, 1)) if t % every == 0 else action
        state = [*env.qpos[0], *(env.qvel[0] if velocities else ["", ""])]
        rows.append([t * env.dt / every, *state, action[0, 0]])
        if env.step(action)[2][0]:
            break
    folder.mkdir(exist_ok=True)
    write(folder / name, names(env), rows)
    return rows


def test_rows_become_transitions_and_the_last_fifth_is_held_out(tmp_path):
    rows = np.array(record(tmp_path / "data", "a.csv", 31), float)
    real = RealData(tmp_path / "data", BatchEnv(ENV, 4, nthread=1))
    tau, held_out = real.collect(), real.held_out()
    s, a = rows[:, 1:5].astype(np.float32), rows[:, 5:].astype(np.float32)
    n = len(rows) - 1
    assert len(tau) == n - n // 5 and len(held_out) == n // 5
    joined = tau + held_out
    np.testing.assert_array_equal(joined.s, s[:-1])
    np.testing.assert_array_equal(joined.s_next, s[1:])
    np.testing.assert_array_equal(joined.a, a[:-1])
    assert len(real.collect()) == 0  # nothing new
    record(tmp_path / "data", "b.csv", seed=1)
    again = RealData(tmp_path / "data", BatchEnv(ENV, 4, nthread=1), seen=real.seen)
    assert len(again.collect()) > 10 and len(again.seen) == 2


def test_a_finer_clock_and_missing_velocities(tmp_path):
    sim = BatchEnv(ENV, 4, nthread=1)
    fine = np.array(record(tmp_path / "fine", "a.csv", 41, every=2), float)
    tau = RealData(tmp_path / "fine", sim)
    joined = tau.collect() + tau.held_out()
    np.testing.assert_array_equal(joined.s, fine[: 2 * len(joined) : 2, 1:5].astype(np.float32))
    kept = np.array(record(tmp_path / "whole", "a.csv", 41), float)
    record(tmp_path / "bare", "a.csv", 41, velocities=False)
    bare = RealData(tmp_path / "bare", sim)
    joined = bare.collect() + bare.held_out()
    expected = (kept[2:, 1:3] - kept[:-2, 1:3]) / (2 * sim.dt)
    np.testing.assert_allclose(joined.s[:, 2:], expected[: len(joined)], rtol=1e-4, atol=1e-5)


def test_a_run_on_recordings_goes_on_with_new_ones(tmp_path, capsys):
    data, out = tmp_path / "data", tmp_path / "run"
    for k in range(6):
        record(data, f"{k}.csv", seed=k)
    told = ["--env", ENV, "--algo", "rgat", "--real-data", str(data), "--out", str(out), *TINY]
    assert train.main(told) == 0
    assert "--grounding-steps 2" in capsys.readouterr().out
    rows = list(csv.DictReader((out / "progress.csv").open(newline="")))
    assert [r["real_return_deterministic"] for r in rows] == ["", ""]
    first = int(rows[1]["real_transitions"])
    assert 0 < float(rows[1]["at_one_step_error"]) and first > 0
    for k in range(6, 9):
        record(data, f"{k}.csv", seed=k)
    assert train.main(["--resume", str(out), "--grounding-steps", "2"]) == 0
    rows = list(csv.DictReader((out / "progress.csv").open(newline="")))
    assert int(rows[2]["real_transitions"]) > first
    policy = GaussianPolicy.load(out / "policy.pt").state_dict()
    last = torch.load(out / "step_02.pt", weights_only=True)["acting"]["state"]
    assert all(torch.equal(v, last[k]) for k, v in policy.items())
    assert not (out / "best.json").exists() and not (out / "lines.json").exists()


def test_recordings_of_another_robot_clock_or_place_are_refused_in_one_line(tmp_path, capfd):
    def refused(folder, *says, algo="rgat"):
        told = ["--env", ENV, "--algo", algo, "--real-data", str(folder), *TINY]
        assert train.main([*told, "--out", str(tmp_path / "run")]) == 2
        err = capfd.readouterr().err.strip().splitlines()
        assert len(err) == 1 and all(words in err[0] for words in says), err
        assert not (tmp_path / "run").exists()

    refused(tmp_path / "none", "none")
    (tmp_path / "empty").mkdir()
    refused(tmp_path / "empty", "no recordings")
    (tmp_path / "other").mkdir()
    write(
        tmp_path / "other" / "a.csv", ["time", "qpos:knee", "ctrl:knee"], [[0, 0, 0], [0.1, 0, 0]]
    )
    refused(tmp_path / "other", "knee")
    rows = record(tmp_path / "odd", "a.csv")
    write(tmp_path / "odd" / "a.csv", names(BatchEnv(ENV, 1)), [[1.3 * r[0], *r[1:]] for r in rows])
    refused(tmp_path / "odd", "a.csv", "0.04")
    refused(tmp_path / "odd", "oracle", algo="oracle")
    with pytest.raises(RunError):
        RealData(tmp_path / "odd", BatchEnv(ENV, 1))


def test_what_was_never_measured_is_named_before_anything_is_trained(tmp_path):
    sim, header = BatchEnv(ENV, 1), names(BatchEnv(ENV, 1))
    rows = record(tmp_path / "blind", "a.csv", velocities=False)
    hinge = [[*row[:2], "", *row[3:]] for row in rows]
    write(tmp_path / "blind" / "a.csv", header, hinge)
    with pytest.raises(RunError, match="never measured: qpos:hinge;"):
        RealData(tmp_path / "blind", sim)
    record(tmp_path / "short", "a.csv", 5)
    with pytest.raises(RunError, match="4 usable rows, and none to judge by"):
        RealData(tmp_path / "short", sim)
