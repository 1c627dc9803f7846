"""Effects that act only for a while: a load picked up, a push. Where in time is concentrated what the simulator misses?

event = find(world, recordings, setting, trajectory, noise)      # None, or an Event
event.candidate, event.values, event.when                        # a localised Candidate, {"recording": name, "time": [a, b]}
finding(event)                                                   # as in diagnosis.json

Short windows follow each other through every recording, begun at the smoothed states, which are free to
move: what they explain is projected out. The gain of an effect that acts in windows a..b only is that of
the sums of its scores and Gram matrices over them, so every interval is tested from one simulation per
effect; then its ends are moved and its values fitted in the simulator.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from diagnosis.estimation import windows as cut
from diagnosis.selection.unmodelled_force import dependences

LEVEL = 1e-3  # false-alarm rate, shared between all intervals and effects
SPAN = 0.2  # s, of a window
MOST = 400  # windows that are looked at, those about the largest located force
CONCENTRATED = 0.8  # of what lies above the usual residual, the share that the event must explain
ALONE = 0.9  # of an event's gain, the share of one window, above which that window is odd
LONGEST = 0.6  # of a recording: what lasts longer is no event
TRIES = 50  # intervals that are looked at closer
UNSEEN = 1e-8  # squared size, in noises, of a step that shows nowhere
SAME = 1.1  # squared residual around an event, up to which another effect may stand in its place


@dataclass(frozen=True)
class Event:
    """candidate: localised; values; recording; time (from, to), s; low, high: 95 % bounds of the values; p_value:
    corrected for all that was looked at; removed: share of the error around it; left: squared residual of all
    windows with it; others [(candidate, values)]: what explains it as well."""

    candidate: object
    values: tuple
    recording: object
    time: tuple
    p_value: float
    left: float = np.inf
    low: tuple = ()
    high: tuple = ()
    removed: float = 0.0
    others: tuple = ()

    @property
    def when(self):
        return {"recording": self.recording.name, "time": [float(t) for t in self.time]}


class Windows:
    """Predictions of windows from free start states: residuals in noises, with what start states explain taken out."""

    def __init__(self, world, setting, windows, trajectory, noise):
        """trajectory: a smoother.Trajectory under the setting; noise (nv,): of the positions."""
        self.world, self.setting, self.windows = world, setting, windows
        self.qpos, self.qvel = trajectory.at(windows)
        self.measured, self.noise = cut.measured(windows), noise
        self.residual = self._raw([setting])[0]
        small = np.concatenate([1e-5 * np.ones_like(noise), 1e-4 * np.ones_like(noise)])
        slopes = [
            (self._raw([setting], eps * unit)[0] - self.residual) / eps
            for eps, unit in zip(small, np.eye(len(small)))
        ]
        self.known = self.residual != 0
        # of each window its own basis: orthonormal columns (W, rows, 2 nv)
        self.basis = np.linalg.qr(np.stack(slopes, -1))[0]
        self.rows = np.maximum(self.known.sum(1) - self.basis.shape[-1], 1)

    def _raw(self, settings, moved=None):
        """Measured less predicted in noises, (settings, W, rows); 0 where nothing was measured or predicted."""
        model, n = self.world.model, len(settings)
        moved = np.zeros(2 * model.nv) if moved is None else moved
        qpos = np.tile(
            cut.integrate(model, self.qpos, np.tile(moved[: model.nv], (len(self.qpos), 1))), (n, 1)
        )
        qvel = np.tile(self.qvel + moved[model.nv :], (n, 1))
        each = [s for s in settings for _ in self.windows]
        path = self.world.simulate(each, qpos, qvel, self.windows * n)[0]
        with np.errstate(invalid="ignore", over="ignore"):
            gap = cut.difference(model, path, np.tile(self.measured, (n, 1, 1))) / self.noise
        return np.where(np.isfinite(gap), gap, 0.0).reshape(n, len(self.windows), -1)

    def left(self, settings):
        """What settings leave beside free start states, (settings, W, rows)."""
        raw = self._raw(settings)
        return raw - np.einsum(
            "wrk,swk->swr", self.basis, np.einsum("wrk,swr->swk", self.basis, raw)
        )

    def subset(self, index):
        """The same of some windows."""
        out = object.__new__(Windows)
        out.__dict__ = {**self.__dict__, "windows": [self.windows[i] for i in index]}
        for name in ("qpos", "qvel", "measured", "residual", "known", "basis", "rows"):
            setattr(out, name, getattr(self, name)[index])
        return out


@dataclass(frozen=True)
class Look:
    """An effect that may come and go: timed, the candidate to report; base, its values where it adds nothing;
    steps (k,) of the columns that show; which of the parameters (k,); score (W, k), gram (W, k, k)."""

    timed: object
    base: np.ndarray
    steps: np.ndarray
    which: np.ndarray
    score: np.ndarray
    gram: np.ndarray

    def values(self, amounts):
        """All values of the candidate at amounts (k,) of the columns."""
        out = self.base.copy()
        out[self.which] += amounts * self.steps
        low, high = (
            np.array([getattr(p, end) for p in self.timed.parameters]) for end in ("low", "high")
        )
        return tuple(float(v) for v in np.clip(out, low, high))


def happened(world, recordings, looks, noise):
    """The Event that leaves least, of those found under several (setting, trajectory); None if there is none."""
    found = [find(world, recordings, setting, trajectory, noise) for setting, trajectory in looks]
    return min((e for e in found if e), key=lambda e: e.left, default=None)


def find(world, recordings, setting, trajectory, noise):
    """The one interval and effect that explain most of a residual which is concentrated there, or None.

    trajectory: a smoother.Trajectory under the setting {Candidate: values}; noise (nv,): of positions.
    """
    windows = [w for r in recordings for w in cut.consecutive(r, SPAN, r.start)]
    number = len(windows)
    if number < 12:
        return None
    first = max(0, min(_loudest(trajectory, windows) - MOST // 2, number - MOST))
    noise = np.where(np.isfinite(noise), np.maximum(noise, 1e-12), 1.0)
    scene = Windows(world, setting, windows[first:][:MOST], trajectory, noise)
    chi2 = (scene.left([setting])[0] ** 2).sum(1)
    each = chi2 / scene.rows
    usual = np.median(each)
    looks = _looks(scene)
    found = [f for f in (_interval(look, scene.windows, usual) for look in looks) if f]
    if not found:
        return None
    _, gain, a, b, spread, look = max(found, key=lambda f: f[0])
    k = len(look.which)
    p = stats.f.sf(gain / k / spread, k, max(number - k, 1)) * number**2 * len(looks)
    ceiling = usual + 4 * (usual - np.quantile(each, 0.16))  # of windows without an event
    excess = ((each - ceiling).clip(0) * scene.rows).sum()
    if p > LEVEL or gain < CONCENTRATED * excess:
        return None
    local = _Local(scene, chi2, a, b)
    event = local.event(look, min(float(p), 1.0))
    if local.lasting(event, dependences(world, trajectory, recordings)):
        return None
    return replace(event, others=local.others(event, looks, look, gain))


def _loudest(trajectory, windows):
    """Index of the window with the largest located force, in each joint's usual ones."""
    size = np.median(abs(trajectory.force), axis=0) + 1e-300
    loud = ((trajectory.force / size) ** 2).sum(1)
    ends = [(trajectory.first[w.recording] + w.first, w.last - w.first + 1) for w in windows]
    return int(np.argmax([loud[a : a + n].mean() for a, n in ends]))


