"""Open-loop predictions over horizons up to a second: what the criterion compares.

ahead = Ahead(world, cut_ahead(recordings), smoother)
ahead.start(trajectory)
residual = ahead.residual([{}, {friction: (0.1,)}])      # (settings, W, T, nv), measured less
predicted
"""

from copy import copy

import numpy as np

from diagnosis.effects.base import runge_kutta
from diagnosis.estimation import windowing
from diagnosis.simulation.simulator import step_of

HORIZONS = 0.1, 0.3, 1.0  # s: ends of the bands of time ahead that count alike
FEWEST = 16  # windows that there should be, if shorter ones make up for it
MOST = 32  # windows that are simulated, evenly chosen of more
LEAST = 7  # rows of a window, at least: fewer tell of little but how it began
GROUPS = 16  # of neighbouring windows, the units that are left out and compared
FREE = 1.0  # share of what the smoother leaves open of a start state, that a prediction may use


def cut_ahead(recordings):
    """Windows end to end, as long as the longest horizon, or shorter where that gave fewer than
    FEWEST."""
    seconds = [r.time[-1] - r.time[r.start] for r in recordings]
    sample = windowing.sampling(recordings)
    longest = max(min(HORIZONS[-1], sum(seconds) / FEWEST), LEAST * sample)
    windows = windowing.cut(recordings, longest)
    return [windows[i] for i in windowing.evenly(len(windows), MOST)]


def with_own_step(setting):
    """A setting with the simulator's own time step in the place of a finer one."""
    return {c: v for c, v in setting.items() if not c.effect.numerical}


def neighbours(number):
    """Group (number,) of each of so many windows or rows in their order."""
    return np.arange(number) * min(GROUPS, number) // max(number, 1)


