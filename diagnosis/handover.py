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

from diagnosis.estimation import windowing
from diagnosis.estimation.readings import undone
from diagnosis.simulation.corrected_py import ScriptError, corrected_py, predictions, python_parts
from diagnosis.simulation.corrected_template import blown_up, divided
from diagnosis.simulation.editable_model import FILTERS

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
            return in_stock_mujoco(compiled(self.xml), nominal, windows)
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
        self.windows = windowing.cut(recordings, windowing.HORIZON)
        self.noise, self.told = windowing.reporting_noise(noise), np.isfinite(noise)
        self.trajectory, self.scatter, self.path = None, 0.0, None

    def locate(self, setting):
        """Smooth the recordings under a setting, for the floor."""
        self.trajectory = self.smoother.locate(setting, passes=2)

    def errors(self, files):
        """(error of Files over all channels in noises, {channel: SI})."""
        model = self.world.model
        predicted = files.predicted(model, self.windows)
        return windowing.error(model, self.windows, predicted, self.noise)

    def smoothed(self, setting):
        """The windows, begun at the motion that is located under a setting: noise of start states
        as recorded moves a prediction by more than many an effect does, and so do those that
        another setting located."""
        self.path = copy(self.smoother).locate(setting, self.path)
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

    def squares(self, files, setting):
        """Parts of the squared error of the Files of a setting (2, W), by window: from start states
        as recorded, and as they are smoothed under it; infinite where they do not run. What the
        files do not hold of sensors that are off is undone in both, and in what is measured."""
        off = {c: v for c, v in setting.items() if files.forms[c] == "measurement"}
        both = [self._undone(windows, off) for windows in (self.windows, self.smoothed(setting))]
        return np.array([self._parts(files, windows, both[0]) for windows in both])

    def _undone(self, windows, off):
        """Windows of recordings as they would be without what is off."""
        model, recordings = self.world.model, windowing.recordings_of(windows)
        turned = {r: undone(model, off, r) for r in recordings}
        return [w._replace(recording=turned[w.recording]) for w in windows]

    def worse(self, setting, other, uncounted=0):
        """By how much a setting's files predict worse than another one's, at least, but for so many
        windows in which they are worse by most."""
        mine, others = (self.squares(Files.of(self.world, s), s) for s in (setting, other))
        return _worse(mine, others, uncounted)

    def _parts(self, files, windows, measured):
        """Parts of the squared error (W,) of windows begun otherwise than they were measured."""
        model = self.world.model
        try:
            predicted = files.predicted(model, windows)
        except (ScriptError, ValueError, mujoco.FatalError):
            return np.full(len(windows), np.inf)
        return windowing.squares(*windowing.gaps(model, measured, predicted), self.noise)

    def error(self, files):
        """As errors(), of all channels; infinite where they do not run."""
        return float(np.sqrt(self._parts(files, self.windows, self.windows).sum()))


def accepted(
    world,
    check,
    setting,
    refit=lambda some, out: some,
    log=lambda what: None,
    told=None,
    doubtful=lambda setting: None,
):
    """The Handed of what of a setting kept-back recordings do not speak against: neither all of it
    nor any finding makes a prediction worse by more than noise does, from start states as recorded
    and as smoothed too. The window that speaks most against a finding is not counted: one that goes
    another way decides nothing. Where these recordings do not show a finding, those that it was
    found on have decided. refit(setting, out): what is left without one, fitted again; told: the
    Check of the errors that are told; doubtful(setting): the finding that may be nothing, if there
    is one: that goes, too."""
    nominal = Files.of(world, {})
    before = check.squares(nominal, {}) if setting else None
    nothing, gone = check.scattered(), []
    while setting:
        files = Files.of(world, setting)
        after = check.squares(files, setting)
        rest = {o: {c: v for c, v in setting.items() if c is not o} for o in setting}
        less = {out: Files.of(world, others) for out, others in rest.items()}
        worse = {
            c: _worse(after, check.squares(less[c], rest[c]), uncounted=1)
            for c in setting
            if files.forms[c] in ("mjcf", "python")
        }
        worst = max(worse, key=worse.get, default=None)
        harmless = worst is None or max(worse[worst], _worse(after, before)) < nothing
        out = doubtful(setting) if harmless else worst
        if out is None:
            errors = {c: (told or check).error(without) for c, without in less.items()}
            return Handed(setting, files, nominal, errors, gone)
        harm = f"worse by {worse.get(out, 0.0):.4g}, noise {nothing:.4g}"
        log(f"  not handed over: {out}: {'it may be nothing' if harmless else harm}")
        gone.append(out)
        setting = refit(rest[out], out)
    return Handed(setting, nominal, nominal, {}, gone)


