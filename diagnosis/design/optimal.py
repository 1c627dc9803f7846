"""The best excitation of many, judged in simulation under every explanation that is left open.

    best = design(Open.read("report/"), seconds=10)

With rivals: T-optimality. What counts is the expected logarithm of the ratio of evidence between
the two explanations that are hardest to tell apart, after a refit of the wrong one and of start
states has taken back what it can. Without: D-optimality, the determinant of the information on the
parameters of all findings, and on those of joints that never moved.
"""

from dataclasses import dataclass
from itertools import permutations

import numpy as np

from diagnosis.design import signals
from diagnosis.design.explanations import DesignError, Open, single
from diagnosis.recordings.recording import Recording
from diagnosis.simulation.simulator import Window

WINDOW = 0.5  # s predicted at a time
DRAWN, ROUNDS, KEPT = 24, 3, 6  # excitations in a round; rounds; those of which others are made
SMALLER, TRIES = 0.7, 10  # what leaves the limits is made so much smaller, so often
FINALISTS, REFITS = 3, 8  # those refitted in full; steps of that
PROBE = 0.05  # of a parameter's value, or of its own step where that is more


@dataclass(frozen=True)
class Excitation:
    """The best excitation and what is expected of it.

    time (T,) s; ctrl (T, nu); motions (H, T, n): of hinges and slides under each explanation;
    names: theirs. nats: logarithm of the ratio of evidence between the nearest two, None where
    there is one. errors: {"effect at place: parameter": (value, standard error that the recording
    would leave, unit)}. start_qpos (nq,): where it starts, at rest.
    """

    time: np.ndarray
    ctrl: np.ndarray
    motions: np.ndarray
    names: tuple
    nats: float | None
    errors: dict
    start_qpos: np.ndarray


def design(left: Open, seconds: float = 10.0, seed: int = 0) -> Excitation:
    """The best Excitation of those tried. Raises DesignError."""
    if left.world.model.nu == 0:
        raise DesignError(
            "the model has no actuators; all that can be chosen is how it is released"
        )
    if not any(left.settings) and not left.free:
        raise DesignError(
            "the report leaves nothing open that a recording could tell: no finding that can be "
            "simulated, and no joint that never moved; diagnose recordings of other motion first"
        )
    rng, limits = np.random.default_rng(seed), left.limits
    trial, time = Trial(left), np.arange(0.0, seconds, limits.period)
    span = limits.control_low, limits.control_high
    pool = []
    for _ in range(ROUNDS):
        ideas = [signals.drawn(rng, time, *span, limits.start_ctrl) for _ in range(DRAWN)]
        if pool:
            pick = lambda: pool[rng.integers(len(pool))][1]
            ideas = [signals.changed(rng, pick(), pick(), idea, *span) for idea in ideas]
        pool = sorted([*pool, *trial.judged(time, ideas)], key=lambda item: -item[0])[:KEPT]
    if not pool:
        raise DesignError(
            "every excitation left the joints' ranges or the speeds that were recorded; an arm "
            "that falls when its torques are a little wrong needs position targets: give --kp and "
            "--kd"
        )
    if len(left.settings) == 1:
        return trial.described(time, pool[0][1])
    rated = [(trial.told_apart(time, ctrl), ctrl) for _, ctrl in pool[:FINALISTS]]
    nats, ctrl = max(rated, key=lambda item: item[0])
    return trial.described(time, ctrl, nats)