class Ahead:
    """Windows of recordings with start states, and what is measured in them.

    measured (W, T, nq), known (W, T, nv); band (W, T): index of the horizon that a row's time ahead
    falls into, -1 for none; group (W,): which windows are left out together; channels: [dofs];
    travel (nv,): three times what is gone in a window, beyond which a prediction is lost.
    """

    def __init__(self, world, windows, noise):
        self.world, self.model, self.windows = world, world.model, windows
        self.measured = windowing.measured(windows)
        self.known = windowing.known(self.model, windows)
        self.known[:, 0] = False
        time = windowing.measured(windows, lambda recording: recording.time)
        self.seconds = time - time[:, :1]
        ends = np.nanmax(self.seconds) * np.array(HORIZONS) / HORIZONS[-1] * (1 + 1e-6)
        self.band = np.searchsorted(ends, self.seconds)
        self.band[self.band == len(ends)] = -1  # of no row: NaN is beyond all ends
        self.band[:, 0] = -1
        self.group = neighbours(len(windows))
        self.channels = list(windowing.channels(self.model).values())
        self.noise, self.step = noise, self.model.opt.timestep
        gone = windowing.difference(self.model, self.measured[:, :1], self.measured)
        gone = np.quantile(np.where(np.isfinite(gone), abs(gone), 0.0), 0.98, axis=(0, 1))
        self.travel = np.maximum(3 * gone, 10 * np.where(np.isfinite(noise), noise, 1.0))
        self.qpos, self.qvel = windowing.recorded_starts(self.model, windows)
        self.spread = np.zeros((len(windows), 2 * self.model.nv))  # of start states
        self.base, self._freedom = {}, None
        self.coarse = {}  # {time_step: seconds} for columns; empty: the simulator's own

    def start(self, trajectory, setting=None):
        """Begin the windows at a Trajectory's states; setting: that under which it was located."""
        self.qpos, self.qvel = trajectory.at(self.windows)
        self.step = trajectory.step or self.model.opt.timestep
        rows = trajectory.begin(self.windows)
        self.spread = FREE * np.concatenate([trajectory.qpos_sd[rows], trajectory.qvel_sd[rows]], 1)
        self.base, self._freedom = setting or {}, None

    @property
    def known_noise(self):
        """(nv,): the noise; infinite where none is known, so that errors there tell nothing."""
        return np.where(np.isfinite(self.noise), self.noise, np.inf)

    def heavier(self, setting, options):
        """(columns, nv): share of its inertia that a unit of each column of Options adds to a
        joint, where columns leave that out: none, for here they are simulated."""
        return np.zeros((sum(len(option.columns) for option in options), self.model.nv))

    def freedom(self):
        """(W, T, nv, 2 nv): how predictions change per standard deviation of the start states."""
        if self._freedom is None:
            self._freedom = self._moved_starts()
        return self._freedom

    def _moved_starts(self):
        nv, n = self.model.nv, 2 * self.model.nv
        W, moved = len(self.windows), np.zeros((1 + n, len(self.windows), n))
        moved[1 + np.arange(n), :, np.arange(n)] = self.spread.T
        moved = moved.reshape(-1, n)
        qpos = windowing.integrate(self.model, np.tile(self.qpos, (1 + n, 1)), moved[:, :nv])
        qvel = np.tile(self.qvel, (1 + n, 1)) + moved[:, nv:]
        each = [self.roughly(self.base)] * len(moved)
        qpos = self.world.quick.simulate(each, qpos, qvel, self.windows * (1 + n))[0]
        gaps = self._gaps(qpos.reshape(1 + n, W, *qpos.shape[1:]))
        change = gaps[0] - gaps[1:]
        change[(abs(gaps) >= self.travel)[1:] | (abs(gaps[0]) >= self.travel)] = 0.0
        return np.moveaxis(change, 0, -1)

    def residual(self, settings, refine=1):
        """Measured less predicted, (settings, W, T, nv): 0 where nothing was measured, no farther
        than the travel. refine: the time step is divided by it."""
        qvel = np.concatenate([self._velocities(s, refine) for s in settings])
        return self._simulated(self.world, settings, qvel, refine)

    def drawn(self, setting, residual, louder, rng):
        """A residual (W, T, nv) as a perfect simulator would leave it: of readings with noise,
        start states as far off as the smoother leaves them, both so many times louder (nv,).
        residual: what the setting leaves."""
        off, nv = self.spread * rng.standard_normal(self.spread.shape), self.model.nv
        other = copy(self)
        other.qpos = windowing.integrate(self.model, self.qpos, louder * off[:, :nv])
        other.qvel = self.qvel + louder * off[:, nv:]
        noise = louder * np.where(np.isfinite(self.noise), self.noise, 0.0)
        gap = residual - other.residual([setting])[0] + noise * rng.standard_normal(residual.shape)
        return np.where(self.known, gap, 0.0)

    def rough(self, settings, begun=None):
        """As of residual(), for columns, which are differences of two of these: what a coarse step
        or a simple integrator does wrong it does in both. begun: see World.simulate."""
        some, qvel = [*map(self.roughly, settings)], np.tile(self.qvel, (len(settings), 1))
        begun = begun and self.roughly(begun)
        return self._simulated(self.world.quick, some, qvel, begun=begun)

    def same(self, setting):
        """Whether rough() simulates a setting as residual() does."""
        return self.world.quick is self.world and self.roughly(setting) == setting

    def roughly(self, setting):
        """A setting with the time step of columns."""
        return {**with_own_step(setting), **self.coarse}

    def _simulated(self, world, settings, qvel, refine=1, begun=None):
        n, each = len(settings), [s for s in settings for _ in self.windows]
        starts = np.tile(self.qpos, (n, 1)), qvel
        qpos = world.simulate(each, *starts, self.windows * n, refine, begun=begun)[0]
        return self._gaps(qpos.reshape(n, len(self.windows), *qpos.shape[1:]))

    def _gaps(self, qpos):
        """Measured less predicted (n, W, T, nv) of predictions (n, W, T, nq)."""
        out = np.empty((len(qpos), *self.known.shape))
        for k, predicted in enumerate(qpos):
            with np.errstate(invalid="ignore", over="ignore"):
                gap = windowing.difference(self.model, predicted, self.measured)
            gap = np.where(np.isfinite(gap), np.clip(gap, -self.travel, self.travel), self.travel)
            out[k] = np.where(self.known, gap, 0.0)
        return out

    def _velocities(self, setting, refine):
        """Start velocities (W, nv) for the time step of a setting.

        Where positions move by a step's new velocity, a velocity is that of half a step before its
        time: with a shorter step it is a later one than that which was located.
        """
        step = step_of(self.model, setting) / refine
        if step == self.step or runge_kutta(self.model):
            return self.qvel
        rest = with_own_step(setting)
        short = [w._replace(last=w.first + 1) for w in self.windows]
        qvel = self.world.simulate([rest] * len(short), self.qpos, self.qvel, short)[1]
        gained = (qvel[:, 1] - qvel[:, 0]) / self.seconds[:, 1:2]
        return self.qvel + (self.step - step) / 2 * np.where(np.isfinite(gained), gained, 0.0)