def _looks(scene):
    """The Looks of every effect that may come and go: pushes, and changes of a mass."""
    world, setting, out = scene.world, scene.setting, []
    by = {(c.effect.name, c.place): c for c in world.candidates}
    pairs = [(c, c) for c in world.candidates if c.effect.name == "external_force"]
    pairs += [
        (by["mass", c.place], c)
        for c in world.candidates
        if c.effect.timed and ("mass", c.place) in by
    ]
    plain = scene.left([setting])[0]
    for steady, timed in pairs:
        base = np.array(
            setting.get(steady, steady.nominal), float
        )  # what a fit holds of it already
        steps = np.array([p.step for p in steady.parameters])
        moved = scene.left([{**setting, steady: tuple(row)} for row in base + np.diag(steps)])
        columns = np.moveaxis(plain - moved, 0, -1)
        which = np.flatnonzero((columns**2).sum((0, 1)) > UNSEEN)
        if which.size:
            columns = columns[..., which]
            # a push adds to one that lasts, a load takes the mass's place
            start = np.array(timed.nominal, float) if steady is timed else base
            score = np.einsum("wrk,wr->wk", columns, plain)
            gram = np.einsum("wrk,wrl->wkl", columns, columns)
            out.append(Look(timed, start, steps[which], which, score, gram))
    return out


