"""What is handed over predicts better: every finding is kept only if the written files, in stock
MuJoCo, need it.

handed = accepted(world, check, setting)            # Handed; check: a Check on kept-back recordings
handed.files.xml, handed.setting
"""

import tempfile
from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from diagnosis.estimation import prediction_error, stock, windowing
from diagnosis.simulation.corrected_py import ScriptError, corrected_py, predictions, python_parts

SCATTER = 2.0  # standard deviations that are taken for chance


@dataclass(frozen=True)
class Files:
    """What of a setting is written: corrected.xml, corrected.py ("" where MJCF holds all), and
    forms {Candidate: where}."""

    xml: str
    python: str
    forms: dict

    @classmethod
    def of(cls, world, setting):
        """The Files of a setting."""
        xml, forms = world.corrected_xml(setting)
        parts = python_parts(world.model, setting, forms)
        joints = [windowing.joint_name(world.model, j) for j in range(world.model.njnt)]
        return cls(xml, corrected_py(parts, joints) if parts else "", forms)

    def predicted(self, nominal, windows):
        """qpos (W, T, nq) of windows, by stock MuJoCo and the script; NaN where there is none."""
        if not self.python:
            return stock.predicted(stock.compiled(self.xml), nominal, windows)
        out, filled = np.full(windowing.measured(windows).shape, np.nan), {}
        for r in windowing.recordings_of(windows):  # where a window begins in a hole
            qpos, qvel = windowing.states(nominal, r)
            filled[r] = replace(r, qpos=qpos, qvel=qvel)
        windows = [w._replace(recording=filled[w.recording]) for w in windows]
        with tempfile.TemporaryDirectory() as folder:
            Path(folder, "corrected.xml").write_text(self.xml, encoding="utf-8")
            script = Path(folder, "corrected.py")
            script.write_text(self.python, encoding="utf-8")
            for row, qpos in zip(out, predictions(script, windows, nominal)):
                row[: len(qpos)] = qpos
        return out


@dataclass(frozen=True)
class Handed:
    """setting: what was kept; files: its Files; nominal: those of the nominal model; without
    {Candidate: error of the files without it}; gone: [Candidate] that was not kept."""

    setting: dict
    files: Files
    nominal: Files
    without: dict
    gone: list


class Check:
    """Windows of recordings, as the contract's error has them, with a smoothed trajectory for its
    floor."""

    def __init__(self, world, recordings, smoother, noise):
        """noise (nv,): of positions, as it is reported, whatever these recordings alone show."""
        self.world, self.recordings, self.smoother = world, recordings, smoother
        self.windows = prediction_error.consecutive(recordings, windowing.HORIZON)
        self.noise, self.told = prediction_error.reporting_noise(noise), np.isfinite(noise)
        self.trajectory, self.scatter, self.path = None, 0.0, None

    def locate(self, setting):
        """Smooth the recordings under a setting, for the floor."""
        self.trajectory = self.smoother.locate(setting, passes=2)

    def errors(self, files):
        """(error of Files over all channels in noises, {channel: SI})."""
        model = self.world.model
        predicted = files.predicted(model, self.windows)
        return windowing.error(model, self.windows, predicted, self.noise)

    def smoothed(self, setting, near=False):
        """The windows, begun at the motion that is located under a setting: noise of start states
        as recorded moves a prediction by more than many an effect does, and so do those that
        another setting located. near: to the setting that was asked for last (see Smoother)."""
        passes = 2 if self.path else 3
        self.path = copy(self.smoother).locate(setting, self.path, passes, near)
        path, begun = self.path, {}
        for r in self.recordings:
            rows = path.rows(r)
            begun[r] = replace(r, qpos=path.qpos[rows], qvel=path.qvel[rows])
        return [w._replace(recording=begun[w.recording]) for w in self.windows]

    def scattered(self):
        """Squared error, in noises, by which noise alone makes one prediction better than another:
        SCATTER standard deviations of the mean square of what is measured, as far as its noise is
        told."""
        known = windowing.known(self.world.model, self.windows)[:, 1:]
        return SCATTER * np.sqrt(2 * known[..., self.told].sum()) / max(known.sum(), 1)

    def squares(self, files, setting, near=False):
        """Parts of the squared error of the Files of a setting (2, W), by window: from start states
        as recorded, and as they are smoothed under it; infinite where they do not run."""
        begun = self.windows, self.smoothed(setting, near)
        return np.array([self._parts(files, windows) for windows in begun])

    def worse(self, setting, other):
        """By how much a setting's files predict worse than another one's, at least."""
        mine, others = (self.squares(Files.of(self.world, s), s) for s in (setting, other))
        return _worse(mine, others)

    def _parts(self, files, windows):
        """Parts of the squared error (W,) of windows begun otherwise."""
        model = self.world.model
        try:
            predicted = files.predicted(model, windows)
        except (ScriptError, ValueError, mujoco.FatalError):
            return np.full(len(windows), np.inf)
        return windowing.squares(*windowing.gaps(model, self.windows, predicted), self.noise)

    def error(self, files):
        """As errors(), of all channels; infinite where they do not run."""
        return float(np.sqrt(self._parts(files, self.windows).sum()))


def accepted(world, check, setting, refit=lambda some, out: some, log=lambda what: None, told=None):
    """The Handed of what of a setting kept-back recordings do not speak against: neither all of it
    nor any finding makes a prediction worse by more than noise does, from start states as recorded
    and as smoothed too. The window that speaks most against a finding is not counted: one that goes
    another way decides nothing. Where these recordings do not show a finding, those that it was
    found on have decided. refit(setting, out): what is left without one, fitted again; told: the
    Check of the errors that are told."""
    nominal = Files.of(world, {})
    before = check.squares(nominal, {}) if setting else None
    nothing, gone = check.scattered(), []
    while setting:
        files = Files.of(world, setting)
        after = check.squares(files, setting)
        rest = {o: {c: v for c, v in setting.items() if c is not o} for o in setting}
        less = {out: Files.of(world, others) for out, others in rest.items()}
        worse = {
            c: _worse(after, check.squares(less[c], rest[c], near=True), uncounted=1)
            for c in setting
            if files.forms[c] in ("mjcf", "python")
        }
        worst = max(worse, key=worse.get, default=None)
        if worst is None or max(worse[worst], _worse(after, before)) < nothing:
            errors = {out: (told or check).error(without) for out, without in less.items()}
            return Handed(setting, files, nominal, errors, gone)
        log(f"  not handed over: {worst}: worse by {worse[worst]:.4g}, noise {nothing:.4g}")
        gone.append(worst)
        setting = refit(rest[worst], worst)
    return Handed(setting, nominal, nominal, {}, gone)


def _worse(squares, others, uncounted=0):
    """By how much squared errors (kinds, W) are larger than others, at least, but for so many
    windows in which they are larger by most; infinity is worse."""
    both = np.isinf(squares) & np.isinf(others)
    more = np.sort(np.where(both, 0.0, squares - np.where(both, 0.0, others)), axis=1)
    more[more[:, -1] == np.inf] = np.inf  # other windows make up for none that does not run
    return float(more[:, : max(more.shape[1] - uncounted, 1)].sum(1).min())
