"""What simulations under a hypothesis miss: windows, their measurements and noises, and the residuals that settings leave.

    problem = Problem(world, windows, position_noise, velocity_noise)
    hypothesis = Hypothesis().plus(coulomb, (0.1,))
    problem.residuals([hypothesis.settings] * len(windows), range(len(windows)), qpos, qvel)

A residual is (measured - predicted) / noise; the start states' distances from a wide prior stand behind them.
"""

import warnings
from dataclasses import dataclass

import numpy as np

from diagnosis.estimation import windows as cut
from diagnosis.estimation.observer import far_apart

BLOWN_UP = 1e3  # residual, in noises, of a prediction that is not finite
BLOCK_BYTES = 16e6  # of residuals worked out at a time


@dataclass(frozen=True)
class Hypothesis:
    """Effects and their values: ((candidate, (value, ...)), ...)."""

    effects: tuple = ()

    @property
    def settings(self):
        return dict(self.effects)

    @property
    def candidates(self):
        return tuple(c for c, _ in self.effects)

    @property
    def vector(self):
        return np.array([v for _, values in self.effects for v in values], float)

    @property
    def parameters(self):
        return [p for c, _ in self.effects for p in c.parameters]

    @property
    def possible(self):
        """Whether all values are such as a real machine can have, the effects being what they are called."""
        return all(c.effect.possible(values, c.nominal) for c, values in self.effects)

    def moved(self, vector):
        out, at = [], 0
        for c, values in self.effects:
            out.append((c, tuple(float(v) for v in vector[at : at + len(values)])))
            at += len(values)
        return Hypothesis(tuple(out))

    def plus(self, candidate, values):
        kept = tuple(e for e in self.effects if e[0] != candidate)
        return Hypothesis(kept + ((candidate, tuple(float(v) for v in values)),))

    def minus(self, *candidates):
        return Hypothesis(tuple(e for e in self.effects if e[0] not in candidates))


@dataclass
class Fit:
    hypothesis: Hypothesis
    qpos: np.ndarray  # (W, nq) start states
    qvel: np.ndarray  # (W, nv)
    residual: np.ndarray  # (W, m)
    start_jacobian: np.ndarray  # (W, m, 2 nv), of the prediction

    @property
    def chi2(self):
        """(W,) squared residual of every window."""
        return (self.residual**2).sum(1)

    def better(self, other):
        """Every window as in this fit, or as in another of the same hypothesis where that leaves less."""
        less = other.chi2 < self.chi2
        take = lambda x, y: x if x is y else np.where(less.reshape(-1, *[1] * (x.ndim - 1)), y, x)
        return Fit(
            self.hypothesis,
            *(
                take(getattr(self, x), getattr(other, x))
                for x in ("qpos", "qvel", "residual", "start_jacobian")
            ),
        )

    def subset(self, keep):
        return Fit(
            self.hypothesis,
            self.qpos[keep],
            self.qvel[keep],
            self.residual[keep],
            self.start_jacobian[keep],
        )


