"""Effects that act for a while in one recording, a load picked up, a push: where is the error?

event = find(world, recordings, setting, trajectory, noise)   # None, or an Event
event.candidate, event.values                                 # a localised Candidate
event.candidate.when                                          # {"recording": name, "time": [a, b]}

The gain of an effect that acts in short windows a..b only is that of the sums of its scores and
Gram matrices over them, so every interval is tested from one simulation per effect. Windows begin
at smoothed states, which are free to move: what they explain is projected out.
"""

from dataclasses import dataclass, replace

import numpy as np

from diagnosis.common.distributions import chi2_ppf, f_sf, t_ppf
from diagnosis.estimation import windowing
from diagnosis.selection.criterion import PRICE, complexity
from diagnosis.selection.missing_force import dependences

LEVEL = 1e-3  # false-alarm rate, shared between all intervals and effects
MOST = 400  # windows that are looked at, those about the largest located force
CONCENTRATED = 0.8  # of what lies above the usual residual, the share that the event must explain
ALONE = 0.9  # of an event's gain, the share of one window, above which that window is odd
LONGEST = 0.6  # of all recordings: what lasts longer is no event
SHORTEST = 8  # rows, of which a stretch needs more
TRIES = 50  # intervals that are looked at closer
STEADY = {"external_force": "external_force", "payload_change": "mass"}  # what comes, what lasts
UNSEEN = 1e-8  # squared size, in noises, of a step that shows nowhere
SPAN = 0.2  # s, of a window
LONGER = 2.5  # of it, windows in which ends and values are fitted
SAME = 1.1  # squared residual around an event, up to which another effect may stand in its place
LASTING = 0.5  # share of the event's gain, and of the force, from which on a lasting force is it
ALIKE = 0.8  # of the event's gain, what another effect must gain to be looked at


def happened(world, recordings, found):
    """The Event that leaves least, beside what an identification.Found holds or in its place, or
    None."""
    noise, setting = found.smoother.position_noise, found.fitted.setting
    events = [find(world, recordings, setting, found.trajectory, noise)]
    if setting:
        events.append(find(world, recordings, {}, found.first, noise, setting))
    return min((e for e in events if e), key=lambda e: e.left, default=None)


