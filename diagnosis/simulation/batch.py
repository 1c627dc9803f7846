"""Runs S windows at once on one working model: what World.simulate is made of.

Effects change copies of the model, or the control signal before the run, so that
a whole window is one call of mujoco.batch.Batch; only forces that depend on the
state and effects under a condition are worked out step by step.
"""

import os

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from diagnosis.common.broyden import nearest
from diagnosis.simulation.editable_model import BALL, FREE, Working
from diagnosis.simulation.readout import locate, read
from diagnosis.simulation.run_up import run_up
from diagnosis.simulation.stepwise import Stepwise

STATE = mujoco.mjtState.mjSTATE_INTEGRATION
SHOTS = 8  # corrections of a start that delayed sensors show late
SMALL = 1e-5  # rad, m, rad/s or m/s by which such a start is moved, to tell what that shows


class Engine:
    """Simulator for settings with the same structure, a frozenset of the candidates that need parts
    of their own."""

    def __init__(self, spec, nominal, structure):
        self.working, self.nominal = Working(spec, nominal, structure), nominal
        self.model, self.q, self.v = self.working.model, self.working.q, self.working.v
        self.rest = np.empty(mujoco.mj_stateSize(self.model, STATE))
        mujoco.mj_getState(self.model, self.working.data, self.rest, STATE)
        m = self.model  # activations that the nominal model lacks, of bristles
        owner = np.repeat(
            np.arange(m.nactuator), np.where(m.actuator_actadr < 0, 0, m.actuator_actnum)
        )
        self.hidden = owner >= nominal.nactuator
        self.batch = None

    def run(self, cases, start_qpos, start_qvel, windows, rows, step, count, sensors):
        """World.simulate for n simulations that share structure, time step and way of stepping.

        Returns qpos (n, rows, nq), qvel (n, rows, nv) and, if `sensors`, sensordata (n, rows,
        nsensordata).
        """
        measures, sensor_measures = self._measures(cases)
        late = measures[2].max(axis=1, initial=0.0)
        if sensors:
            late = np.maximum(late, sensor_measures[2].max(axis=1, initial=0.0))
        # a window begins as long before its first row as its latest sensor is late, but not before
        # the recording
        early = np.array([w.recording.time[w.first] - w.recording.time[0] for w in windows])
        early = np.minimum(late, early)
        begin = np.array([w.recording.time[w.first] for w in windows]) - early
        shown = start_qpos, start_qvel
        qpos, qvel, act = self._starts(cases, windows, begin, shown, measures, step)
        recordings = [w.recording for w in windows]
        if early.any():
            lead = int(np.ceil(early.max() / step)) + 1
            states = qpos, qvel, act
            self._shoot(cases, recordings, begin, states, shown, early, measures, step, lead)
            count += lead
        q, v, data, _ = self.trajectory(
            cases, recordings, begin, qpos, qvel, step, count, sensors, act
        )
        time = np.full((len(cases), rows), np.nan)
        for s, w in enumerate(windows):
            time[s, : w.last - w.first + 1] = w.recording.time[w.first : w.last + 1] - begin[s]
        qpos, qvel = self._read(q, v, time, step, measures)
        qpos[:, 0], qvel[:, 0] = shown
        if not sensors:
            return qpos, qvel
        return qpos, qvel, _read_sensors(data, time, step, sensor_measures)

    def _starts(self, cases, windows, begin, shown, measures, step):
        """States (n, ·) of the working model at `begin`, and its activations or None, from what is
        shown."""
        n, act = len(cases), None
        qpos, qvel = np.tile(self.model.qpos0, (n, 1)), np.zeros((n, self.model.nv))
        if self.model.nq > self.nominal.nq or self.hidden.any():
            followed = [case.followed for case in cases]
            qpos, qvel, act = run_up(self, followed, windows, begin, measures, step)
        qpos[:, self.q], qvel[:, self.v] = self.true(*shown, measures)
        return qpos, qvel, act

    def _shoot(self, cases, recordings, begin, states, shown, early, measures, step, lead):
        """Correct states (qpos, qvel, act) in place until delayed sensors show what they should
        `early` seconds later, within `lead` steps: begun as if nothing pushed until then."""
        qpos, qvel, act = states
        target, nq = np.concatenate(self.true(*shown, measures), 1), len(self.q)
        ahead = early[:, None] - measures[2]  # from the first state to what is shown of each joint

        def missed(x, times=1):  # by so many states of each simulation, (times n, ·)
            tiled = lambda array: np.tile(array, (times, *[1] * (array.ndim - 1)))
            full, more = (tiled(qpos), tiled(qvel)), act if act is None else tiled(act)
            full[0][:, self.q], full[1][:, self.v] = x[:, :nq], x[:, nq:]
            given = cases * times, recordings * times, tiled(begin)
            q, v, *_ = self.trajectory(*given, *full, step, lead, act=more)
            late, delay = tiled(early)[:, None], tiled(measures[2])
            seen = read(self.nominal, q[..., self.q], v[..., self.v], late, step, delay)
            return tiled(target) - np.concatenate([part[:, 0] for part in seen], 1)

        position, speed = simple(self.nominal)
        first, some = target.copy(), np.concatenate([position, nq + speed])
        first[:, position] -= ahead * target[:, nq + speed]
        slope = np.tile(np.eye(target.shape[1]), (len(target), 1, 1))
        moved = first + SMALL * np.eye(target.shape[1])[some][:, None]
        off, others = missed(first), missed(moved.reshape(-1, first.shape[1]), len(some))
        change = off - others.reshape(moved.shape)
        slope[:, :, some] = np.nan_to_num(np.moveaxis(change, 0, -1) / SMALL)
        size = np.where(np.arange(target.shape[1]) < nq, 1.0, early[:, None])
        best = nearest(missed, first, off, slope, size, SHOTS)
        qpos[:, self.q], qvel[:, self.v] = best[:, :nq], best[:, nq:]

    def _read(self, q, v, time, step, measures):
        """qpos (n, rows, nq), qvel (n, rows, nv) as the joints' sensors show a trajectory at times
        (n, rows)."""
        offset, ratio, delay = measures
        qpos, qvel = read(self.nominal, q[..., self.q], v[..., self.v], time, step, delay)
        simple_q, simple_v = simple(self.nominal)
        qpos[..., simple_q] = qpos[..., simple_q] * ratio[:, None] + offset[:, None]
        qvel[..., simple_v] *= ratio[:, None]
        return qpos, qvel

    def true(self, qpos, qvel, measures):
        """Positions and velocities behind what sensors show, but for their delays."""
        (simple_q, simple_v), (offset, ratio, _) = simple(self.nominal), measures
        qpos, qvel = qpos.copy(), qvel.copy()
        qpos[:, simple_q], qvel[:, simple_v] = (
            (qpos[:, simple_q] - offset) / ratio,
            qvel[:, simple_v] / ratio,
        )
        return qpos, qvel

    def trajectory(
        self, cases, recordings, begin, qpos, qvel, step, count, sensors=False, act=None
    ):
        """Every step from states qpos (n, nq), qvel (n, nv) of the working model at times `begin`
        (n,).

        act (n, na): activations, of which those count that the nominal model lacks; zero if not
        given. Returns q (n, 1 + count, nq), v (n, 1 + count, nv), sensordata (n, 1 + count, ·) or
        None, act (n, 1 + count, na); NaN from the step on at which a simulation failed.
        """
        n, memo, drive = len(cases), {}, self.working.drive
        on = [drive(c.on, r, t, step, count, memo) for c, r, t in zip(cases, recordings, begin)]
        off = [
            drive(c.off, r, t, step, count, memo) if c.when else d
            for c, r, t, d in zip(cases, recordings, begin, on)
        ]
        batch = self._batch(n, cases[0].stepwise)
        batch.warning[:] = 0
        batch.state[:n] = self.rest
        batch.bind("qpos")[:n], batch.bind("qvel")[:n] = qpos, qvel
        if self.model.na:
            driven = self._activations(recordings, begin, on)
            act = np.where(self.hidden, 0.0 if act is None else act, driven)
            batch.bind("act")[:n] = act
        # sensordata belongs to the state before a step, so sensors need one step more
        record = ["qpos", "qvel"] + ["sensordata"] * sensors + ["act"] * bool(self.hidden.any())
        out = {
            f: np.full((n, count + sensors, getattr(self.working.data, f).size), np.nan)
            for f in record
        }
        if cases[0].stepwise:
            failed = Stepwise(batch, cases, recordings, (on, off), begin, step).run(out)
        else:
            failed = self._rollout(batch, on, out)
        failed[[a.model is None or b.model is None for a, b in zip(on, off)]] = 0
        lost = np.arange(count + sensors) >= failed[:, None]
        q = np.concatenate([qpos[:, None], out["qpos"][:, :count]], axis=1)
        v = np.concatenate([qvel[:, None], out["qvel"][:, :count]], axis=1)
        q[:, 1:][lost[:, :count]] = v[:, 1:][lost[:, :count]] = np.nan
        if sensors:
            out["sensordata"][lost] = np.nan
        if "act" in out:
            act = np.concatenate([act[:, None], out["act"][:, :count]], axis=1)
            act[:, 1:][lost[:, :count]] = np.nan
        else:
            act = np.zeros((n, 1 + count, self.model.na))
        return q, v, out.get("sensordata"), act

    def _activations(self, recordings, begin, drives):
        """Activations (n, na) of the working model at times begin (n,)."""
        out, alike = np.empty((len(begin), self.model.na)), {}
        for s, (recording, drive) in enumerate(zip(recordings, drives)):
            alike.setdefault((recording, drive.changed), []).append(s)
        for (recording, changed), some in alike.items():
            out[some] = self.working.activation(recording, begin[some], changed)
        return out

    def _batch(self, n, stepwise):
        """A Batch of n simulations, or more of those that run in one call, which is kept."""
        if stepwise:  # its fields are expanded, each time others
            return Batch(self.model, n, threads())
        if self.batch is None or self.batch.nsim < n:
            self.batch = Batch(self.model, 1 << (n - 1).bit_length(), threads())
        return self.batch

    def _rollout(self, batch, drives, out):
        """Run all steps in one call; fill out, return the steps (n,) at which simulations failed,
        `count` of those that did not."""
        n = len(drives)
        batch.set_models([d.model or self.model for d in drives] + [self.model] * (batch.nsim - n))
        batch.bind("qfrc_applied")[:n] = [d.qfrc for d in drives]
        batch.bind("xfrc_applied")[:n] = [d.xfrc for d in drives]
        ctrl, count = np.array([d.ctrl for d in drives]), out["qpos"].shape[1]
        ctrl = np.pad(ctrl, ((0, 0), (0, count - ctrl.shape[1]), (0, 0)), mode="edge")
        failed = np.full(n, count)
        try:
            batch.rollout(
                count,
                ctrl if self.nominal.nu else None,
                record=tuple(out),
                ids=np.arange(n),
                out=out,
            )
        except SimulationError as error:
            failed[error.ids] = 0
        for s in np.flatnonzero(batch.warning[:n, :, 1].any(axis=1)):  # it repeats its last record
            bits = np.concatenate([x[s].view(np.int64) for x in out.values()], axis=1)
            moved = np.flatnonzero((bits != bits[-1]).any(axis=1))
            failed[s] = min(failed[s], 1 + moved.max(initial=-1))
        return failed

    def _measures(self, cases):
        """(offset, ratio, delay) (3, n, ·) of the hinges and slides, and of sensordata."""
        m = self.nominal
        simple_q, _ = simple(m)
        measures = [np.zeros((3, len(cases), width)) for width in (len(simple_q), m.nsensordata)]
        for measure in measures:
            measure[1] = 1.0
        for s, case in enumerate(cases):
            for candidate, values in case.on:
                if candidate.effect.overrides("measure"):
                    offset, ratio, delay = candidate.effect.measure(values)
                    if candidate.place.kind == "sensor":
                        i = m.sensor(candidate.place.name).id
                        part = measures[1][
                            :, s, m.sensor_adr[i] : m.sensor_adr[i] + m.sensor_dim[i]
                        ]
                    else:
                        column = list(simple_q).index(m.joint(candidate.place.name).qposadr[0])
                        part = measures[0][:, s, column]
                    part[0], part[1], part[2] = part[0] + offset, part[1] * ratio, part[2] + delay
        return measures


def threads():
    """Threads to run on: OMP_NUM_THREADS, where that is set as for other numerical libraries, else
    all CPUs (0)."""
    number = os.environ.get("OMP_NUM_THREADS", "")
    return int(number) if number.isdigit() else 0


def _read_sensors(data, time, step, measures):
    """(n, rows, nsensordata) that sensors show at times (n, rows) of data (n, steps, ·), at the
    state before each step."""
    offset, ratio, delay = measures
    x = np.maximum(time[..., None] - delay[:, None], 0.0) / step
    s, k, after, f = locate(x, data.shape[1])
    column = np.arange(delay.shape[1])
    values = (1 - f) * data[s, k, column] + f * data[s, after, column]
    shown = values * ratio[:, None] + offset[:, None]
    return np.where(np.isnan(time)[..., None], np.nan, shown)


def simple(model):
    """Addresses in qpos and in qvel of the hinges and slides."""
    joints = ~np.isin(model.jnt_type, (FREE, BALL))
    return model.jnt_qposadr[joints], model.jnt_dofadr[joints]