class Trial:
    """Simulates excitations under what a report left open."""

    def __init__(self, left: Open):
        self.left, self.world, self.start = left, left.world, left.limits.start_qpos
        self.model = model = left.world.model
        self.columns = [model.jnt_qposadr[model.joint(j).id] for j in single(model)]
        self.speeds = [model.jnt_dofadr[model.joint(j).id] for j in single(model)]

    def judged(self, time, ideas):
        """[(score, ctrl (T, nu))] of the ideas that stay within the limits, some made smaller."""
        out, waiting = [], [np.asarray(idea) for idea in ideas]
        for _ in range(TRIES):
            if not waiting:
                break
            recordings = [self._recording(time, ctrl) for ctrl in waiting]
            motions = self._motions(recordings)
            inside = [self._inside(motion) for motion in motions]
            out += [
                (self._score(recording, motion), recording.ctrl)
                for recording, motion, fine in zip(recordings, motions, inside)
                if fine
            ]
            waiting = [
                ctrl[0] + SMALLER * (ctrl - ctrl[0])
                for ctrl, fine in zip(waiting, inside)
                if not fine
            ]
        return [item for item in out if np.isfinite(item[0])]

    def _recording(self, time, ctrl):
        """A recording of nothing but controls."""
        rows = len(time)
        still = np.tile(self.start, (rows, 1)), np.zeros((rows, self.model.nv))
        return Recording("next", time, *still, ctrl)

    def _motions(self, recordings):
        """[(qpos (H, T, nq), qvel (H, T, nv))] of each recording from rest, under all
        explanations."""
        count, settings = len(self.left.settings), self.left.settings
        windows = [Window(r, 0, len(r.time) - 1) for r in recordings for _ in settings]
        starts = (
            np.tile(self.start, (len(windows), 1)),
            np.zeros((len(windows), self.model.nv)),
        )
        qpos, qvel = self.world.simulate(list(settings) * len(recordings), *starts, windows)
        parts = range(0, len(windows), count)
        return [(qpos[k : k + count], qvel[k : k + count]) for k in parts]

    def _inside(self, motion):
        """Whether a motion stays within ranges and speeds under every explanation."""
        limits = self.left.limits
        q, v = motion[0][..., self.columns], motion[1][..., self.speeds]
        if not (np.isfinite(q).all() and np.isfinite(v).all()):
            return False
        fits = (q >= limits.low) & (q <= limits.high) & (np.abs(v) <= limits.speed)
        return bool(fits.all())

    def _score(self, recording, motion):
        """What an excitation is worth: in nats with rivals, else the logarithm of a determinant."""
        if len(self.left.settings) > 1:
            pairs = permutations(range(len(self.left.settings)), 2)
            return min(self._evidence(recording, motion, true, wrong) for true, wrong in pairs)
        _, slopes, steps, _ = self._sensitivities(recording, motion, 0, self.left.settings[0])
        information = slopes.T @ slopes
        sign, size = np.linalg.slogdet(information + 1e-12 * np.eye(len(steps)))
        return float(size) if sign > 0 and len(steps) else -np.inf

    def _evidence(self, recording, motion, true, wrong):
        """Expected logarithm of the ratio of evidence for `true` against `wrong`, refitted."""
        setting = self.left.settings[wrong]
        residual, slopes, _, _ = self._sensitivities(recording, motion, true, setting)
        if slopes.shape[1]:
            residual = residual - slopes @ np.linalg.lstsq(slopes, residual, rcond=None)[0]
        return 0.5 * float(residual @ residual)

    def refitted(self, recording, motion, true, wrong):
        """As _evidence(), after a refit that goes as far as it wants: one explanation may hold the
        other as a limit."""
        setting, damping = dict(self.left.settings[wrong]), 1e-3
        residual, slopes, steps, labels = self._sensitivities(recording, motion, true, setting)
        for _ in range(REFITS):
            if not len(steps):
                break
            gram = slopes.T @ slopes
            gram += damping * np.diag(np.diag(gram)) + 1e-12 * np.eye(len(steps))
            move = -np.linalg.solve(gram, slopes.T @ residual) * steps
            trial = {c: list(values) for c, values in setting.items()}
            for (candidate, k), change in zip(labels, move):
                if candidate in trial:
                    parameter = candidate.parameters[k]
                    new = np.clip(trial[candidate][k] + change, parameter.low, parameter.high)
                    trial[candidate][k] = float(new)
            trial = {c: tuple(values) for c, values in trial.items()}
            told = self._sensitivities(recording, motion, true, trial)
            if told[0] @ told[0] < residual @ residual:
                setting, damping = trial, damping / 10
                residual, slopes, steps, labels = told
            else:
                damping *= 10
        return 0.5 * float(residual @ residual)

    def _sensitivities(self, recording, motion, true, setting):
        """(residual (N,), slopes (N, P), steps (P,), labels): what a setting predicts of
        the motion under `true`, in noises, and its change by a step of each parameter; without what
        start states take up."""
        cases, steps, labels = [setting], [], []
        free = {c: c.nominal for c in self.left.free if c not in setting}
        for candidate, values in [*setting.items(), *free.items()]:
            for k, parameter in enumerate(candidate.parameters):
                step = max(PROBE * abs(values[k]), parameter.step)
                step = step if values[k] + step <= parameter.high else -step
                if not np.isfinite(values[k]):
                    continue
                moved = (*values[:k], values[k] + step, *values[k + 1 :])
                cases.append({**setting, candidate: moved})
                steps.append(step)
                labels.append((candidate, k))
        rows = max(4, int(round(WINDOW / self.left.limits.period)))
        firsts = range(0, len(recording.time) - rows, rows)
        windows = [Window(recording, first, first + rows) for _ in cases for first in firsts]
        starts = (np.tile(x[true][list(firsts)], (len(cases), 1)) for x in motion)
        told = self.world.simulate([c for c in cases for _ in firsts], *starts, windows)[0]
        told = told[..., self.columns].reshape(len(cases), len(firsts), rows + 1, -1)
        seen = motion[0][true][..., self.columns]
        seen = np.stack([seen[first : first + rows + 1] for first in firsts])
        shown = self._without_starts(np.concatenate([(told[:1] - seen), told[1:] - told[:1]]))
        shown = shown.reshape(len(cases), -1)
        return np.nan_to_num(shown[0]), np.nan_to_num(shown[1:].T), np.array(steps), labels

    def _without_starts(self, values):
        """(C, W, T, n) in noises, without what another start position and velocity would change, to
        first order."""
        rows = np.linspace(-1, 1, values.shape[2])
        basis = np.linalg.qr(np.column_stack([np.ones_like(rows), rows]))[0]
        values = values / self.left.noise
        return values - np.einsum("tk,sk,cwsn->cwtn", basis, basis, values)

    def told_apart(self, time, ctrl):
        """Evidence in nats between the two explanations that are hardest to tell apart."""
        recording = self._recording(time, ctrl)
        [motion] = self._motions([recording])
        pairs = permutations(range(len(self.left.settings)), 2)
        return min(self.refitted(recording, motion, true, wrong) for true, wrong in pairs)

    def described(self, time, ctrl, nats=None):
        """The Excitation of controls (T, nu)."""
        recording = self._recording(time, ctrl)
        [motion] = self._motions([recording])
        base = self.left.settings[0]
        _, slopes, steps, labels = self._sensitivities(recording, motion, 0, base)
        spread = np.linalg.pinv(slopes.T @ slopes) if len(steps) else np.zeros((0, 0))
        errors = {}
        for n, ((candidate, k), step) in enumerate(zip(labels, steps)):
            parameter = candidate.parameters[k]
            value = base.get(candidate, candidate.nominal)[k]
            error = float(abs(step) * np.sqrt(spread[n, n]))
            name = f"{candidate.effect} at {candidate.place.name}: {parameter.name}"
            errors[name] = value, error, parameter.unit
        motions = motion[0][..., self.columns]
        return Excitation(time, ctrl, motions, self.left.names, nats, errors, self.start)
