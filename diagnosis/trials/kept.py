"""A drawn trial as a folder, so that several tools meet the same recordings without drawing again.

    keep(trial, Path("devset/1_7"))
    answer, floor = read_answer(Path("devset/1_7"))

bench/ is what a tool gets; held_out.npz and answer.json are for scoring alone.
"""

import json

from diagnosis.common.atomic_files import write_whole
from diagnosis.trials.folder import write_folder
from diagnosis.trials.prediction import system_error
from diagnosis.trials.replay import save_runs

ANSWER, HELD_OUT, BENCH = "answer.json", "held_out.npz", "bench"


def keep(trial, folder):
    """Write a Trial into a folder, the answer last; returns the folder."""
    (folder / BENCH).mkdir(parents=True, exist_ok=True)
    write_folder(trial, folder / BENCH)
    save_runs(folder / HELD_OUT, trial.held_out, trial.noise)
    floor = system_error(trial.system(), trial.held_out, trial.noise)
    write_whole(folder / ANSWER, json.dumps({**trial.answer, "error_floor": floor}))
    return folder


def is_kept(folder):
    """Does a folder hold a whole trial?"""
    return (folder / ANSWER).exists()


def read_answer(folder):
    """(what a kept trial hides and its conditions, the true model's Error on the held-out runs)."""
    answer = json.loads((folder / ANSWER).read_text())
    answer.pop("noise", None)
    return answer, answer.pop("error_floor")
