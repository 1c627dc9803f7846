"""What could stand in a finding's place: effects whose refits predict as well, told as a class, the
best for its price first.

fitted, others = classes(candidates, judge, missing, fitted, begun)
others[candidate]                                    # [(other, values), ...]

earlier = carried(judge, sets, now, best)            # sets of the round before, judged in this one
sets = as_good(judged + earlier, best)
others = together(others, fitted, sets)
"""

import numpy as np

from diagnosis.effects.unmodelled import Unknown
from diagnosis.selection import moments
from diagnosis.selection.beam import likely
from diagnosis.selection.columns import Columns
from diagnosis.selection.criterion import Evidence, complexity, paired
from diagnosis.selection.judge import problem
from diagnosis.selection.missing_force import MissingForce
from diagnosis.selection.starts import Starts

APART = 0.3  # share of an effect that another may leave in its place, as far as columns tell
TIED = 0.1  # nats of log RMS error by which another member of a class may be worse
CHANCE = 0.05  # p-value of that, above which it may be worse by any
# how much more complex another member of a class may be: three components for one number
FURTHER = 2.5
REFITS, MOST = 4, 3  # others that are refitted, and told
SETS = 3  # of other effects, that are carried from round to round


def classes(candidates, judge, missing, fitted, begun, asked=None, log=lambda what: None):
    """(Fitted, {candidate: [(other, values)]}): each finding by the best member of its class, for
    its price, and the other members. Among equals the finding stays. missing: a MissingForce along
    the motion; begun(setting): a Judge whose windows begin at the motion that is located under a
    setting; asked: the findings whose class is asked, all by default. A finer time step is no
    physics, so nothing is asked for in its place."""
    others, swapped, held = {}, False, None
    for candidate in fitted.setting if asked is None else asked:
        if candidate not in fitted.setting or candidate.effect.numerical:
            continue
        if held is None or held.setting != fitted.setting:
            held = _along(missing.chain, judge, fitted.setting)
        members = _members(candidates, judge, missing, fitted, candidate, held)
        units, most = complexity(fitted.setting), fitted.loss - TIED
        better = [m for m in members if m[0].loss < most or complexity(m[0].setting) < units]
        members.append((fitted, candidate))
        fitted, own = min([(fitted, candidate), *better], key=lambda member: member[0].loss)
        if own is not candidate:
            log(f"  better in its class: {candidate} -> {own}")
            swapped = True
        tied = [(f, o) for f, o in members if _tied(f.score, fitted.score)]
        others[own] = [(o, f.setting[o]) for f, o in tied if o is not own]
        told = {o for o, _ in others[own]}
        pool = [c for c in candidates if c not in told and c not in fitted.setting]
        others[own] += _late(pool, begun, missing.chain.world, fitted, own)
    others = {c: each[:MOST] for c, each in others.items() if c in fitted.setting}
    return (judge.fit(fitted.setting, steps=2) if swapped else fitted), others


def as_good(judged, best):
    """The Fitted sets, of several that were judged, that predict as well as the best one with other
    effects; the best SETS of them."""
    some = [f for f in judged if f.settled and _tied(f.score, best.score) and _instead(f, best)]
    each = {}
    for fitted in sorted(some, key=lambda f: f.loss):
        each.setdefault(frozenset(fitted.setting), fitted)
    return list(each.values())[:SETS]


def carried(judge, sets, now, best):
    """Fitted sets of an earlier round, judged in this one: as they are, and with what the best set
    has more than there was."""
    new = {c: v for c, v in best.setting.items() if c not in now.setting}
    tries = [f.setting for f in sets]
    tries += [{**new, **f.setting} for f in sets if new.keys() - f.setting.keys()]
    return [judge.fit(setting, steps=3, near=best) for setting in tries]


def together(others, fitted, sets):
    """The others {candidate: [(other, values)]} of a Fitted set's findings, with those of sets that
    predict as well."""
    out = dict(others)
    for rival in as_good(sets, fitted):
        new, gone = _instead(rival, fitted)
        for candidate in gone:
            told = {o for o, _ in out.get(candidate, [])}
            more = [(o, rival.setting[o]) for o in new if o not in told]
            out[candidate] = [*out.get(candidate, []), *more][:MOST]
    return out


def _instead(rival, fitted):
    """(effects of one Fitted set, those of another one that they stand for), or None: where one is
    part of the other, a round has compared them. A curve is no name that others could have, and
    much more complex ones are no equals."""
    beside = lambda a, b: [c for c in a if c not in b and not c.effect.numerical]
    new, gone = beside(rival.setting, fitted.setting), beside(fitted.setting, rival.setting)
    named = not any(isinstance(c.effect, Unknown) for c in new)
    alike = named and complexity(new) <= complexity(gone) + FURTHER
    return (new, gone) if alike and new and gone else None


