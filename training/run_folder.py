"""A run on disk: settings, tables, checkpoints, figure and animation; everything is written whole
or not at all.

And what is seen of it meanwhile: the progress bar.
"""

import ast
import csv
import hashlib
import io
import json
import os
import platform
import time
import zipfile
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import torch
from matplotlib.figure import Figure
from tqdm import tqdm

from diagnosis.common.atomic_files import write_table, write_whole
from envs import model_path
from models import GaussianPolicy, load_checkpoint
from training.replay import animate as animate  # for train.py

PROGRESS = (
    "grounding_step real_transitions real_transitions_judging sim_steps "
    "real_return_deterministic real_return_deterministic_se real_return_stochastic "
    "forward_model_error at_one_step_error identity_one_step_error "
    "delta_action_rms at_std kl rolled_back_to seconds"
).split()
ALWAYS = [  # numbers in every row
    *(k for k in PROGRESS if k.startswith("real_")),
    *("grounding_step", "sim_steps", "seconds"),
]
TRAIN = (
    "grounding_step phase steps return reward kl surrogate_gain step_size line_search entropy "
    "explained_variance std"
).split()
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef)


class RunError(ValueError):
    """A run folder that cannot be used as asked; the message says what to do instead."""


def save_whole(path, tensors):
    """torch.save in the manner of files.write_whole."""
    data = io.BytesIO()
    torch.save(tensors, data)
    write_whole(path, data.getvalue())


def versions(settings=None):
    """What the numbers of a run depend on besides its settings (a dict; None: no run's).

    That is the diagnosis' code too where it grounds, and of a user's task its file and its model.
    """
    settings = settings or {}
    root, used = Path(__file__).parents[1], {}
    if settings.get("algo", "").startswith("physics"):
        paths = sorted((root / "diagnosis").rglob("*.py"))
        used["diagnosis"] = code_version(*(p.relative_to(root).with_suffix("") for p in paths))
    if settings.get("task"):
        files = Path(settings["task"]), model_path(settings["env"])
        texts = b"\n".join(path.read_bytes() for path in files)
        used["task"] = hashlib.sha256(texts).hexdigest()[:16]
    packages = {package.__name__: package.__version__ for package in (mujoco, gymnasium, torch, np)}
    machine = f"{platform.machine()}, {os.cpu_count()} cores"
    return {
        "python": platform.python_version(),
        **packages,
        "machine": machine,
        "learner": code_version("envs", "models", "trpo"),
        "grounding": code_version("rgat", "train", "training/physics_grounding"),
        **used,
    }


def code_version(*modules):
    """A hash of what modules compute: layout, comments and docstrings are no other version."""
    root = Path(__file__).parents[1]
    return hashlib.sha256(
        "\n".join(statements((root / f"{name}.py").read_text()) for name in modules).encode()
    ).hexdigest()[:16]