def _interval(look, windows, usual):
    """(merit, gain, first, last, spread, look) of the windows in which an effect gains most; None if there are none.

    merit: the gain less what so many parameters gain of nothing. spread: gain per parameter elsewhere.
    """
    k, found = len(look.which), []
    alone = (solved(look.gram, look.score) * look.score).sum(-1)
    spread = max(usual, np.quantile(alone, 0.3) / stats.chi2.ppf(0.3, k))
    owner = [w.recording for w in windows]
    for r in dict.fromkeys(owner):
        mine = np.flatnonzero([o is r for o in owner])
        most = max(1, int(LONGEST * len(mine)))
        for a in mine:
            score = np.cumsum(look.score[a : min(a + most, mine[-1] + 1)], 0)
            gram = np.cumsum(look.gram[a : a + len(score)], 0)
            gain = (solved(gram, score) * score).sum(-1)
            found += [(float(g), a, a + n) for n, g in enumerate(gain)]
    for gain, a, b in sorted(found, reverse=True)[:TRIES]:
        score, gram = look.score[a : b + 1], look.gram[a : b + 1]
        value = solved(gram.sum(0), score.sum(0))
        share = 2 * score @ value - np.einsum("i,wij,j->w", value, gram, value)
        if share.max() < ALONE * gain:
            merit = gain - spread * k * np.log(len(windows))
            return merit, gain, a, b, spread, look
    return None


class _Local:
    """The windows around an event's, a..b of a scene, to fit its ends and values in."""

    def __init__(self, scene, chi2, a, b):
        """chi2 (W,): squared residuals of the scene's windows without an event."""
        owner = [w.recording for w in scene.windows]
        near = [i for i in range(a - 2, b + 3) if 0 <= i < len(owner) and owner[i] is owner[a]]
        self.scene, self.local, self.near = scene, scene.subset(near), near
        self.recording, self.chi2, self.inside = owner[a], chi2, slice(a, b + 1)
        time = self.recording.time
        self.time = [time[scene.windows[a].first], time[scene.windows[b].last]]
        self.sample = float(np.median(np.diff(time)))

    def _placed(self, look, time):
        when = {"recording": self.recording.name, "time": [float(t) for t in time]}
        return self.scene.world.localised(look.timed, when)

    def _fits(self, look, times, values):
        """[(left, amounts, Gram matrix)] of an event at several times, linear about some values."""
        settings = []
        for time in times:
            candidate = self._placed(look, time)
            rows = np.tile(values, (1 + len(look.which), 1))
            rows[1 + np.arange(len(look.which)), look.which] += look.steps
            settings += [{**self.scene.setting, candidate: tuple(row)} for row in rows]
        left = self.local.left(settings).reshape(len(times), 1 + len(look.which), -1)
        out = []
        for rows in left:
            columns = (rows[:1] - rows[1:]).T
            amounts = solved(columns.T @ columns, columns.T @ rows[0])
            out.append((float(((rows[0] - columns @ amounts) ** 2).sum()), amounts))
        return out

    def event(self, look, p_value):
        """The Event with its ends moved and its values fitted, on the windows around it."""
        inside, which = self.inside, look.which
        values = look.values(solved(look.gram[inside].sum(0), look.score[inside].sum(0)))
        ends = list(self.time)
        move = lambda amounts: look.values(
            (np.array(values)[which] - look.base[which]) / look.steps + amounts
        )
        for reach in (SPAN, SPAN / 3, self.sample):
            for end in (0, 1):
                trials = [ends] + [
                    [t + shift * (i == end) for i, t in enumerate(ends)]
                    for shift in np.linspace(-reach, reach, 6)
                ]
                trials = [t for t in trials if t[1] - t[0] > self.sample]
                fits = self._fits(look, trials, values)
                best = int(np.argmin([left for left, _ in fits]))
                ends, values = trials[best], move(fits[best][1])
        values = move(self._fits(look, [ends], values)[0][1])
        left, half = self._spread(look, ends, values)
        low, high = (tuple(float(v) for v in np.add(values, sign * half)) for sign in (-1, 1))
        around = self.chi2[self.near].sum()
        return Event(
            self._placed(look, ends),
            values,
            self.recording,
            tuple(ends),
            p_value,
            left=float(self.chi2.sum() - around + left),
            low=low,
            high=high,
            removed=float(1 - np.sqrt(left / around)),
        )

    def _spread(self, look, ends, values):
        """(squared residual, half widths (k,) of the values' 95 % intervals, ends being free)."""
        k, sample = len(look.which), self.sample
        rows = np.tile(values, (1 + k, 1))
        rows[1 + np.arange(k), look.which] += look.steps
        settings = [{**self.scene.setting, self._placed(look, ends): tuple(row)} for row in rows]
        for shift in ([-sample, 0.0], [0.0, sample]):
            placed = self._placed(look, np.add(ends, shift))
            settings.append({**self.scene.setting, placed: tuple(values)})
        left = self.local.left(settings).reshape(len(settings), -1)
        columns = (left[:1] - left[1:]).T
        size = np.linalg.norm(columns, axis=0) + 1e-300
        inverse = np.linalg.pinv((columns / size).T @ (columns / size), rcond=1e-9)
        freedom = max(self.local.rows.sum() - columns.shape[1], 1)
        chi2 = float((left[0] ** 2).sum())
        error = np.sqrt(np.diag(inverse) * max(chi2 / freedom, 1.0)) / size
        half = np.zeros(len(values))
        half[look.which] = stats.t.ppf(0.975, freedom) * error[:k] * look.steps
        return chi2, half

    def lasting(self, event, curves):
        """Whether a force that acts whenever the motion is like that explains half as much as the event."""
        curves = [c for c in curves if "time" not in c.variables]
        settings = [{**self.scene.setting, c.candidate: c.values} for c in curves]
        left = [(self.local.left([s]) ** 2).sum() for s in settings]
        around = self.chi2[self.near].sum()
        with_event = event.left - (self.chi2.sum() - around)
        return any(around - x > 0.5 * (around - with_event) for x in left)

    def others(self, event, looks, found, gain):
        """((candidate, values), ...) of what explains an event as well, at its times, best first."""
        inside, out = self.inside, []
        most = SAME * (event.left - self.chi2.sum() + self.chi2[self.near].sum())
        for look in looks:
            amounts = solved(look.gram[inside].sum(0), look.score[inside].sum(0))
            if look is found or amounts @ look.score[inside].sum(0) < CONCENTRATED * gain:
                continue
            values = look.values(amounts)
            left, more = self._fits(look, [event.time], values)[0]
            if left < most:
                out.append((left, self._placed(look, event.time), look.values(amounts + more)))
        out.sort(key=lambda item: item[0])
        return tuple((candidate, values) for _, candidate, values in out[:3])


