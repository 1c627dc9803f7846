"""Is anything left, and on what does it depend? The residual force in each joint against position, velocity, control, time.

    found = leftover(search, problem, fit, bare)         # None, or a Leftover
    found.candidate                                      # the `unknown` effect that models it

Curves of one variable are simulated, one column per knot. For the rest: in short windows an extra joint force is nearly
constant, so a force that is some function of x has, in window w, the column function(x_w) * (constant force). The start
states, the named effects and a constant force are projected out: what is left is dependence.
"""

from dataclasses import dataclass

import numpy as np

from diagnosis.effects.base import JOINT_TRANSMISSIONS
from diagnosis.estimation import cluster_scores, multiple_shooting
from diagnosis.estimation import windows as cut
from diagnosis.selection.candidates import WORTH, freedom

LEVEL = 0.002  # false-alarm rate, shared between all joints and variables
SHARE, NOTABLE = (
    0.25,
    0.05,
)  # of the squared residual above the noise, and of the nominal model's, that a large leftover explains
LOUD = 4.0  # squared residual of a window over the usual one
CLUSTERS = 60  # of windows, at most
KNOTS = 11  # of the curves that are tried, and of those with every other knot
TURN, HALVINGS = (
    0.5,
    5,
)  # steps of the frequencies that are tried, in turns over a recording; of that step, for the best
KNOT = 0.01  # relative fall of the squared residual that a knot more must bring
TAIL = 0.002  # share of what is recorded, beyond the knots at either end
QUIET = 1.15  # squared residual over that of noise alone, up to which nothing large can be left


@dataclass
class Leftover:
    candidate: object  # the `unknown` effect that models it
    p_value: float
    share: float  # of the squared residual explained
    large: bool  # worth a finding of its own

    @property
    def joint(self):
        return self.candidate.place.name

    @property
    def variables(self):
        """What it depends on: ("velocity:elbow",), or two."""
        return dependence(self.candidate)


def dependence(curve):
    """What a curve depends on: its variable, and its factor if it has one."""
    return tuple(filter(None, (curve.effect.variable, curve.effect.factor)))


def hats(x, knots):
    """Linear-interpolation weights (W, k) of x at knots, flat beyond the ends."""
    return np.stack([np.interp(x, knots, row) for row in np.eye(len(knots))], 1)


def spread_knots(x, number):
    """Distinct knots at quantiles of x, (k,), the outer ones where hardly anything lies beyond."""
    knots = np.unique(np.quantile(x, [TAIL, *np.linspace(0.02, 0.98, number)[1:-1], 1 - TAIL]))
    keep = [0]
    for i in range(1, len(knots)):
        if knots[i] - knots[keep[-1]] > 0.02 * np.ptp(knots):
            keep.append(i)
    return knots[keep]


class Variables:
    """Window averages of what a force may depend on."""

    def __init__(self, problem):
        model = problem.model
        known = {r: cut.states(model, r) for r in cut.recordings_of(problem.windows)}
        rows = [(known[w.recording], w) for w in problem.windows]
        self.position = np.array([s[0][w.first : w.last + 1].mean(0) for s, w in rows])
        step = np.array([cut.difference(model, s[0][w.first], s[0][w.last]) for s, w in rows])
        self.time = np.array(
            [0.5 * (w.recording.time[w.first] + w.recording.time[w.last]) for w in problem.windows]
        )
        span = np.array(
            [w.recording.time[w.last] - w.recording.time[w.first] for w in problem.windows]
        )
        self.velocity = step / span[:, None]
        self.control = np.array(
            [w.recording.ctrl[w.first : max(w.last, w.first + 1)].mean(0) for w in problem.windows]
        )
        self.span = float(np.median(span))


def loud(fit, problem):
    """Which windows (W,) hold most of what is left, if these are few; else none."""
    each = fit.chi2 / np.maximum((problem.weight > 0).sum((1, 2)), 1)
    out = each > LOUD * max(np.median(each), 1.0)
    return out if 3 < out.sum() < 0.5 * len(out) else np.zeros(len(out), bool)