class Problem:
    """Windows with their measurements and noises; turns states and settings into residuals."""

    def __init__(self, world, windows, position_noise, velocity_noise):
        self.world, self.model, self.windows = world, world.model, list(windows)
        nv = self.model.nv
        self.measured_qpos = cut.measured(self.windows, "qpos")
        self.measured_qvel = cut.measured(self.windows, "qvel")
        # A scale, not a noise: it stays clear of zero where the noise is far below what any model can explain.
        with warnings.catch_warnings(action="ignore"):  # what was never measured has none
            spread = (
                np.nanmedian(np.nanstd(self.measured_qpos, axis=1), axis=0)
                if self.model.nq == nv
                else np.zeros(nv)
            )
        position_noise = np.maximum(position_noise, 1e-3 * np.nan_to_num(spread))
        known = np.isfinite(cut.difference(self.model, self.measured_qpos, self.measured_qpos))
        seen = np.isfinite(self.measured_qvel)
        self.weight = np.concatenate(
            [known / position_noise] + ([seen / velocity_noise] if seen.any() else []), -1
        )  # (W, T, nv or 2 nv)
        self.weight[~np.isfinite(self.weight)] = 0.0
        self.guess_qpos, self.guess_qvel = cut.recorded_starts(self.model, self.windows)
        # Wide priors on the start states: they only decide what the measurements leave open.
        sample = cut.sampling(w.recording for w in self.windows)
        speed = np.sqrt(np.mean(self.guess_qvel**2, axis=0)) + 1e-3
        finite = np.where(np.isfinite(position_noise), position_noise, 0.0)
        self.start_scale = np.concatenate(
            [np.where(finite > 0, 20 * finite, 1.0), np.maximum(20 * finite / sample, speed)]
        )  # (2 nv,)
        span = np.median(
            [w.recording.time[w.last] - w.recording.time[w.first] for w in self.windows]
        )
        small = np.where(finite > 0, finite, 1e-4)
        self.start_step = np.concatenate([0.5 * small, 0.5 * small / span])
        self.rows = int(self.weight.astype(bool).sum())
        self.far_apart = far_apart(w.recording for w in self.windows)
        self.size = self.weight[0].size + 2 * nv
        self.key = (
            tuple(self.windows),
            position_noise.tobytes(),
            np.asarray(velocity_noise).tobytes(),
        )

    @property
    def taken(self):
        """(W,) how many of a window's rows its start state takes up: two for each dof that was measured there."""
        seen, nv = (self.weight > 0).any(1), self.model.nv
        return 2 * (seen[:, :nv] | seen[:, -nv:]).sum(1)

    @property
    def free(self):
        """(W,) how many it does not, at least one."""
        return np.maximum((self.weight > 0).sum((1, 2)) - self.taken, 1)

    def subset(self, keep):
        out = object.__new__(Problem)
        out.__dict__.update(self.__dict__)
        out.windows, out.key = [self.windows[i] for i in keep], None
        for name in ("measured_qpos", "measured_qvel", "weight", "guess_qpos", "guess_qvel"):
            setattr(out, name, getattr(self, name)[keep])
        out.rows = int(out.weight.astype(bool).sum())
        return out

    def first_rows(self, number):
        """The problem with no more than the first rows of every window."""
        out = self.subset(np.arange(len(self.windows)))
        out.windows = [w._replace(last=min(w.last, w.first + number - 1)) for w in self.windows]
        for name in ("measured_qpos", "measured_qvel", "weight"):
            setattr(out, name, getattr(self, name)[:, :number])
        out.size, out.rows = (
            out.weight[0].size + 2 * self.model.nv,
            int(out.weight.astype(bool).sum()),
        )
        return out

    def weighted(self, fit, factor):
        """This problem and a fit of it with every window's measurements weighted by a factor (W,) more."""
        out, size = self.subset(np.arange(len(self.windows))), self.weight[0].size
        out.weight = self.weight * factor[:, None, None]
        scale = np.where(np.arange(self.size) < size, factor[:, None], 1.0)
        return out, Fit(
            fit.hypothesis,
            fit.qpos,
            fit.qvel,
            fit.residual * scale,
            fit.start_jacobian * scale[..., None],
        )

    def refined(self, fit):
        """The same fit with its residual as half the time step would give it."""
        every = np.arange(len(self.windows))
        residual = self.residuals(
            [fit.hypothesis.settings] * len(every), every, fit.qpos, fit.qvel, refine=2
        )
        return Fit(fit.hypothesis, fit.qpos, fit.qvel, residual, fit.start_jacobian)

    def residuals(self, settings, which, qpos, qvel, refine=1):
        """(S, m): S simulations, the i-th in window which[i] under settings[i] from (qpos[i], qvel[i])."""
        which, block = np.asarray(which), max(1, int(BLOCK_BYTES / (8 * self.size)))
        if len(which) > block:
            out = np.empty((len(which), self.size))
            for some in (slice(a, a + block) for a in range(0, len(which), block)):
                out[some] = self.residuals(
                    settings[some], which[some], qpos[some], qvel[some], refine
                )
            return out
        predicted_qpos, predicted_qvel = self.world.simulate(
            settings, qpos, qvel, [self.windows[i] for i in which], refine
        )
        short = (
            (0, 0),
            (0, self.weight.shape[1] - predicted_qpos.shape[1]),
            (0, 0),
        )  # these may be the shorter windows
        predicted_qpos, predicted_qvel = (
            np.pad(predicted_qpos, short),
            np.pad(predicted_qvel, short),
        )
        with np.errstate(invalid="ignore", over="ignore"):
            gap = cut.difference(self.model, predicted_qpos, self.measured_qpos[which])
            if self.weight.shape[-1] > gap.shape[-1]:
                gap = np.concatenate([gap, self.measured_qvel[which] - predicted_qvel], -1)
            weight = self.weight[which]
            residual = np.where(weight > 0, gap * weight, 0.0)
            blown = ~np.isfinite(residual).all((1, 2)) | (
                np.abs(residual).max((1, 2)) > BLOWN_UP * 100
            )
        residual = np.clip(
            np.nan_to_num(residual, nan=BLOWN_UP, posinf=BLOWN_UP, neginf=-BLOWN_UP),
            -100 * BLOWN_UP,
            100 * BLOWN_UP,
        )
        residual[blown & ~np.isfinite(gap).all((1, 2))] = BLOWN_UP
        prior = np.concatenate(
            [
                cut.difference(self.model, qpos, self.guess_qpos[which]),
                self.guess_qvel[which] - qvel,
            ],
            -1,
        )
        return np.concatenate([residual.reshape(len(which), -1), prior / self.start_scale], 1)

    def moved(self, qpos, qvel, step):
        """Start states moved by step (S, 2 nv)."""
        nv = self.model.nv
        return cut.integrate(self.model, qpos, step[:, :nv]), qvel + step[:, nv:]

    def start_jacobians(self, settings, which, qpos, qvel, residual):
        """(S, m, 2 nv): change of the prediction with the start state, one-sided differences."""
        n, m = len(which), 2 * self.model.nv
        steps = np.tile(np.diag(self.start_step), (n, 1))
        big_qpos, big_qvel = self.moved(np.repeat(qpos, m, 0), np.repeat(qvel, m, 0), steps)
        moved = self.residuals(
            [s for s in settings for _ in range(m)], np.repeat(which, m), big_qpos, big_qvel
        )
        slope = (residual[:, None] - moved.reshape(n, m, -1)) / self.start_step[:, None]
        return np.swapaxes(slope, 1, 2)
