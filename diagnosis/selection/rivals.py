"""The name of what was found: the simplest of all that can stand in an effect's place, and what else is possible.

fit, possible = settle(search, fit)                      # of a selection.Search and its fit
others, pair = alternatives(search, fit, small, candidate)
"""

import numpy as np

from diagnosis.estimation import cluster_scores, initial_states, multiple_shooting
from diagnosis.selection.candidates import WORTH
from diagnosis.selection.search import ALPHA, same_unit, simplicity

# in squared residual: of an effect one level less simple; up to which few windows do not decide between two
ODDS, DOUBT = 2.0, 8.0
SHARE = 0.05  # of what several effects explain together, that one in their place may leave
LESS = 0.03  # share of an effect, from whose absence that of the whole is extrapolated


def settle(search, fit, but=()):
    """Name every effect by the best that can stand in its place, the simplest where several do as well.

    Returns (fit, {candidate: [(error ratio, candidate, values), ...]}): what else is possible, best first.
    """
    fit, possible = fit if but else united(search, fit), {}
    for candidate in fit.hypothesis.candidates:
        if candidate in but:
            continue
        small = fit.subset(search.few)
        others, pair = alternatives(search, fit, small, candidate)
        if pair is not None:
            [new] = multiple_shooting.solve(search.problem, [pair], fit, iterations=5)
            added = [c for c in pair.candidates if c not in fit.hypothesis.candidates]
            if (
                new.chi2.sum() < (1 - 2 * WORTH) * fit.chi2.sum()
                and max(search.significance(new, c)[0] for c in added) < ALPHA / search.places
            ):
                fit = new
                possible.update({c: [] for c in added})
                continue
        near = lambda f, c: (
            simplicity(c)[:2] < simplicity(candidate)[:2]
            and f.chi2.sum() < (1 + WORTH) * small.chi2.sum()
        )
        equals = [(small, candidate)] + [
            (f, c) for f, c in others if near(f, c) or not worse(search, f, small)
        ]
        first = min(simplicity(c)[:2] for _, c in equals)
        best, name = likeliest(search, fit, [e for e in equals if simplicity(e[1])[:2] == first])
        better = [
            e
            for e in equals
            if worse(search, small, e[0]) and e[0].chi2.sum() < (1 - WORTH) * small.chi2.sum()
        ]
        if better:
            best, name = min(better, key=lambda e: e[0].chi2.sum())
        if name != candidate:
            [new] = multiple_shooting.solve(search.problem, [best.hypothesis], fit, iterations=5)
            if new.chi2.sum() < (1 + WORTH) * fit.chi2.sum():
                others = [(small, candidate)] + [o for o in others if o[1] != name]
                fit, candidate = new, name
                small = fit.subset(search.few)
        ratio = lambda f: float(np.sqrt(f.chi2.sum() / small.chi2.sum()))
        listed = [(ratio(f), c, f.hypothesis.settings[c]) for f, c in others]
        possible[candidate] = sorted(listed, key=lambda o: (round(o[0], 2), simplicity(o[1])))
    return fit, possible


def united(search, fit, most=3):
    """The fit, or one with a single effect where several at one joint, its body or motor together only looked like it, and what
    else then is needed."""
    for joint in range(search.model.njnt):
        near = lambda candidate: joint in (search.world.joints(candidate.place) or ())
        several = [c for c in fit.hypothesis.candidates if near(c)]
        if len(several) < 2:
            continue
        rest, small = fit.hypothesis.minus(*several), fit.subset(search.few)
        fewer = lambda candidate: (
            len(candidate.parameters) < sum(len(c.parameters) for c in several)
        )
        tried = [
            rest.plus(o.candidate, o.directions[0])
            for o in search.options
            if near(o.candidate) and o.candidate not in several and fewer(o.candidate)
        ]
        start = {}
        for i in np.argsort(search.left(fit, tried)):
            start.setdefault(tried[i].candidates[-1], tried[i])
        best = sorted(
            multiple_shooting.solve(
                search.scouting, list(start.values()), fit.subset(search.scouts), iterations=3
            ),
            key=lambda f: f.chi2.sum(),
        )
        bare, *fits = multiple_shooting.solve(
            search.small, [rest] + [f.hypothesis for f in best[:most]], small, iterations=4
        )
        one = min(
            (f for f in fits if f.hypothesis.possible), key=lambda f: f.chi2.sum(), default=bare
        )
        if one.chi2.sum() < small.chi2.sum() + SHARE * (bare.chi2.sum() - small.chi2.sum()):
            [new] = multiple_shooting.solve(search.problem, [one.hypothesis], fit, iterations=4)
            new = search.run(new)
            if new.chi2.sum() < (1 + WORTH) * fit.chi2.sum():
                fit = new
    return fit