def statements(text):
    """Source text without comments and docstrings, in the one layout that ast gives it."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node) is not None:
            node.body = node.body[1:] or [ast.Pass()]
    return ast.unparse(tree)


class Run:
    """The folder of one run.

    config.json (settings and versions), progress.csv (a row per grounding step), train.csv (a row
    per TRPO update), step_NN.pt (checkpoints), real_NN.npz (the real transitions collected in step
    NN), policy.pt (the best policy so far on real), best.json (that policy judged once more),
    lines.json (reference returns), progress.png, replay.gif if asked for, and ENV-sim-KEY.pt or
    ENV-real-KEY.pt, policies trained from scratch, where no other folder keeps them.
    """

    def __init__(self, folder):
        self.folder = Path(folder)
        self.progress, self.train = [], []
        self.lines = {}

    @classmethod
    def create(cls, folder, settings):
        """A new folder for a run with these settings (a dict).

        Raises RunError if it holds a run or cannot be made."""
        run = cls(folder)
        try:
            if (run.folder / "config.json").exists():
                raise RunError(
                    f"{folder} already holds a run: continue it with --resume {folder}, or choose "
                    "another --out"
                )
            run.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RunError(
                f"cannot make the folder {folder}: {error.strerror}; choose another --out"
            ) from None
        run.versions = versions(settings)
        run.write_config(settings)
        return run

    def write_config(self, settings):
        """config.json: the settings (a dict), and the versions that the run began with."""
        config = {"settings": settings, "versions": self.versions}
        write_whole(self.folder / "config.json", json.dumps(config, indent=1))

    def require_this_version(self, settings=None):
        """Raises RunError if the run of these settings (a dict) was begun with other code or
        packages: its numbers would be of two kinds."""
        for name, now in versions(settings).items():
            then = self.versions.get(name)
            if name not in ("machine", "python") and then != now:
                raise RunError(
                    f"{self.folder} was begun by another version ({name} {then}, this is {now}): "
                    "go on with that version, or start a new run"
                )

    @classmethod
    def open(cls, folder):
        """An existing run, cut back to its last whole grounding step.

        Returns it and its settings."""
        run = cls(folder)
        try:
            config = json.loads((run.folder / "config.json").read_text())
            settings, run.versions = config["settings"], dict(config["versions"])
            run.progress = run._read("progress.csv")
            for row in run.progress:
                [float(row[k] or "nan") for k in ALWAYS]
            done = len(run.progress)
            run.train = [
                row for row in run._read("train.csv") if int(row["grounding_step"]) < max(done, 1)
            ]
            if (run.folder / "lines.json").exists():
                lines = json.loads((run.folder / "lines.json").read_text())
                run.lines = {"trained on real": float(lines["trained on real"])}
        except FileNotFoundError:
            raise RunError(
                f"{folder} holds no run (no config.json): name the --out folder of an earlier run"
            ) from None
        except (ValueError, KeyError, TypeError, OSError):
            raise RunError(
                f"{folder}: its config.json or tables are damaged: start a new run"
            ) from None
        return run, settings

    def _read(self, name):
        path = self.folder / name
        return list(csv.DictReader(path.open(newline=""))) if path.exists() else []

    def log_update(self, grounding_step, phase, stats):
        """Keep a row of train.csv; flush() writes it."""
        self.train.append({"grounding_step": grounding_step, "phase": phase, **stats})

    def flush(self):
        """Bring train.csv and the figure up to date."""
        write_table(self.folder / "train.csv", TRAIN, self.train)
        self.plot()

    def record(self, row, checkpoint, real=None):
        """Finish a grounding step: its data and checkpoint first, its progress row last, so that a
        row means a whole step."""
        step = row["grounding_step"]
        if real is not None:
            data = io.BytesIO()
            np.savez(data, s=real.s, a=real.a, s_next=real.s_next)
            write_whole(self.folder / f"real_{step:02d}.npz", data.getvalue())
        save_whole(self.folder / f"step_{step:02d}.pt", checkpoint)
        self.progress.append({k: row.get(k, "") for k in PROGRESS})
        if self.best() == step:
            save_whole(self.folder / "policy.pt", checkpoint["acting"])
        write_table(self.folder / "train.csv", TRAIN, self.train)
        write_table(self.folder / "progress.csv", PROGRESS, self.progress)
        self.plot()

    def returns(self):
        """The deterministic return on real after every grounding step; nan: not judged."""
        return [float(row["real_return_deterministic"] or "nan") for row in self.progress]

    def best(self):
        """The grounding step whose policy returned most, the last one where none was judged."""
        returns = self.returns()
        return len(returns) - 1 if np.isnan(returns).all() else int(np.nanargmax(returns))

    def checkpoint(self, step):
        """What record() saved for a step. Raises RunError if it is missing or damaged."""
        try:
            return load_checkpoint(self.folder / f"step_{step:02d}.pt")
        except ValueError as error:
            raise RunError(f"{error}; start a new run") from None

    def policy(self):
        """The best policy so far. Raises RunError if there is none yet, or its
        file is missing or damaged."""
        if not self.progress:
            raise RunError(f"{self.folder} has no policy yet: go on with --resume {self.folder}")
        try:
            return GaussianPolicy.load(self.folder / "policy.pt")
        except ValueError as error:
            raise RunError(f"{self.folder}: {error}; start a new run") from None

    def real(self, step):
        """The arrays s, a, s_next collected in a step.

        Raises RunError if they are missing or damaged."""
        path = self.folder / f"real_{step:02d}.npz"
        try:
            with np.load(path, allow_pickle=False) as data:
                return data["s"], data["a"], data["s_next"]
        except (ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile) as error:
            raise RunError(
                f"{path} is missing or damaged ({type(error).__name__}): start a new run"
            ) from None

    def set_lines(self, **lines):
        """Remember the reference returns drawn as horizontal lines."""
        self.lines.update(lines)
        write_whole(self.folder / "lines.json", json.dumps(self.lines, indent=1))

    def plot(self):
        """progress.png: return on real against grounding step, and the
        training returns behind it."""
        figure = Figure(figsize=(10, 4), layout="constrained")
        left, right = figure.subplots(1, 2)
        steps = [int(r["grounding_step"]) for r in self.progress]
        number = lambda name: np.array([float(r[name] or "nan") for r in self.progress])
        mean = number("real_return_deterministic")
        se = number("real_return_deterministic_se")
        if steps:
            left.errorbar(
                steps,
                mean,
                se,
                color="#1f5fa8",
                marker="o",
                capsize=3,
                label="on real, deterministic",
            )
            stochastic = number("real_return_stochastic")
            left.plot(steps, stochastic, color="#1f5fa8", ls=":", label="on real, stochastic")
        for name, value in self.lines.items():
            left.axhline(value, color="#2e8b57", lw=1.2, label=name)
        if steps and np.isfinite(mean[0]):
            left.axhline(mean[0], color="#c0392b", lw=1.2, label="before grounding")
        left.set(xlabel="grounding step", ylabel="return on real")
        left.xaxis.get_major_locator().set_params(integer=True)
        if left.get_legend_handles_labels()[0]:
            left.legend(fontsize=8)
        rows = [
            r
            for r in self.train
            if r["phase"] != "transformer" and str(r["return"]) not in ("", "nan")
        ]
        offset, last, x = 0, 0, []
        for row in rows:  # steps restart with every phase
            offset += last if int(row["steps"]) < last else 0
            last = int(row["steps"])
            x.append(offset + last)
        right.plot(x, [float(r["return"]) for r in rows], color="#666666", lw=1)
        right.set(xlabel="steps of policy improvement", ylabel="return in training (stochastic)")
        image = io.BytesIO()
        figure.savefig(image, format="png", dpi=110)
        write_whole(self.folder / "progress.png", image.getvalue())


def tensorboard(folder):
    """A writer of TensorBoard's event files; only where TensorBoard is installed."""
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(folder))