def _worse(squares, others, uncounted=0):
    """By how much squared errors (kinds, W) are larger than others, at least, but for so many
    windows in which they are larger by most; infinity is worse."""
    both = np.isinf(squares) & np.isinf(others)
    more = np.sort(np.where(both, 0.0, squares - np.where(both, 0.0, others)), axis=1)
    more[more[:, -1] == np.inf] = np.inf  # other windows make up for none that does not run
    return float(more[:, : max(more.shape[1] - uncounted, 1)].sum(1).min())


def compiled(xml):
    """The MjModel of an MJCF string."""
    return mujoco.MjSpec.from_string(xml).compile()


def in_stock_mujoco(model, nominal, windows):
    """qpos (W, T, nq) of windows that follow each other, each begun as recorded; NaN where there is
    none, and in what is left of one that blew up.

    Joints and actuators go by the nominal model's names; what the model appends, its actuators'
    states and delayed controls run on through each recording.
    """
    q, v = addresses(nominal, model)
    names = [nominal.actuator(a).name for a in range(nominal.nactuator)]
    drives = np.array([model.actuator_ctrladr[model.actuator(n).id] for n in names], int)
    inputs = nominal.actuator_ctrladr[: nominal.nactuator]
    measured = windowing.measured(windows)
    out = np.full(measured.shape, np.nan)
    begun = windowing.recorded_starts(nominal, windows)
    length = model.opt.timestep
    for recording in windowing.recordings_of(windows):
        mine = {w.first: k for k, w in enumerate(windows) if w.recording is recording}
        last = max(windows[k].last for k in mine.values())
        data, now, start = mujoco.MjData(model), None, 0
        control = np.nan_to_num(recording.ctrl[:, inputs])
        _hold(model, data, drives, control[0])
        for row in range(last + 1):
            if now is not None and row <= windows[now].last:
                out[now, row - start] = data.qpos[q]
            if row in mine:
                now, start = mine[row], row
                data.qpos[q], data.qvel[v] = begun[0][now], begun[1][now]
                out[now, 0] = begun[0][now]
            if row < last:
                data.ctrl[drives] = control[row]
                gap = recording.time[row + 1] - recording.time[row]
                count, model.opt.timestep = divided(gap, length)  # as corrected.py
                mujoco.mj_step(model, data, nstep=count)
                now = None if blown_up(data) else now
    model.opt.timestep = length
    return out


def _hold(model, data, drives, control):
    """What waits and what filters begin as after its first control held for long."""
    data.ctrl[drives] = control
    for a in range(model.nactuator):
        if not model.actuator_ctrlnum[a]:
            continue
        u = model.actuator_ctrladr[a]
        value = data.ctrl[u]
        if model.actuator_ctrllimited[u]:
            value = np.clip(value, *model.actuator_ctrlrange[u])
        if model.actuator_delay[a] > 0:
            past = -model.opt.timestep * np.arange(model.actuator_history[a, 0], 0, -1)
            mujoco.mj_initCtrlHistory(model, data, a, past, np.full(len(past), value))
        if model.actuator_actadr[a] >= 0 and model.actuator_dyntype[a] in FILTERS:
            data.act[model.actuator_actadr[a]] = value


def addresses(nominal, model):
    """(qpos, dof) addresses in `model` of the nominal model's joints, by name."""
    qpos, dof = [], []
    for j, _, q, v in windowing.joint_slices(nominal):
        joint = model.joint(nominal.joint(j).name)
        qpos += range(joint.qposadr[0], joint.qposadr[0] + q.stop - q.start)
        dof += range(joint.dofadr[0], joint.dofadr[0] + v.stop - v.start)
    return np.array(qpos, int), np.array(dof, int)
