"""reproduce.py: which runs are made and in what order; the statistics of the claims by hand."""

import itertools
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

import reproduce
from diagnosis.common.atomic_files import write_table
from training import claims, claims_page
from training.experiments import EXPERIMENTS, Arm, version
from training.measured import Data, by_experiment
from training.results import JUDGED, PROGRESS, ROUNDS, finished, merge, read, rows_of, write
from training.settings import Settings

ROOT = Path(__file__).resolve().parents[1]
TINY = dict(env="InvertedPendulum-v4", pretrain_steps=1000, policy_steps=500, grounding_steps=2)


def arm(name="rgat", **changes):
    return Arm("try", name, Settings(**{**TINY, "algo": name, **changes}))


def fill(job, steps, value=100.0):
    """What a run leaves in its folder after `steps` grounding steps."""
    job.folder.mkdir(parents=True, exist_ok=True)
    row = {"at_one_step_error": 0.1, **dict.fromkeys(PROGRESS[:4], 0)}
    rows = [
        {
            **dict.fromkeys(PROGRESS, ""),
            **row,
            "grounding_step": k,
            "real_return_deterministic": value + k,
        }
        for k in range(steps + 1)
    ]
    write_table(job.folder / "progress.csv", PROGRESS, rows)
    best = {"grounding_step": steps, "episodes": 4, "real_return_deterministic": value, "se": 1.0}
    (job.folder / "best.json").write_text(json.dumps(best))
    (job.folder / "lines.json").write_text('{"trained on real": 200.0}')


def test_every_experiment_can_be_asked_of_train(tmp_path):
    import train

    for arms in EXPERIMENTS.values():
        assert len({a.name for a in arms}) == len({a.key for a in arms}) == len(arms)
        for a in arms:
            job = reproduce.Job(a, 3, None, tmp_path)
            parsed = vars(train.parse(job.command()))
            told = {k: parsed[k] for k in vars(a.settings)}
            told = Settings(**{**told, "pretrained": ""}).completed()
            assert told == a.of(3)


def test_a_row_of_other_settings_or_of_another_version_is_not_taken_for_this_runs(tmp_path):
    path, now = (tmp_path / "rounds.csv", tmp_path / "judged.csv"), "v1"
    job = reproduce.Job(arm(), 0, 2, tmp_path / "runs")
    assert not finished(path, job, now)
    fill(job, 1)
    reproduce.keep_rows(path, rows_of(job, now, "abc"))
    assert not finished(path, job, now)  # one of two steps
    fill(job, 2)
    rounds, judged = rows_of(job, now, "abc")
    assert len(merge(path, (rounds, []))[0]) == 3
    write(path[0], rounds, ROUNDS)
    write(path[1], [], JUDGED)
    assert not finished(path, job, now)  # not judged: a run that was cut off before its verdict
    reproduce.keep_rows(path, (rounds, judged))
    assert len(read(path[0])) == 3 and finished(path, job, now)
    assert not finished(path, job, "v2")
    assert not finished(path, reproduce.Job(arm(), 0, 20, tmp_path), now)
    assert not finished(path, reproduce.Job(arm(), 1, 2, tmp_path), now)
    other = arm(at_gamma=0.5)
    assert other.key != arm().key == arm(grounding_steps=7).key == arm(seed=4, threads=2).key
    assert not finished(path, reproduce.Job(other, 0, 2, tmp_path), now)
    assert reproduce.Job(other, 0, 2, tmp_path).folder != job.folder


def test_a_folder_that_is_there_goes_on_and_is_asked_for_more_steps(tmp_path):
    job = reproduce.Job(arm(), 0, 20, tmp_path)
    job.folder.mkdir(parents=True)
    (job.folder / "config.json").write_text("{}")
    assert job.command() == ["--resume", str(job.folder), "--grounding-steps", "20"]


def test_merged_tables_keep_the_run_that_went_further_and_its_verdict(tmp_path):
    sides = []
    for name, steps in (("a", 1), ("b", 2)):
        job = reproduce.Job(arm(), 0, 2, tmp_path / name)
        fill(job, steps, value=10.0 * steps)
        sides.append([tmp_path / name / f"{table}.csv" for table in ("rounds", "judged")])
        reproduce.keep_rows(sides[-1], rows_of(job, "v1", "abc"))
    for one, other in itertools.permutations(sides):
        rounds, judged = merge(one, [read(path) for path in other])
        values = [float(row["real_return_deterministic"]) for row in rounds]
        assert sorted(values) == [20.0, 21.0, 22.0]
        assert [row["real_return_deterministic"] for row in judged] == ["20.0"]