class Bar:
    """Progress on a terminal, train.csv and the figure along the way, and the
    steps and seconds of each grounding step."""

    def __init__(self, s, run, board=None):
        self.board = board
        self.run, self.seen, self.drawn, self.clock = run, 0, time.monotonic(), time.monotonic()
        self.world = "real" if s.algo == "real" else "sim"
        at_steps = s.at_steps * s.algo.endswith("rgat")
        total = (
            s.pretrain_steps
            + s.reference_steps * (s.algo != "real" or bool(s.policy_from))
            + s.grounding_steps * (s.policy_steps + at_steps)
        )
        self.tqdm = tqdm(
            total=total,
            unit="step",
            unit_scale=True,
            disable=None,
            dynamic_ncols=True,
            smoothing=0.05,
        )

    def phase(self, step, name):
        """An on_update callback for one phase of one grounding step."""
        before = 0

        def on_update(stats):
            nonlocal before
            new, before = stats["steps"] - before, stats["steps"]
            self.seen += new * (name != "reference")
            self.tqdm.update(new)
            self.tqdm.set_description(f"step {step}, {name}, return {stats['return']:.0f}")
            self.run.log_update(step, name, stats)
            self.scalars(f"{step:02d} {name}", stats, stats["steps"])
            if time.monotonic() - self.drawn > 20:
                self.run.flush()
                self.drawn = time.monotonic()

        return on_update

    def scalars(self, group, numbers, x):
        """Numbers at x for TensorBoard, where it was asked for."""
        for key, value in numbers.items() if self.board else ():
            if isinstance(value, (int, float)):
                self.board.add_scalar(f"{group}/{key}", value, x)

    def skip(self, steps, counts=True):
        """Steps that an earlier run has done; counts: they are this run's
        own, not a reference line's."""
        self.seen += steps * counts
        for count in (
            ("initial", "n", "last_print_n") if not self.tqdm.disable else ()
        ):  # they tell nothing about the speed
            setattr(self.tqdm, count, getattr(self.tqdm, count) + steps)

    def lap(self):
        """(environment steps, seconds) since the last lap."""
        steps, seconds = self.seen, time.monotonic() - self.clock
        self.seen, self.clock = 0, time.monotonic()
        return steps, seconds

    def say(self, line):
        self.tqdm.write(line)