def likeliest(search, fit, rivals, most=3):
    """The likeliest of rivals [(Fit on few windows, candidate)] of equally many parameters, refitted to all windows."""
    scale = (
        fit.chi2.sum() / search.freedom
    )  # what a squared residual is worth, whatever the noise was thought to be
    odds = lambda fits, among: [
        f.chi2.sum() / scale + ODDS * c.effect.simplicity + wide(search, c)
        for f, (_, c) in zip(fits, among)
    ]
    few = odds([f for f, _ in rivals], rivals)
    rivals = [rivals[i] for i in np.argsort(few, kind="stable")[:most] if few[i] < min(few) + DOUBT]
    if len(rivals) == 1:
        return rivals[0]
    fits = multiple_shooting.solve(
        search.problem, [f.hypothesis for f, _ in rivals], fit, iterations=3
    )
    return rivals[int(np.argmin(np.round(odds(fits, rivals), 1)))]


def wide(search, candidate):
    """1 at a geom of the world, which many others may touch, else 0: the same at what touches it says less."""
    return int(
        candidate.place.kind == "geom"
        and search.model.geom_bodyid[search.model.geom(candidate.place.name).id] == 0
    )


def worse(search, one, other):
    """Whether a fit's squared residual (few windows) lies above another's beyond its scatter between clusters."""
    gap = cluster_scores.summed(search.few_labels, pieced(search, one) - pieced(search, other))
    scatter = (
        cluster_scores.t_quantile(max(len(gap) - 1, 1))
        * np.sqrt(len(gap))
        * gap.std(ddof=1 if len(gap) > 1 else 0)
    )
    return gap.sum() > max(scatter, 1e-3 * other.chi2.sum())


def pieced(search, fit):
    """Squared residual of a fit's windows in pieces, (W * pieces,)."""
    rows, width = search.problem.weight.shape[1:]
    square = (fit.residual[:, : rows * width] ** 2).reshape(-1, rows, width).sum(-1)
    owner = np.arange(rows) * search.pieces // rows
    return np.stack([square[:, owner == i].sum(1) for i in range(search.pieces)], 1).ravel()


