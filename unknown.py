"""Is anything left, and on what does it depend? The residual force in each joint against position, velocity, control, time.

    found = leftover(search, fit, nominal_chi2)          # None, or a Leftover
    found.candidate(world)                               # the `unknown` effect that models it, or None

In short windows an extra joint force is nearly constant, and its column is that of a constant force. A force that is
some curve of a variable x has, in window w, the column curve(x_w) * (constant force); so all curves of all variables
are tested from one column per joint, with the start states and the named effects projected out.
"""

from dataclasses import dataclass

import numpy as np

import scores
import shooting
import windows as cut

LEVEL = 0.002  # false-alarm rate, shared between all joints and variables
SHARE = 0.25  # of the squared residual that a leftover must explain
KNOTS = 7


@dataclass
class Leftover:
    joint: str
    variables: tuple  # e.g. ("velocity:elbow",)
    knots: np.ndarray  # (k,) of the first variable
    force: np.ndarray  # (k,) at the knots
    p_value: float
    share: float  # of the squared residual explained
    simulable: bool  # a curve of one variable

    def candidate(self, world):
        return world.curve(self.joint, self.variables[0], self.knots) if self.simulable else None


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


def bases(model, v, joint):
    """[(variables, basis (W, k), knots, simulable)] of the curves to try for a force in a joint."""
    name = cut.joint_name(model, joint)
    q, d = v.position[:, model.jnt_qposadr[joint]], v.velocity[:, model.jnt_dofadr[joint]]
    out = []
    for label, x in ((f"position:{name}", q), (f"velocity:{name}", d)):
        knots = spread_knots(x, KNOTS)
        if len(knots) > 2:
            out.append(((label,), hats(x, knots), knots, True))
    knots = spread_knots(q, 6)
    if len(knots) > 2:
        out.append(((f"position:{name}", f"velocity:{name}"), hats(q, knots) * np.sign(d)[:, None], knots, False))
    for a in range(model.nactuator if model.nu else 0):
        if model.actuator_trnid[a, 0] == joint and model.actuator_ctrlnum[a] == 1:
            u, label = v.control[:, model.actuator_ctrladr[a]], "control:" + (model.actuator(a).name or str(a))
            knots = spread_knots(u, 5)
            if len(knots) > 2:
                out.append(((label,), hats(u, knots), knots, True))
                knots = np.linspace(v.time.min(), v.time.max(), 4)
                out.append((("time", label), hats(v.time, knots) * u[:, None], knots, False))
    length = np.ptp(v.time)
    knots = np.linspace(v.time.min(), v.time.max(), KNOTS)
    out.append((("time",), hats(v.time, knots), knots, True))
    for frequency in np.arange(1.0, 0.7 * length / v.span, 0.5) / length:
        phase = 2 * np.pi * frequency * v.time
        out.append((("time",), np.stack([np.sin(phase), np.cos(phase)], 1), frequency, True))
    return out


def leftover(search, problem, fit, least):
    """The curve that explains most of what a fit leaves, or None.

    problem, fit: short windows all over the data, and a fit to them; least: squared residual that a leftover must
    explain at least, in the units of fit.chi2.
    """
    world, model = search.world, search.model
    pushes = [c for c in world.candidates if c.effect.name == "spring_offset"]
    if not pushes:
        return None
    settings, moves = shooting.perturbed(fit.hypothesis)
    nominal = fit.hypothesis.settings
    tried = []
    for c in pushes:
        before = nominal.get(c, c.nominal)
        tried.append({**nominal, c: (before[0] + c.parameters[0].step,)})
    slope = shooting.columns(problem, [fit], [settings + tried])[0]
    scan = shooting.project(problem, fit, slope)
    labels, chi2, own = scores.clusters(problem.windows), scan.chi2.sum(), len(settings)
    v, out, tests = Variables(problem), [], 0
    for i, c in enumerate(pushes):
        column = own + i
        if scan.gram[:, column, column].sum() < shooting.UNSEEN:
            continue
        joint = model.joint(c.place.name).id
        options = bases(model, v, joint)
        tests += len(options)
        for variables, basis, knots, simulable in options:
            k = basis.shape[1]
            pick = [*range(own), column]  # a constant force is no dependence: it is projected out with the named effects
            b = len(pick)
            gram = np.zeros((len(basis), b + k, b + k))
            gram[:, :b, :b] = scan.gram[:, pick][:, :, pick]
            gram[:, :b, b:] = scan.gram[:, pick, column][:, :, None] * basis[:, None, :]
            gram[:, b:, :b] = np.swapaxes(gram[:, :b, b:], 1, 2)
            gram[:, b:, b:] = scan.gram[:, column, column, None, None] * basis[:, :, None] * basis[:, None, :]
            score = np.concatenate([scan.score[:, pick], scan.score[:, column, None] * basis], 1)
            gram, score = search.freed(scores.summed(labels, gram), scores.summed(labels, score), b)
            seen = np.einsum("ckk->k", gram) > shooting.UNSEEN
            if not seen.any():
                continue
            value, gain, p, held = scores.wald(gram[:, seen][:, :, seen], score[:, seen])
            force = np.zeros(k)
            force[seen] = value * c.parameters[0].step
            out.append((gain - 2 * k * chi2 / max(problem.rows, 1), gain, p, held.sum(), c.place.name, variables, knots, force, simulable))
    good = [o for o in out if o[2] * tests < LEVEL and o[3] > 0 and o[1] > max(SHARE * chi2, least)]
    if not good:
        return None
    best = max(good, key=lambda o: o[0])
    simple = [o for o in good if o[8] and o[0] > 0.85 * best[0]]
    _, gain, p, _, joint, variables, knots, force, simulable = max(simple, key=lambda o: o[0]) if simple else best
    if np.ndim(knots) == 0:  # a frequency: the sine at knots
        frequency, knots = knots, np.arange(v.time.min(), v.time.max() + 0.1 / knots, 0.1 / knots)
        force = np.stack([np.sin(2 * np.pi * frequency * knots), np.cos(2 * np.pi * frequency * knots)], 1) @ force
    return Leftover(joint, variables, np.asarray(knots, float), force, min(1.0, p * tests), float(gain / chi2), simulable)