def curves(world, problem, v, joint, few):
    """Candidates of forces in a joint that are a curve of its position, its velocity or a control of its own.

    few (W,): windows in which most is left; one that acts only where they lie has its knots there.
    """
    model, name = problem.model, cut.joint_name(problem.model, joint)
    known = [cut.states(model, r) for r in cut.recordings_of(problem.windows)]
    seen = {
        f"position:{name}": np.concatenate([s[0][:, model.jnt_qposadr[joint]] for s in known]),
        f"velocity:{name}": np.concatenate([s[1][:, model.jnt_dofadr[joint]] for s in known]),
    }
    seen |= {
        control(model, a): v.control[:, model.actuator_ctrladr[a]] for a in drives(model, joint)
    }
    out = [
        world.curve(name, label, knots)
        for label, x in seen.items()
        if len(knots := spread_knots(x, KNOTS)) > 2
    ]
    knots = np.linspace(v.time.min(), v.time.max(), 4)
    out += [
        world.curve(name, "time", knots, factor=control(model, a)) for a in drives(model, joint)
    ]
    here = v.position[few, model.jnt_qposadr[joint]]
    if few.any() and 0 < np.ptp(here) < 0.3 * np.ptp(v.position[:, model.jnt_qposadr[joint]]):
        knots = spread_knots(here, KNOTS // 2)
        knots = [knots[0] - 0.5 * np.ptp(knots), *knots, knots[-1] + 0.5 * np.ptp(knots)]
        out += [
            world.curve(name, f"position:{name}", knots, factor=f)
            for f in (None, f"velocity:{name}")
        ]
    return out


def coarser(world, curve):
    """(a curve, weights (k, n) of its n knots' forces in the given curve's k) of the curve itself, of one with every other knot,
    and of those with a bend at one of them."""
    knots, effect = np.array(curve.effect.knots), curve.effect
    fewer = [np.unique([*knots[::2], knots[-1]])] + [
        knots[[0, k, -1]] for k in range(1, len(knots) - 1)
    ]
    less = {
        tuple(some): world.curve(curve.place.name, effect.variable, some, effect.factor)
        for some in fewer
        if 2 < len(some) < len(knots)
    }
    return [(curve, np.eye(len(knots)))] + [
        (other, hats(knots, some)) for some, other in less.items()
    ]


def drives(model, joint):
    """Ids of the actuators of one control that act on a joint."""
    return [
        a
        for a in range(model.nactuator if model.nu else 0)
        if model.actuator_trntype[a] in JOINT_TRANSMISSIONS
        and model.actuator_trnid[a, 0] == joint
        and model.actuator_ctrlnum[a] == 1
    ]


def control(model, a):
    return "control:" + (model.actuator(a).name or str(a))


def bases(world, v, joint):
    """[(basis (W, k), candidate)] of what else to try for a force in a joint, by windows."""
    model, name, out = world.model, cut.joint_name(world.model, joint), []
    q, d = v.position[:, model.jnt_qposadr[joint]], v.velocity[:, model.jnt_dofadr[joint]]
    knots = spread_knots(q, 6)
    if len(knots) > 2:
        out.append(
            (
                hats(q, knots) * np.sign(d)[:, None],
                world.curve(name, f"position:{name}", knots, factor=f"velocity:{name}"),
            )
        )
    knots = np.linspace(v.time.min(), v.time.max(), 7)
    out.append((hats(v.time, knots), world.curve(name, "time", knots)))
    turns = np.ptp(v.time)
    return out + waves(world, v, name, np.arange(1.0, 0.7 * turns / v.span, TURN) / turns)


def waves(world, v, name, hertz):
    """As bases, for sines of time of some frequencies (n,)."""
    phases = 2 * np.pi * hertz[:, None] * v.time
    return [
        (
            np.stack([np.cos(phase), np.sin(phase)], 1),
            world.curve(name, "time", (0.0, 0.25 / f), wave=True),
        )
        for f, phase in zip(hertz, phases)
    ]


def quiet(problem, fit):
    """Whether nothing large can be left."""
    return fit.chi2.sum() < QUIET * freedom(problem)


def leftover(search, problem, fit, bare):
    """The dependence that explains most of what a fit leaves, if that is significant; else None.

    problem, fit: windows all over the data, and a fit to them; bare: the nominal model's squared residual.
    """
    world, model = search.world, search.model
    free, chi2 = freedom(problem), fit.chi2.sum()
    pushes = [c for c in world.candidates if c.effect.name == "spring_offset"]
    if not pushes:
        return None
    nominal, own, v = (
        fit.hypothesis.settings,
        multiple_shooting.perturbed(fit.hypothesis)[0],
        Variables(problem),
    )
    tried, where = (
        [{**nominal, c: (nominal.get(c, c.nominal)[0] + c.parameters[0].step,)} for c in pushes],
        [],
    )
    for c in pushes:
        mine = []
        for curve in curves(world, problem, v, model.joint(c.place.name).id, loud(fit, problem)):
            steps = c.parameters[0].step * np.eye(len(curve.effect.knots))
            mine.append((curve, range(len(own) + len(tried), len(own) + len(tried) + len(steps))))
            tried += [{**nominal, curve: tuple(row)} for row in steps]
        where.append(mine)
    scan = multiple_shooting.project(
        problem, fit, multiple_shooting.columns(problem, [fit], [own + tried])[0]
    )
    labels, out, tests = cluster_scores.clusters(problem.windows, CLUSTERS), [], 0
    for i, (c, mine) in enumerate(zip(pushes, where)):
        column = len(own) + i
        if scan.gram[:, column, column].sum() < multiple_shooting.UNSEEN:
            continue
        base = [*range(len(own)), column]
        options = [
            (*mixed(scan, base, columns, weights), curve)
            for finest, columns in mine
            for curve, weights in coarser(world, finest)
        ]
        options += [
            (*spread(scan, base, basis), curve)
            for basis, curve in bases(world, v, model.joint(c.place.name).id)
        ]
        tests += len(options)
        for gram, score, curve in options:
            gram, score = search.freed(
                cluster_scores.summed(labels, gram), cluster_scores.summed(labels, score), len(base)
            )
            seen = np.einsum("ckk->k", gram) > multiple_shooting.UNSEEN
            seen[0] &= bool(
                curve.effect.factor or curve.effect.wave
            )  # hats sum to a constant, which is projected out
            if seen.any():
                _, gain, p, held = cluster_scores.wald(gram[:, seen][:, :, seen], score[:, seen])
                worth = gain - 2 * seen.sum() * chi2 / max(problem.rows, 1)
                out.append((worth, gain, p, held.sum(), curve))
    good = [o for o in out if o[2] * tests < LEVEL and o[3] > 0]
    if not good:
        return None
    best = max(good, key=lambda o: o[0])
    simple = [o for o in good if not o[4].effect.factor and o[0] > 0.85 * best[0]]
    _, gain, p, _, curve = max(simple, key=lambda o: o[0]) if simple else best
    large = gain > max(SHARE * (chi2 - free), WORTH * chi2, NOTABLE * (bare - free))
    return Leftover(curve, min(1.0, p * tests), float(gain / chi2), bool(large))


def finer(problem, v, joint, curve, few):
    """Curves of the same dependence with more knots: everywhere, or on one side of the bend."""
    world, effect = problem.world, curve.effect
    every = [
        c for finest in curves(world, problem, v, joint, few) for c, _ in coarser(world, finest)
    ]
    more = [
        c
        for c in every
        if dependence(c) == dependence(curve) and len(c.parameters) > len(curve.parameters)
    ]
    if len(effect.knots) == 3:
        low, bend, high = effect.knots
        sides = [low, *np.linspace(bend, high, 4)], [*np.linspace(low, bend, 4), high]
        more += [
            world.curve(curve.place.name, effect.variable, side, effect.factor) for side in sides
        ]
    return more


def tuned(problem, fit, curve):
    """The same dependence with as many knots as pay, or, of a wave, with the frequency that leaves least, beside what a fit holds."""
    v, joint, leaves = (
        Variables(problem),
        problem.model.joint(curve.place.name).id,
        lambda f: f.chi2.sum(),
    )

    def solved(tried):
        return multiple_shooting.solve(
            problem, [fit.hypothesis.plus(c, c.nominal) for c in tried], fit, iterations=3
        )

    if not curve.effect.wave:
        tried = [curve, *finer(problem, v, joint, curve, loud(fit, problem))]
        left = [leaves(f) * (1 + KNOT * len(c.parameters)) for f, c in zip(solved(tried), tried)]
        return tried[int(np.argmin(left))]
    hertz, reach = 0.25 / curve.effect.knots[1], TURN / np.ptp(v.time)
    centres = [
        hertz,
        abs(1 / v.span - hertz),
        1 / v.span + hertz,
    ]  # which windows cannot tell apart
    for _ in range(HALVINGS):
        near = [f for centre in centres for f in centre + reach * np.linspace(-1, 1, 5) if f > 0]
        tried = [c for _, c in waves(problem.world, v, curve.place.name, np.array(near))]
        best = int(np.argmin([leaves(f) for f in solved(tried)]))
        curve, centres, reach = tried[best], [near[best]], reach / 2
    return curve


def mixed(scan, base, columns, weights):
    """Per window: gram and score of sums of some columns of a scan, by weights (columns, k), behind those of base."""
    pick, mix = [*base, *columns], np.eye(len(base) + len(columns), len(base) + weights.shape[1])
    mix[len(base) :, len(base) :] = weights
    return mix.T @ scan.gram[:, pick][:, :, pick] @ mix, scan.score[:, pick] @ mix


def spread(scan, base, basis):
    """Per window: gram and score of basis (W, k) times the last column of base, behind the columns of base."""
    column, b, k = base[-1], len(base), basis.shape[1]
    gram = np.zeros((len(basis), b + k, b + k))
    gram[:, :b, :b] = scan.gram[:, base][:, :, base]
    gram[:, :b, b:] = scan.gram[:, base, column][:, :, None] * basis[:, None, :]
    gram[:, b:, :b] = np.swapaxes(gram[:, :b, b:], 1, 2)
    gram[:, b:, b:] = (
        scan.gram[:, column, column, None, None] * basis[:, :, None] * basis[:, None, :]
    )
    return gram, np.concatenate([scan.score[:, base], scan.score[:, column, None] * basis], 1)