def test_what_cannot_be_met_is_told_in_one_line(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    for told, says in (
        (["--arms", "rgat", "no such"], "'no such'"),
        (["--merge", str(tmp_path / "empty")], "rounds.csv"),
    ):
        folders = ["--results", str(tmp_path), "--runs", str(tmp_path)]
        assert reproduce.main([*told, "--minutes", "0", *folders]) == 2
        [line] = capsys.readouterr().err.splitlines()
        assert says in line


def test_one_job_trains_what_others_begin_with_and_none_is_lost(tmp_path, monkeypatch):
    """Four arms of two seeds, three at a time; each records its begin and end; one fails."""
    jobs = [
        reproduce.Job(arm(n), seed, 1, tmp_path)
        for seed in (0, 1)
        for n in ("rgat", "gat", "sim", "ane")
    ]
    log = tmp_path / "log"
    log.write_text("")

    def start(job):
        fill_later = """if True:
            import sys, time, pathlib
            folder, log = pathlib.Path(sys.argv[1]), open(sys.argv[2], "a", buffering=1)
            folder.mkdir(parents=True)
            print("begins", folder.name, file=log)
            time.sleep(0.3)
            (folder / "progress.csv").write_text("")
            print("has begun", folder.name, file=log)
            time.sleep(0.6)
            sys.exit("-gat-" in folder.name and "s1" in folder.name)"""
        job.process = subprocess.Popen([sys.executable, "-c", fill_later, job.folder, log])

    monkeypatch.setattr(reproduce.Job, "start", start)
    monkeypatch.setattr(reproduce.Job, "said", lambda job: ["no"])
    monkeypatch.setattr(reproduce.time, "sleep", lambda s, sleep=reproduce.time.sleep: sleep(0.05))
    kept = []
    failed = reproduce.run_all(jobs, 3, float("inf"), kept.append)
    assert sorted(j.folder.name for j in kept) == sorted(j.folder.name for j in jobs)
    assert [(j.arm.name, j.seed) for j in failed] == [("gat", 1)]
    for seed in (0, 1):
        mine = [line for line in log.read_text().splitlines() if line.endswith(f"s{seed}")]
        assert mine[0].startswith("begins") and mine[1].startswith("has begun")


def test_it_stops_in_time_and_says_what_waits(tmp_path, monkeypatch, capsys):
    def start(job):
        fill(job, 1)
        job.process = reproduce.process(["-c", "import time; time.sleep(60)"], None)
        signal.signal(signal.SIGINT, before)

    # as behind nohup, or & in a script
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    begun = time.monotonic()
    monkeypatch.setattr(reproduce.Job, "start", start)
    monkeypatch.setitem(EXPERIMENTS, "hopper", [arm()])
    told = ["--experiments", "hopper", "--seeds", "0", "1", "--minutes", "0.02", "--commit", "abc"]
    folders = ["--runs", str(tmp_path / "runs"), "--results", str(tmp_path)]
    assert reproduce.main([*told, *folders]) == 1
    rows = read(tmp_path / "rounds.csv")
    assert [(r["seed"], r["grounding_step"]) for r in rows] == [("0", "0"), ("0", "1")]
    assert {r["commit"] for r in rows} == {"abc"} and {r["version"] for r in rows} == {version()}
    assert "0 of 2 runs" in capsys.readouterr().out
    assert time.monotonic() - begun < 30


def test_a_table_that_is_none_is_told_in_one_line(tmp_path, capsys):
    (tmp_path / "rounds.csv").write_text("name,value\na,1\n")
    assert reproduce.main(["--claims", "--results", str(tmp_path)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


# --- the claims -----------------------------------------------------------------------------------


def test_permutation_by_hand():
    assert claims.permutation_p(np.array([1.0, 2.0, 3.0])) == 1 / 8
    assert claims.permutation_p(np.array([3.0, -1.0, 2.0])) == 2 / 8
    assert claims.permutation_p(np.array([-1.0, -2.0])) == 1.0
    assert claims.permutation_p(np.zeros(5)) == 1.0
    assert claims.permutation_p(np.ones(10)) == 1 / 1024
    assert claims.permutation_p(np.ones(20)) < 1e-4


def test_holm_by_hand():
    np.testing.assert_allclose(
        claims.holm([0.01, 0.04, np.nan, 0.03, 0.005]), [0.03, 0.06, np.nan, 0.06, 0.02]
    )
    assert claims.holm([0.9, 0.8]).tolist() == [1.0, 1.0]


def test_verdicts():
    assert claims.verdict(5.0, 0.01, 10) == "holds"
    assert claims.verdict(5.0, 0.2, 10) == "undecided"
    assert claims.verdict(-1.0, 1.0, 10) == "does not hold"
    assert claims.verdict(-1.0, 1.0, 2) == claims.verdict(5.0, 0.01, 2) == "undecided"


def row(arm, seed, step, value, v="v1", error="", env="Hopper-v4"):
    told = {
        "experiment": "hopper",
        "env": env,
        "settings": "s",
        "arm": arm,
        "seed": seed,
        "version": v,
        "commit": "c",
        "grounding_step": step,
    }
    return {**told, "real_return_deterministic": value, "at_one_step_error": error}


def test_pairs_are_of_seeds_that_both_have_over_rounds_that_both_have():
    rounds = [row("rgat", s, k, 10 * s + k) for s in (0, 1, 2) for k in range(4)]
    rounds += [row("gat", s, k, 10 * s - k) for s in (1, 2, 3) for k in range(3)]
    data = Data(rounds, [{"arm": "rgat", "seed": 1, "trained_on_real": 10}])
    for claim, values, after in (
        (claims.above("rgat", "gat"), [3.0, 3.0], 2),  # 2 * mean(1, 2)
        (claims.reaches("rgat"), [(13 - 9) / 10], 3),
        (claims.reaches("rgat", 1), [(11 - 9) / 10], 1),
        (claims.falls_short("rgat"), [-0.4], 3),
    ):
        got, rounds_of_it = claim(data)
        np.testing.assert_allclose(got, values)
        assert rounds_of_it == after


def test_seeds_that_begin_with_other_policies_are_not_compared():
    rounds = [row(arm, s, k, 10 * k) for arm in ("solved", "rgat") for s in (0, 1) for k in (0, 1)]
    rounds[0]["real_return_deterministic"] = 7.0  # of solved, seed 0, before grounding
    values, after = claims.above("solved", "rgat")(Data(rounds, []))
    assert values.tolist() == [0.0] and after == 1


def test_precision_is_compared_among_methods_of_one_learner_policy_and_number_of_rounds():
    rising = [(0.0, 9.0), (1.0, 3.0), (2.0, 2.0), (3.0, 1.0)]  # return, error: they agree
    arms = {
        "rgat": rising,
        "gat": rising,
        "solved": rising[:2],  # fewer rounds
        "sim": [(9.0, 9.0), *rising[:0:-1]],  # another policy, and an order that would not agree
        "ane 0.4": [rising[0], (5.0, 9.0), (6.0, 9.5), (7.0, 9.7)],
        "rgat as printed": [(0.0, 9.0)] + 10 * [(8.0, 9.9)],
    }
    rounds = [
        row(arm, seed, k, value, error=error)
        for arm, run in arms.items()
        for seed in (0, 1)
        for k, (value, error) in enumerate(run)
    ]
    values, after = claims.precision_explains(Data(rounds, []))
    np.testing.assert_allclose(values, [1.0, 1.0])
    assert after == 3


def test_a_line_is_that_of_one_task_and_of_the_arm_with_most_seeds():
    line = lambda arm, seed: {"arm": arm, "seed": seed, "trained_on_real": seed}
    ended = [line("few", 0), line("many", 1), line("many", 2)]
    one = [row(r["arm"], r["seed"], 0, 1.0) for r in ended]
    assert Data(one, ended).line().tolist() == [1, 2]
    two = [*one[:2], row("many", 2, 0, 1.0, env="HalfCheetah-v4")]
    assert not len(Data(two, ended).line())
    assert "trained on real" not in claims_page.rounds_of("x", Data(two, ended))


def test_capacity_is_a_claim_of_each_task():
    rounds = [
        row(f"{env}, {policy}", 0, 0, value, env=env)
        for env, shallow in (("Hopper-v4", 1.0), ("HalfCheetah-v4", 9.0))
        for policy, value in (("shallow", shallow), ("deep", 4.0))
    ]
    made = claims.table(
        [{**r, "experiment": "capacity"} for r in rounds],
        [{**r, "experiment": "capacity", "trained_on_real": 1.0} for r in rounds],
        [],
    )
    assert [float(r["value"]) for r in made] == [0.25, -1.75]


def test_versions_are_never_put_together():
    rounds = [row("rgat", s, 0, 1.0) for s in range(3)] + [
        row("rgat", s, 0, 5.0, "v2") for s in range(9)
    ]
    ended = [{**r, "trained_on_real": 7.0 + (r["version"] == "v2")} for r in rounds]
    data = by_experiment(rounds, ended)["hopper"]
    assert data.version == "v2" and len(data.returns["rgat"]) == 9
    assert set(data.line()) == {8.0}
    data = by_experiment(rounds, ended[:4])["hopper"]  # what has not ended does not count
    assert data.version == "v1" and len(data.returns["rgat"]) == 3


def test_the_documents_tables_are_the_tables_of_the_csvs():
    rounds, judged, transformers = (
        read(ROOT / "results" / f"{n}.csv") for n in ("rounds", "judged", "transformers")
    )
    made = claims.table(rounds, judged, transformers)
    kept = read(ROOT / "results" / "claims.csv")
    assert [{k: str(v) for k, v in r.items()} for r in made] == kept
    text = claims_page.DOCS.read_text()
    assert claims_page.filled(text, rounds, judged, transformers, made) == text
    assert "<!-- claims -->" in text and "<!-- rounds -->" in text
