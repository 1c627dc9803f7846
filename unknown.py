"""Is anything left, and on what does it depend? The residual force in each joint against position, velocity, control, time.

    found = leftover(search, problem, fit, bare)         # None, or a Leftover
    found.candidate                                      # the `unknown` effect that models it

Curves of one variable are simulated, one column per knot. For the rest: in short windows an extra joint force is nearly
constant, so a force that is some function of x has, in window w, the column function(x_w) * (constant force). The start
states, the named effects and a constant force are projected out: what is left is dependence.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

import scores
import shooting
import windows as cut
from scan import WORTH, freedom

LEVEL = 0.002  # false-alarm rate, shared between all joints and variables
SHARE, NOTABLE = 0.25, 0.05  # of the squared residual above the noise, and of the nominal model's, that a large leftover explains
LOUD = 4.0  # squared residual of a window over the usual one
CLUSTERS = 60  # of windows, at most
KNOTS = 11  # of the curves that are tried, and of those with every other knot
QUIET = 1.15  # squared residual over that of noise alone, up to which nothing large can be left


@dataclass
class Leftover:
    joint: str
    variables: tuple  # e.g. ("velocity:elbow",)
    candidate: object  # the `unknown` effect that models it
    p_value: float
    share: float  # of the squared residual explained
    large: bool  # worth a finding of its own


def hats(x, knots):
    """Linear-interpolation weights (W, k) of x at knots, flat beyond the ends."""
    return np.stack([np.interp(x, knots, row) for row in np.eye(len(knots))], 1)


def spread_knots(x, number):
    """Distinct knots at quantiles of x, (k,)."""
    knots = np.unique(np.quantile(x, np.linspace(0.02, 0.98, number)))
    keep = [0]
    for i in range(1, len(knots)):
        if knots[i] - knots[keep[-1]] > 0.02 * np.ptp(knots):
            keep.append(i)
    return knots[keep]


class Variables:
    """Window averages of what a force may depend on."""

    def __init__(self, problem):
        model = problem.model
        known = {id(w.recording): cut.states(model, w.recording) for w in problem.windows}
        rows = [(known[id(w.recording)], w) for w in problem.windows]
        self.position = np.array([s[0][w.first:w.last + 1].mean(0) for s, w in rows])
        step = np.array([cut.difference(model, s[0][w.first], s[0][w.last]) for s, w in rows])
        self.time = np.array([0.5 * (w.recording.time[w.first] + w.recording.time[w.last]) for w in problem.windows])
        span = np.array([w.recording.time[w.last] - w.recording.time[w.first] for w in problem.windows])
        self.velocity = step / span[:, None]
        self.control = np.array([w.recording.ctrl[w.first:max(w.last, w.first + 1)].mean(0) for w in problem.windows])
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
    known = [cut.states(model, r) for r in {id(w.recording): w.recording for w in problem.windows}.values()]
    seen = {f"position:{name}": np.concatenate([s[0][:, model.jnt_qposadr[joint]] for s in known]),
            f"velocity:{name}": np.concatenate([s[1][:, model.jnt_dofadr[joint]] for s in known])}
    seen |= {label: u for label, u in controls(model, v, joint)}
    out = [world.curve(name, label, knots) for label, x in seen.items() if len(knots := spread_knots(x, KNOTS)) > 2]
    here = v.position[few, model.jnt_qposadr[joint]]
    if few.any() and np.ptp(here) < 0.3 * np.ptp(v.position[:, model.jnt_qposadr[joint]]):
        knots = spread_knots(here, KNOTS // 2)
        knots = [knots[0] - 0.5 * np.ptp(knots), *knots, knots[-1] + 0.5 * np.ptp(knots)]
        out += [world.curve(name, f"position:{name}", knots, factor=f) for f in (None, f"velocity:{name}")]
    return out


def coarser(world, curve):
    """(a curve, weights (k, n) of its n knots' forces in the given curve's k) of the curve itself and of one with every other knot."""
    knots, effect = np.array(curve.effect.knots), curve.effect
    some = np.unique([*knots[::2], knots[-1]])
    less = world.curve(curve.place.name, effect.variable, some, effect.factor)
    return [(curve, np.eye(len(knots)))] + ([(less, hats(knots, some))] if len(some) > 2 else [])


def controls(model, v, joint):
    """[(variable, (W,) window averages)] of the single controls that act on a joint."""
    return [("control:" + (model.actuator(a).name or str(a)), v.control[:, model.actuator_ctrladr[a]])
            for a in range(model.nactuator if model.nu else 0)
            if model.actuator_trntype[a] in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
            and model.actuator_trnid[a, 0] == joint and model.actuator_ctrlnum[a] == 1]


def bases(world, v, joint):
    """[(variables, basis (W, k), candidate)] of what else to try for a force in a joint, by windows."""
    model, name, out = world.model, cut.joint_name(world.model, joint), []
    q, d = v.position[:, model.jnt_qposadr[joint]], v.velocity[:, model.jnt_dofadr[joint]]
    here, moving = f"position:{name}", f"velocity:{name}"
    knots = spread_knots(q, 6)
    if len(knots) > 2:
        out.append(((here, moving), hats(q, knots) * np.sign(d)[:, None], world.curve(name, here, knots, factor=moving)))
    knots = np.linspace(v.time.min(), v.time.max(), 4)
    for label, u in controls(model, v, joint):
        out.append((("time", label), hats(v.time, knots) * u[:, None], world.curve(name, "time", knots, factor=label)))
    knots = np.linspace(v.time.min(), v.time.max(), 7)
    out.append((("time",), hats(v.time, knots), world.curve(name, "time", knots)))
    length = np.ptp(v.time)
    for hertz in np.arange(1.0, 0.7 * length / v.span, 0.5) / length:
        phase = 2 * np.pi * hertz * v.time
        out.append((("time",), np.stack([np.cos(phase), np.sin(phase)], 1), world.curve(name, "time", (0.0, 0.25 / hertz), wave=True)))
    return out


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
    nominal, own, v = fit.hypothesis.settings, shooting.perturbed(fit.hypothesis)[0], Variables(problem)
    tried, where = [{**nominal, c: (nominal.get(c, c.nominal)[0] + c.parameters[0].step,)} for c in pushes], []
    for c in pushes:
        mine = []
        for curve in curves(world, problem, v, model.joint(c.place.name).id, loud(fit, problem)):
            steps = c.parameters[0].step * np.eye(len(curve.effect.knots))
            mine.append((curve, range(len(own) + len(tried), len(own) + len(tried) + len(steps))))
            tried += [{**nominal, curve: tuple(row)} for row in steps]
        where.append(mine)
    scan = shooting.project(problem, fit, shooting.columns(problem, [fit], [own + tried])[0])
    labels, out, tests = scores.clusters(problem.windows, CLUSTERS), [], 0
    for i, (c, mine) in enumerate(zip(pushes, where)):
        column = len(own) + i
        if scan.gram[:, column, column].sum() < shooting.UNSEEN:
            continue
        base = [*range(len(own)), column]
        options = [(tuple(filter(None, (curve.effect.variable, curve.effect.factor))), mixed(scan, base, columns, weights), curve)
                   for finest, columns in mine for curve, weights in coarser(world, finest)]
        options += [(variables, spread(scan, base, column, basis), curve)
                    for variables, basis, curve in bases(world, v, model.joint(c.place.name).id)]
        tests += len(options)
        for variables, (gram, score), curve in options:
            gram, score = search.freed(scores.summed(labels, gram), scores.summed(labels, score), len(base))
            seen = np.einsum("ckk->k", gram) > shooting.UNSEEN
            seen[0] &= bool(curve.effect.factor or curve.effect.wave)  # hats sum to a constant, which is projected out
            if seen.any():
                _, gain, p, held = scores.wald(gram[:, seen][:, :, seen], score[:, seen])
                worth = gain - 2 * seen.sum() * chi2 / max(problem.rows, 1)
                out.append((worth, gain, p, held.sum(), c.place.name, variables, curve))
    good = [o for o in out if o[2] * tests < LEVEL and o[3] > 0]
    if not good:
        return None
    best = max(good, key=lambda o: o[0])
    simple = [o for o in good if len(o[5]) == 1 and o[0] > 0.85 * best[0]]
    _, gain, p, _, joint, variables, curve = max(simple, key=lambda o: o[0]) if simple else best
    large = gain > max(SHARE * (chi2 - free), WORTH * chi2, NOTABLE * (bare - free))
    return Leftover(joint, variables, curve, min(1.0, p * tests), float(gain / chi2), bool(large))


def mixed(scan, base, columns, weights):
    """Per window: gram and score of sums of some columns of a scan, by weights (columns, k), behind those of base."""
    pick, mix = [*base, *columns], np.eye(len(base) + len(columns), len(base) + weights.shape[1])
    mix[len(base):, len(base):] = weights
    return mix.T @ scan.gram[:, pick][:, :, pick] @ mix, scan.score[:, pick] @ mix


def spread(scan, base, column, basis):
    """Per window: gram and score of basis (W, k) times one column, behind the columns of base."""
    b, k = len(base), basis.shape[1]
    gram = np.zeros((len(basis), b + k, b + k))
    gram[:, :b, :b] = scan.gram[:, base][:, :, base]
    gram[:, :b, b:] = scan.gram[:, base, column][:, :, None] * basis[:, None, :]
    gram[:, b:, :b] = np.swapaxes(gram[:, :b, b:], 1, 2)
    gram[:, b:, b:] = scan.gram[:, column, column, None, None] * basis[:, :, None] * basis[:, None, :]
    return gram, np.concatenate([scan.score[:, base], scan.score[:, column, None] * basis], 1)