def _along(chain, judge, setting):
    """Columns of a setting's effects about it, along a Chain."""
    starts = Starts(chain.world, setting, judge.usual, trajectory=chain.trajectory)
    return Columns(chain, setting, starts.of(setting))


def _members(candidates, judge, before, fitted, candidate, held):
    """[(Fitted, other)] of the effects that predict as well in a finding's place, or are better for
    their price, best first. held: Columns of the Fitted set."""
    rest = {c: v for c, v in fitted.setting.items() if c is not candidate}
    pool = [c for c in candidates if c not in fitted.setting]
    missing, out = MissingForce(before.chain, rest, before), []
    world, model = before.chain.world, before.chain.world.model
    if candidate.when:
        some = [c for c in world.candidates if not before.chain.apart(c) and c != candidate.lasting]
        pool += filter(None, (moments.placed(world, c, candidate.when) for c in some))
    # two geoms of one contact share its numbers, and columns tell little of them
    twin = candidate.effect.twin(model, candidate.effect.id(model, candidate.place.name))
    twins = [c for c in pool if (c.effect, c.place.name) == (candidate.effect, twin)]
    near = [(c, fitted.setting[candidate]) for c in twins]
    alike = _alike(judge, missing, candidate, pool, held)
    near += [(other, values) for other, values in alike if other not in twins]
    for other, values in near[:REFITS]:
        tried = judge.fit({**rest, other: values}, near=fitted)
        if tried.settled and (_tied(tried.score, fitted.score) or tried.loss < fitted.loss):
            out.append((tried, other))
    return sorted(out, key=lambda pair: pair[0].loss)


def _late(pool, begun, world, fitted, candidate):
    """[(other, values)] of a delay in the drive for one in the sensor, or the other way round, that
    predict as well: either begins at states of its own, for a late sensor shows others."""
    if not candidate.effect.delays:
        return []
    mine = world.joints(candidate.place) or set()
    near = [c for c in pool if c.effect.delays and c.effect is not candidate.effect]
    near = [c for c in near if mine & (world.joints(c.place) or set())]
    rest = {c: v for c, v in fitted.setting.items() if c is not candidate}
    out = []
    for other in near:
        held = {**rest, other: fitted.setting[candidate]}
        tried = begun(held).fit(held)
        if tried.settled and _tied(tried.score, fitted.score):
            out.append((other, tried.setting[other]))
    return out


def _tied(tried, fitted):
    """Whether a Score is as good as another one, or worse by no more than chance."""
    worse = paired(tried, fitted)
    return worse.gain < TIED or worse.p_value > CHANCE


def _alike(judge, missing, candidate, pool, held):
    """[(other, values)] of a pool that act where the candidate does, or everywhere, and predict
    about as well in its place as far as columns at the model without it tell, the best first, and
    of those that are as good the simplest. held: Columns of the set, which stand for those without
    the candidate."""
    chain, rest, units = missing.chain, missing.setting, complexity([candidate]) + FURTHER
    near = [c for c in pool if complexity([c]) <= units and meet(chain.world, c, candidate)]
    starts = Starts(chain.world, rest, judge.usual, trajectory=chain.trajectory)
    starts = starts.of([*near, *rest])
    columns = Columns(chain, rest, likely(missing, starts, alone=True), known=held)
    options, evidence = columns.options, columns.evidence(judge.reference)
    kept = [k for k, o in enumerate(options) if o.candidate in rest]
    gap = held.residual + APART * (columns.residual - held.residual)
    most = Evidence(chain, gap, columns.array, judge.reference).score(*problem(columns, kept)).loss
    out = {}
    for k in set(range(len(options))) - set(kept):
        other, width = options[k].candidate, len(options[k].columns)
        index, low, high, precision, pull = problem(columns, [*kept, k])
        low[-width:], high[-width:] = options[k].reach()  # its place is not the start's
        score = evidence.score(index, low, high, precision, pull)
        if score.loss < min(most, out.get(other, (np.inf,))[0]):
            out[other] = score.loss, options[k].values(score.amounts[-width:])
    tied = min((loss for loss, _ in out.values()), default=0.0) + TIED
    order = lambda c: (max(out[c][0], tied), complexity([c]), out[c][0])
    return [(c, out[c][1]) for c in sorted(out, key=order)]


def meet(world, candidate, other):
    """Whether two candidates act at one joint, or either of them everywhere."""
    mine, theirs = world.moved_by(candidate.place), world.moved_by(other.place)
    return mine is None or theirs is None or bool(mine & theirs)