def solved(gram, score):
    """gram^-1 score of small, perhaps singular matrices: (..., k, k), (..., k) -> (..., k)."""
    size = np.sqrt(np.maximum(np.einsum("...kk->...k", gram), 1e-300))
    block = gram / size[..., None, :] / size[..., None] + 1e-8 * np.eye(size.shape[-1])
    return np.linalg.solve(block, (score / size)[..., None])[..., 0] / size


def quiet(recording, event):
    """[(first row, end row)] of the stretches of a recording that an event does not touch."""
    rows = len(recording.time)
    if event is None or recording is not event.recording:
        return [(recording.start, rows)]
    start, stop = np.searchsorted(recording.time, event.time)
    stretches = (recording.start, int(start)), (int(stop) + 1, rows)
    return [(a, b) for a, b in stretches if b - a > 8]


def calm(recordings, event):
    """The recordings without the time of an event, each stretch a Recording: what lasts is searched in these."""
    return [
        r if (a, b) == (r.start, len(r.time)) else _part(r, a, b)
        for r in recordings
        for a, b in quiet(r, event)
    ]


def _part(recording, a, b):
    rows = slice(a, b)
    fields = {f: getattr(recording, f)[rows] for f in ("time", "qpos", "qvel", "ctrl")}
    sensors = {name: values[rows] for name, values in recording.sensors.items()}
    return replace(recording, **fields, sensors=sensors, start=0)


def finding(event):
    """The finding of an event, as diagnosis.json has it."""
    told = _told(event.candidate, event.values)
    for p, low, high in zip(told["parameters"], event.low, event.high):
        p |= (
            {"low": low, "high": high} if high > low else {"value": None, "low": None, "high": None}
        )
    return {
        **told,
        "evidence": {
            "held_out_error_removed": 0.0,
            "error_removed_there": event.removed,
            "p_value": event.p_value,
        },
        "adequate": True,
        "strains": None,
        "depends_on": ["time"],
        "when": event.when,
        "written_as": "none",
        "also_possible": [_told(c, values) for c, values in event.others],
    }


def _told(candidate, values):
    """Effect, place and parameters of a candidate in the contract's words."""
    place = {"kind": candidate.place.kind, "name": candidate.place.name}
    parameters = [
        {"name": p.name, "nominal": float(p.nominal), "value": float(v), "unit": p.unit}
        for p, v in zip(candidate.parameters, values)
    ]
    return {"effect": candidate.effect.name, "place": place, "parameters": parameters}