def alternatives(search, fit, small, candidate, most=6):
    """What can stand in a candidate's place, on few windows: [(Fit, other candidate)], and a promising pair or None.

    small: the fit's part on few windows.

    To first order: the residual that the effect's absence would leave, explained by the columns of others.
    """
    values = small.hypothesis.settings[candidate]
    without = small.hypothesis.minus(candidate)
    own = [{**s, candidate: values} for s in multiple_shooting.perturbed(without)[0]]
    akin = set(search.world.related(candidate))
    options = [
        o
        for o in search.options
        if o.candidate not in small.hypothesis.candidates
        and (o.linear or o in search.kept or o.candidate in akin)
    ]
    # absence is extrapolated from a little less, unless the effect is a limit: unstable motion is soon not linear
    nominal, less = np.array(candidate.nominal), without.settings
    finite = np.isfinite(nominal).all()
    if finite:
        less = without.plus(candidate, nominal + (1 - LESS) * (np.array(values) - nominal)).settings
    known = {o: columns[search.few] for o, (at, columns) in search.looked.items() if at is fit}
    slope = search.stacked(search.small, small, own + [less], options, known)
    slope[..., len(own)] *= 1 / LESS if finite else 1.0
    scan = multiple_shooting.project(search.small, small, slope)
    gram, k = scan.gram.sum(0), len(own)
    score = scan.score.sum(0) - gram[:, k]  # of the residual without the effect
    bare = scan.chi2.sum() - 2 * scan.score[:, k].sum() + gram[k, k]
    base = list(range(k))

    def left(columns):
        """Squared residual once these columns and the other effects' have explained what they can; their amounts."""
        columns = [c for c in base + columns if gram[c, c] > multiple_shooting.UNSEEN]
        amount = cluster_scores.solve_small(gram[np.ix_(columns, columns)], score[columns])
        return bare - score[columns] @ amount, dict(zip(columns, amount))

    singles, at, alone = [], k + 1, left([])[0]
    for option in options:
        columns = list(range(at, at + len(option.directions)))
        at += len(columns)
        chi2, amount = left(columns)
        start = search.start_of(option, columns, columns, [amount.get(c, 0.0) for c in columns])
        if start is not None:
            singles.append((chi2, option, columns, start))
    singles.sort(key=lambda s: s[0])
    now = scan.chi2.sum()
    hypotheses, same, seen = [], [], set()
    for chi2, option, _, start in singles:
        stands = len(seen) < 2 * most and alone - chi2 > 0.5 * (alone - now)
        if option.candidate not in seen and (stands or option.candidate in akin):
            hypotheses.append(without.plus(option.candidate, start))
            same.append(chi2 < now + max(LESS * (alone - now), WORTH * now))
            seen.add(option.candidate)
    for option in options:  # of a contact's two geoms, or a joint's two frictions, one hides the other's part: columns say nothing
        other, n = option.candidate, len(option.candidate.parameters)
        twin = other.effect is candidate.effect and candidate.place.kind == "geom"
        if option.linear and (twin or n == 1 and other in akin and same_unit(candidate, other)):
            start = np.clip(
                values[:n], [p.low for p in other.parameters], [p.high for p in other.parameters]
            )
            hypotheses.append(without.plus(other, start))
            same.append(False)
    # a first look at full size, where what is alike in a small step may differ, and the other way round
    looks = [
        multiple_shooting.project(search.small, f, np.zeros(f.residual.shape + (0,))).chi2.sum()
        for f in initial_states.evaluate(search.small, hypotheses, small)
    ]
    order = sorted(range(len(looks)), key=looks.__getitem__)[:most]
    order = [i for i in order if same[i] or looks[i] < now + 0.5 * (alone - now)]
    if search.leaves_much(
        fit
    ):  # where no model reaches the noise, related ones may predict as well
        order += [
            i for i in range(len(looks)) if i not in order and hypotheses[i].candidates[-1] in akin
        ]
    hypotheses = [hypotheses[i] for i in order]
    pair = None
    pairs = [
        (left(a[2] + b[2])[0], a, b)
        for i, a in enumerate(singles[:8])
        for b in singles[i + 1 : 8]
        if a[1].candidate != b[1].candidate
    ]
    if pairs:
        chi2, a, b = min(pairs, key=lambda p: p[0])
        if chi2 < (1 - 2 * WORTH) * now:
            amount = left(a[2] + b[2])[1]
            begun = [
                search.start_of(o, c, c, [amount.get(i, 0.0) for i in c]) for _, o, c, _ in (a, b)
            ]
            if None not in begun:
                pair = without.plus(a[1].candidate, begun[0]).plus(b[1].candidate, begun[1])
    fits = multiple_shooting.solve(
        search.small, hypotheses + ([pair] if pair else []), small, iterations=4
    )
    if pair:
        last = fits.pop()
        pair = last.hypothesis if last.chi2.sum() < (1 - 2 * WORTH) * small.chi2.sum() else None
    best = {}
    for f in sorted((f for f in fits if f.hypothesis.possible), key=lambda f: f.chi2.sum()):
        best.setdefault(f.hypothesis.candidates[-1], f)
    return [(f, c) for c, f in best.items()], pair