def find(world, recordings, setting, trajectory, noise, lasting=None):
    """The Event that explains most of a residual which is concentrated in its time, or None.

    trajectory: a smoother.Trajectory under the setting {Candidate: values}; noise (nv,): of the
    positions; lasting: a setting that may explain it as well.
    """
    windows = windowing.cut(recordings, SPAN)
    number = len(windows)
    if number < 12:
        return None
    first = max(0, min(_loudest(trajectory, windows) - MOST // 2, number - MOST))
    noise = windowing.reporting_noise(noise)
    scene = Windows(world, setting, windows[first:][:MOST], trajectory, noise)
    chi2 = (scene.plain**2).sum(1)
    each = chi2 / scene.rows
    usual = np.median(each)
    looks, spans = _looks(scene), _spans(scene.windows)
    found = [f for f in (_interval(look, spans, usual) for look in looks) if f]
    if not found:
        return None
    _, gain, inside, spread, look = max(found, key=lambda f: f[0])
    k = len(look.which)
    p = f_sf(gain / k / spread, k, max(number - k, 1)) * number**2 * len(looks)
    ceiling = usual + 4 * (usual - np.quantile(each, 0.16))  # of windows without an event
    above = (each - ceiling).clip(0) * scene.rows
    excess, there = above.sum(), above[inside].sum()
    if p > LEVEL or there < CONCENTRATED * excess or not _worth(look, scene, chi2, inside, gain):
        return None
    local = Local(scene, trajectory, chi2, inside)
    curves = dependences(world, trajectory, recordings)
    if local.lasting(gain, curves, lasting):
        return None
    event = local.event(look, min(float(p), 1.0))
    after = scene.left([{**setting, event.candidate: event.values}])[0]
    if chi2.sum() - (after**2).sum() < CONCENTRATED * excess:
        return None
    return replace(event, others=local.others(event, looks, look, gain))


def _worth(look, scene, chi2, inside, gain):
    """Whether an effect takes enough of the error of its recordings for what is asked of any."""
    theirs = {scene.windows[i].recording for i in inside}
    own = [w.recording in theirs for w in scene.windows]
    removed = np.log(chi2[own].sum() / max(chi2[own].sum() - gain, 1e-300)) / 2
    return removed > PRICE * complexity([look.timed])


def _loudest(trajectory, windows):
    """Index of the window with the largest located force, in each joint's usual ones."""
    size = np.median(abs(trajectory.force), axis=0) + 1e-300
    loud = ((trajectory.force / size) ** 2).sum(1)
    ends = [(a, a + w.last - w.first + 1) for a, w in zip(trajectory.begin(windows), windows)]
    return int(np.argmax([loud[a:b].mean() for a, b in ends]))


def _looks(scene):
    """The Looks of every effect that may come and go: pushes, and changes of a mass."""
    world, setting, out = scene.world, scene.setting, []
    by = {(c.effect.name, c.place): c for c in world.candidates}
    for timed in world.candidates:
        name = STEADY.get(timed.effect.name)
        if (name, timed.place) not in by:
            continue
        # a push adds to one that lasts, a load takes the mass's place
        steady = by[name, timed.place]
        base = np.array(setting.get(steady, steady.nominal), float)
        steps = np.array([p.step for p in timed.parameters])
        moved = [{**setting, timed: tuple(row)} for row in base + np.diag(steps)]
        columns = np.moveaxis(scene.changes(moved), 0, -1)
        which = np.flatnonzero((columns**2).sum((0, 1)) > UNSEEN)
        if which.size:
            columns = columns[..., which]
            start = np.array(timed.nominal, float) if steady is timed else base
            score = np.einsum("wrk,wr->wk", columns, scene.plain)
            gram = np.einsum("wrk,wrl->wkl", columns, columns)
            out.append(Look(timed, start, steps[which], which, score, gram))
    return out


def _interval(look, spans, usual):
    """(merit, gain, inside, spread, look) of the windows in which an effect gains most. merit: the
    gain less what so many parameters gain of nothing; spread: gain per parameter elsewhere."""
    k, found = len(look.which), []
    alone = (solved(look.gram, look.score) * look.score).sum(-1)
    spread = max(usual, np.quantile(alone, 0.3) / chi2_ppf(0.3, k))
    for span in spans:
        score, gram = look.score[span].cumsum(0), look.gram[span].cumsum(0)
        gain = (solved(gram, score) * score).sum(-1)
        found += [(float(g), span[:n]) for n, g in enumerate(gain, 1)]
    for gain, inside in sorted(found, key=lambda f: -f[0])[:TRIES]:
        score, gram = look.score[inside], look.gram[inside]
        value = solved(gram.sum(0), score.sum(0))
        share = 2 * score @ value - np.einsum("i,wij,j->w", value, gram, value)
        if share.max() < ALONE * gain:
            merit = gain - spread * k * np.log(len(alone))
            return merit, gain, inside, spread, look
    return None


def _spans(windows):
    """[indices of windows]: an event may be the first so many of them, in one recording."""
    owner = [w.recording for w in windows]
    most, out = max(1, int(LONGEST * len(windows))), []
    for r in windowing.recordings_of(windows):
        mine = np.array([i for i, o in enumerate(owner) if o is r])
        out += [mine[a : a + most] for a in range(len(mine))]
    return out


def quiet(recording, event):
    """[(first row, end row)] of the stretches of a recording that an event does not touch."""
    rows = len(recording.time)
    if event is None or event.recording is not recording:
        return [(recording.start, rows)]
    start, stop = np.searchsorted(recording.time, event.time)
    stretches = (recording.start, int(start)), (int(stop) + 1, rows)
    return [(a, b) for a, b in stretches if b - a > SHORTEST]


def calm(recordings, event):
    """The recordings without the time of an event, each stretch a Recording of its own."""
    return [
        r if (a, b) == (r.start, len(r.time)) else r.part(a, b)
        for r in recordings
        for a, b in quiet(r, event)
    ]


@dataclass(frozen=True)
class Event:
    """candidate: localised; values; recording; time (from, to), s; low, high:
    95 % bounds of the values; p_value: corrected for all that was looked at; removed: share of the
    error around it; left: squared residual of all windows with it; others: ((candidate, values),
    ...), what explains it as well."""

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


class Windows:
    """Residuals of windows in noises, with what their start states explain taken out.

    plain (W, rows): what the setting leaves; rough (W, rows): its residual as quick simulations
    have it, start states left in.
    """

    def __init__(self, world, setting, windows, trajectory, noise):
        """trajectory: under the setting; noise (nv,): of the positions."""
        self.world, self.setting, self.windows = world, setting, windows
        self.qpos, self.qvel = trajectory.at(windows)
        self.measured, self.noise = windowing.measured(windows), noise
        self.residual = self._raw(world, [setting])[0]
        small = np.concatenate([1e-5 * np.ones_like(noise), 1e-4 * np.ones_like(noise)])
        same = world.quick is world
        self.rough = self.residual if same else self._raw(world.quick, [setting])[0]
        moved = (self._raw(world.quick, [setting], step)[0] for step in np.diag(small))
        slopes = [(rough - self.rough) / eps for eps, rough in zip(small, moved)]
        # of each window its own basis: orthonormal columns (W, rows, 2 nv)
        self.basis = np.linalg.qr(np.stack(slopes, -1))[0]
        self.rows = np.maximum((self.residual != 0).sum(1) - self.basis.shape[-1], 1)
        self.plain = self._beside(self.residual[None])[0]

    def _raw(self, world, settings, moved=None):
        """Measured less predicted in noises, (settings, W, rows); 0 where either is missing."""
        model, n = world.model, len(settings)
        moved = np.zeros(2 * model.nv) if moved is None else moved
        qpos = np.tile(windowing.integrate(model, self.qpos, moved[: model.nv]), (n, 1))
        qvel = np.tile(self.qvel + moved[model.nv :], (n, 1))
        each = [s for s in settings for _ in self.windows]
        path = world.simulate(each, qpos, qvel, self.windows * n)[0]
        path = path.reshape(n, *self.measured.shape)
        with np.errstate(invalid="ignore", over="ignore"):
            gap = windowing.difference(model, path, self.measured) / self.noise
        return np.where(np.isfinite(gap), gap, 0.0).reshape(n, len(self.windows), -1)

    def left(self, settings):
        """What settings leave beside free start states, (settings, W, rows)."""
        return self._beside(self._raw(self.world, settings))

    def changes(self, settings):
        """What settings change of that, (settings, W, rows): differences of quick simulations."""
        return self._beside(self.rough - self._raw(self.world.quick, settings))

    def _beside(self, raw):
        explained = np.einsum("wrk,swr->swk", self.basis, raw)
        return raw - np.einsum("wrk,swk->swr", self.basis, explained)


@dataclass(frozen=True)
class Look:
    """An effect that may come and go: timed, the candidate to report; base, its values where it
    adds nothing; which of the parameters (k,) show; steps (k,) of their columns; score (W, k), gram
    (W, k, k)."""

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
        low, high = zip(*((p.low, p.high) for p in self.timed.parameters))
        return tuple(np.clip(out, low, high).tolist())


class Local:
    """The windows around an event's, those inside it of a scene, to fit its ends and values in."""

    def __init__(self, scene, trajectory, chi2, inside):
        """chi2 (W,): squared residuals of the scene's windows without an event; inside: indices in
        ascending order, of one recording."""
        windows = dict(enumerate(scene.windows))
        within = [windows[i] for i in inside]
        self.recording = r = within[0].recording
        near = [windows.get(i) for i in range(inside[0] - 2, inside[-1] + 3)]
        near = [w for w in near if w and w.recording is r]
        longer = windowing.consecutive(r, LONGER * SPAN, near[0].first, near[-1].last + 1)
        self.scene, self.chi2, self.inside = scene, chi2, inside
        self.local = Windows(scene.world, scene.setting, longer, trajectory, scene.noise)
        self.around = float((self.local.plain**2).sum())
        self.time = [r.time[within[0].first], r.time[within[-1].last]]
        self.sample = float(windowing.sampling([r]))

    def _placed(self, look, time):
        when = {"recording": self.recording.name, "time": [float(t) for t in time]}
        return self.scene.world.localised(look.timed, when)

    def _settings(self, look, time, values):
        """The setting with an event at a time: at some values, and a step further in each."""
        candidate, k = self._placed(look, time), len(look.which)
        rows = np.tile(values, (1 + k, 1))
        rows[1 + np.arange(k), look.which] += look.steps
        return [{**self.scene.setting, candidate: tuple(row)} for row in rows]

    def _fits(self, look, times, values):
        """[(left, amounts)] of an event at several times, linear about some values."""
        settings = [s for time in times for s in self._settings(look, time, values)]
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
        now = lambda: (np.array(values)[which] - look.base[which]) / look.steps
        for reach in SPAN / 3.0 ** np.arange(4):
            for end in (0, 1):
                shifts = np.outer([0.0, *np.linspace(-reach, reach, 6)], np.eye(2)[end])
                trials = [t for t in (shifts + ends).tolist() if t[1] - t[0] > self.sample]
                fits = self._fits(look, trials, values)
                best = int(np.argmin([left for left, _ in fits]))
                ends, values = trials[best], look.values(now() + fits[best][1])
        values = look.values(now() + self._fits(look, [ends], values)[0][1])
        left, half = self._spread(look, ends, values)
        told = self._placed(look, ends), values, self.recording, tuple(map(float, ends)), p_value
        rest = float(self.chi2.sum() - self.around + left)
        bounds = (tuple((values + sign * half).tolist()) for sign in (-1, 1))
        return Event(*told, rest, *bounds, float(1 - np.sqrt(left / self.around)))

    def _spread(self, look, ends, values):
        """(squared residual, half widths (k,) of the values' 95 % intervals, ends being free)."""
        k, sample, settings = len(look.which), self.sample, self._settings(look, ends, values)
        for shift in ([-sample, 0.0], [0.0, sample]):
            settings += self._settings(look, np.add(ends, shift), values)[:1]
        left = self.local.left(settings).reshape(len(settings), -1)
        columns = (left[:1] - left[1:]).T
        size = np.linalg.norm(columns, axis=0) + 1e-300
        inverse = np.linalg.pinv((columns / size).T @ (columns / size), rcond=1e-9)
        freedom = max(self.local.rows.sum() - columns.shape[1], 1)
        chi2 = float((left[0] ** 2).sum())
        error = np.sqrt(np.diag(inverse) * max(chi2 / freedom, 1.0)) / size
        half = np.zeros(len(values))
        half[look.which] = t_ppf(0.975, freedom) * error[:k] * look.steps
        return chi2, half

    def lasting(self, gain, curves, setting=None):
        """Whether what acts whenever the motion is like that gains half as much: a force that is
        predicted as far where it was not fitted, or another setting."""
        scene = self.scene
        some = [c for c in curves if "time" not in c.variables and c.share >= LASTING]
        every = [setting or {}] + [{**scene.setting, c.candidate: c.values} for c in some]
        for other in filter(None, every):
            column = scene.plain - scene.left([other])[0]
            if (column * scene.plain).sum() ** 2 > LASTING * gain * (column**2).sum() > 0:
                return True
        return False

    def others(self, event, looks, found, gain):
        """((candidate, values), ...) of what explains an event as well, best first."""
        inside, out = self.inside, []
        most = SAME * (event.left - self.chi2.sum() + self.around)
        for look in looks:
            amounts = solved(look.gram[inside].sum(0), look.score[inside].sum(0))
            if look is found or amounts @ look.score[inside].sum(0) < ALIKE * gain:
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
