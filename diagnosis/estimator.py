"""The diagnosis in its four verbs: locate, name, model, show.

    diagnosis = identify(world, train, held_out)     # a World, lists of Recording
    diagnosis.summary["findings"]; diagnosis.corrected_xml

Recordings that were kept back decide what is handed over, after everything is chosen and fitted;
held-out ones are only predicted.
"""

from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from diagnosis import findings
from diagnosis.effects.base import condition_of
from diagnosis.effects.unmodelled import Unknown
from diagnosis.estimation.intervals import intervals
from diagnosis.estimation.smoother import Smoother, Trajectory
from diagnosis.handover import Check, Handed, accepted
from diagnosis.recordings.recording import RecordingError
from diagnosis.selection import missing_force, moments, rivals, transients
from diagnosis.selection.criterion import PRICE, complexity, paired
from diagnosis.selection.identification import LEVEL, Found, Identification, physics, said
from diagnosis.selection.judge import Fitted, changing, channel, lacking, share_left, without
from diagnosis.selection.plausibility import plausible
from diagnosis.unnamed import NEAREST, UNNAMED

STRAINS = 4.0  # scales of its prior, beyond which a value is told to strain it


@dataclass
class Outcome:
    """All that the report is made of: found (Found), fitted (Fitted set), trajectory (Trajectory
    under it), others {Candidate: [(other, values)]}, p_values, strains {Candidate: words}, left
    ([Dependence] under the final set), dependences (under the nominal model), lacks ([Comparison]
    of each channel with a perfect simulator, where nothing has a name), handed (Handed),
    train_check and held_check (Check)."""

    found: Found
    fitted: Fitted
    trajectory: Trajectory
    others: dict
    p_values: dict
    strains: dict
    left: list
    dependences: list
    lacks: list = ()
    handed: Handed = None
    train_check: Check = None
    held_check: Check = None
    event: object = None  # Event
    there: dict = field(default_factory=dict)  # {Candidate: share removed while it acts}
    earned: bool = False


def identify(world, train, held_out, kept_back=None, progress=None, log=None):
    """Diagnose a simulator from recordings.

    world: simulator.World; train, held_out, kept_back: lists of Recording; the last decide what is
    handed over (held_out by default). progress(done, message): called with the share done, 0..1;
    log(message): with every decision. Raises RecordingError where the data say too little.
    """
    say, log = progress or (lambda done, message: None), log or (lambda message: None)
    if not any(np.isfinite(r.qpos).sum(0).max(initial=0) >= 10 for r in train):
        raise RecordingError(
            "not enough data: recordings need at least ten measured rows in some qpos column"
        )
    search = Identification(world, train, say, log)
    found = search.run()
    at_times = condition_of(found.fitted.setting)
    event = None if at_times else transients.happened(world, train, found)
    if event and not plausible(event.candidate, found.usual).inside(np.array(event.values)):
        event = None
    if event:
        search, found, event = _undisturbed(search, found, event)
    say(0.75, "what could stand in a finding's place")
    fitted, others = _classes(search, found, found.fitted, log, search.candidates)
    if set(fitted.setting) != set(found.fitted.setting):  # what made up for another member goes
        fitted = search.pruned(found.judge, fitted, found.judge.fit({}))
    fitted = _as_it_was(search, found.judge, changing(found.judge, fitted))
    others = rivals.together(others, fitted, found.sets)
    say(0.8, "testing for anything left")
    outcome = _checked(search, found, fitted, others, log)
    outcome.event = event
    outcome.earned = _earns_something(outcome)
    say(0.85, "checking what is handed over")
    _hand_over(search, held_out or train, kept_back or held_out or train, outcome, log)
    if not physics(outcome.fitted.setting):
        _nameless(search, outcome)
    say(0.95, "held-out error")
    return findings.assemble(world, train, held_out, outcome)


def _undisturbed(search, found, event):
    """(search, found, event): what lasts, searched again without the time of an event, begun with
    what was found. Beside the event, on all windows, the better of the two sets is kept; where
    neither predicts better than what was found without an event, or something else acts at times,
    there is none."""
    search.log(f"  an event: {event.candidate}")
    calm = Identification(
        search.world, transients.calm(search.train, event), search.say, search.log
    )
    again = calm.run(found.fitted.setting)
    if condition_of(again.fitted.setting):
        return search, found, None
    again = replace(again, fitted=_earned(calm, again.judge, again.fitted))
    before, after = (
        _everywhere(search, found.judge, some.fitted.setting, event) for some in (found, again)
    )
    search.log(f"  beside it {before:.3f}, {after:.3f}; {found.fitted.loss:.3f} without")
    if min(before, after) >= found.fitted.loss:
        return search, found, None
    if before < after:
        again = replace(again, fitted=again.judge.fit(found.fitted.setting))
    here = calm.smoother.locate(again.fitted.setting, again.trajectory)
    return calm, replace(again, trajectory=here), event


def _as_it_was(search, judge, fitted):
    """A Fitted set in which what the recordings do not show of an effect, beside what they show of
    it, is nominal, unless that is worse: together several may show where none does alone."""
    several = {c: values for c, values in fitted.setting.items() if len(values) > 1}
    bounds = intervals(fitted) if several else {}
    for c, values in several.items():
        told = np.array([b is not None for b in bounds[c]])
        kept = tuple(np.where(told, values, c.nominal).tolist())
        if told.all() or not told.any() or not np.isfinite(kept).all() or kept == values:
            continue
        before, search.seen[c] = search.seen.get(c), told
        tried = judge.fit({**fitted.setting, c: kept}, steps=3)
        if search.earned(tried, fitted):
            search.seen[c] = np.ones(len(told), bool) if before is None else before
        else:
            fitted = tried
    return fitted


def _earns_something(outcome):
    """Whether the search found more than a finer time step: what that explains is nothing that is
    missing, so coloured noise may be all that is left."""
    return bool(physics(outcome.fitted.setting) or outcome.event)


def _everywhere(search, judge, setting, event):
    """The loss of a setting beside an event on all windows, without the event's price, which it is
    worth where it acts."""
    both = {**setting, event.candidate: event.values}
    fitted = search.begun(judge, both).fit(both, steps=0)
    return fitted.loss - PRICE * complexity([event.candidate])


def _earned(search, judge, fitted):
    """A Fitted set without what is not earned beside the rest, or over nothing."""
    nothing = judge.fit({})
    fitted = search.pruned(judge, fitted, nothing)
    return fitted if search.earned(nothing, fitted) else nothing


def _checked(search, found, fitted, others, log):
    """The Outcome so far: curves tried beside the names, and what is left."""
    world, train, judge = search.world, search.train, found.judge
    fitted = _one_curve(search, found, fitted, log)
    dependences = missing_force.dependences(world, found.first, train)
    trajectory = found.trajectory
    left = _left(search, fitted, trajectory)
    shares = share_left(fitted) if fitted.setting else None
    finer = None  # what finer steps explain as well is no force
    done = fitted.setting and not search.something(fitted)
    for rest in [] if done else missing_force.each_joint(left)[:2]:
        mine = [c for c in fitted.setting if _at(world, c, rest.joint)]
        if mine and not _leave_much(world.model, fitted, shares, rest.joint):
            continue
        finer = finer or search.finer(judge, fitted)
        # where no name is found, all that is told are a joint and a variable
        units = complexity([rest.candidate]) if mine else UNNAMED
        tries = [_beside(search, judge, finer, rest, PRICE * units)]
        alone = _instead(search, found, finer, mine, rest.joint) if mine else None
        better = alone and alone.loss < finer.loss
        if better and search.no_chance(paired(finer.score, alone.score)):
            tries.append(alone)
        beside = min(filter(None, tries), key=lambda f: f.loss, default=None)
        if not beside:
            continue
        log(f"  a curve at {rest.joint}: {beside.loss:.3f} {said(beside.setting)}")
        fitted = search.pruned(judge, beside, judge.fit({})) if mine else beside
        break
    return Outcome(found, fitted, trajectory, others, {}, {}, left, dependences)


def _left(search, fitted, trajectory):
    """The Dependences of what a Fitted set leaves of the force: beside effects that act at times,
    those of the time in which they act."""
    when = condition_of(fitted.setting)
    return moments.followed(search.world, trajectory, search.train, when)


def _instead(search, found, fitted, names, joint):
    """The Fitted set with the curve that the force at a joint follows best in the place of what
    acts there, or None where it follows nothing."""
    rest = {c: v for c, v in fitted.setting.items() if c not in names}
    trajectory = copy(found.smoother).locate(rest, found.trajectory)
    left = _left(search, fitted, trajectory)
    curve = next((d for d in left if d.joint == joint), None)
    if not curve:
        return None
    return found.judge.fit({**rest, curve.candidate: curve.values}, steps=2)


def _one_curve(search, found, fitted, log):
    """The Fitted set with one curve, its own or another one, in the place of a curve and names of
    its joint, where these are not earned over it: beside a curve any name fits that it makes up
    for."""
    for curve in _unnamed(fitted.setting):
        joint = curve.place.name
        mine = [c for c in fitted.setting if _at(search.world, c, joint)]
        if len(mine) < 2:
            continue
        own = {c: v for c, v in fitted.setting.items() if c is curve or c not in mine}
        tries = [found.judge.fit(own, steps=2), _instead(search, found, fitted, mine, joint)]
        alone = min(filter(None, tries), key=lambda f: f.loss)
        if not search.earned(alone, fitted):
            log(f"  one curve at {joint}: {alone.loss:.3f} {said(alone.setting)}")
            fitted = alone
    return fitted


def _unnamed(setting):
    """[Candidate] of the curves of a setting."""
    return [c for c in setting if isinstance(c.effect, Unknown)]


def _nameless(search, outcome):
    """Fill in what a perfect simulator would remove of what is left, in finer steps, and what the
    located force follows there."""
    finer = search.finer(outcome.found.judge, outcome.fitted)
    outcome.lacks = lacking(finer)
    if finer is not outcome.fitted:
        given = finer.setting, outcome.trajectory
        trajectory = copy(outcome.found.smoother).locate(*given)
        outcome.left = _left(search, finer, trajectory)


def _beside(search, judge, fitted, rest, price):
    """The Fitted set with a curve beside, or None where it does not earn its place: as it was
    located, and then refitted."""
    for steps in (0, 2):
        beside = judge.fit({**fitted.setting, rest.candidate: rest.values}, steps=steps)
        step = paired(fitted.score, beside.score)
        if step.gain < price or not search.no_chance(step):
            return None
    return beside


def _classes(search, found, fitted, log, candidates, asked=None):
    """(Fitted, {candidate: [(other, values)]}): the classes of its findings among candidates."""
    begun = lambda setting: search.begun(found.judge, setting)
    return rivals.classes(candidates, found.judge, found.missing, fitted, begun, asked, log)


def _at(world, candidate, joint):
    """Whether a finding acts at a joint."""
    joints = world.joints(candidate.place)
    return joints is not None and world.model.joint(joint).id in joints


def _leave_much(model, fitted, shares, joint):
    """Whether the names of a Fitted set leave much of a joint's error. shares: its share_left."""
    return shares[channel(fitted, model.joint(joint).dofadr[0])] > NEAREST


def _strain(candidate, values, prior):
    """None, or how far a value lies from what is usual."""
    far = abs(np.asarray(values) - prior.centre) / prior.scale
    k = int(np.argmax(far))
    if not far[k] > STRAINS:
        return None
    p = candidate.parameters[k]
    usual = f"within {STRAINS * prior.scale[k]:.3g} of {p.nominal:.3g} is usual"
    return f"{p.name} {values[k]:.3g} {p.unit}: {usual}"


def _refitted(search, outcome, decides, log, some, out):
    """The setting of some findings without one that kept-back recordings spoke against: what made
    up for that one may be another then, which one more round finds, and what could stand in its
    place. Either may only make up for what is gone, by the same recordings."""
    found, judge = outcome.found, outcome.found.judge
    search.candidates = [c for c in search.candidates if c is not out]
    plain = judge.fit(some, steps=3)
    harms = lambda new, old: (
        new.setting.keys() != old.setting.keys()
        and decides.worse(new.setting, old.setting) > decides.scattered()
    )
    fitted = judge.fit(search.again(plain.setting, outcome.trajectory).setting)
    fitted = plain if harms(fitted, plain) else fitted
    new = fitted.setting.keys() - some.keys()
    near = [c for c in fitted.setting if c in new or rivals.meet(search.world, c, out)]
    other, told = _classes(search, found, fitted, log, search.candidates, near)
    fitted, told = (fitted, {}) if harms(other, fitted) else (other, told)
    told, still = {**outcome.others, **told}, set(search.candidates) - set(fitted.setting)
    outcome.others = {c: [o for o in told[c] if o[0] in still] for c in told}
    return _earned(search, judge, fitted).setting  # what was earned beside it goes, too


def _doubtful(judge, setting):
    """The name of a setting that may be nothing and is missed least; None where none may."""
    fitted = judge.fit(setting, steps=0)
    bounds, named = intervals(fitted), physics(setting).difference(_unnamed(setting))
    some = [c for c in setting if c in named and findings.may_be_nothing(c, bounds[c])]
    return min(some, key=lambda c: without(fitted, c).loss, default=None)


def _best_curve(judge, outcome, decides, curves):
    """The setting of one of the curves that the forces at some joints follow, worth the price of a
    force without a name, where a Check says that it predicts better than what is handed over by
    more than noise does, without the window that says so most; None where there is none."""
    nothing, handed = judge.fit({}), outcome.handed.setting
    for rest in curves:
        curve = judge.fit({rest.candidate: rest.values}, steps=2)
        step = paired(nothing.score, curve.score)
        told = step.gain > PRICE * UNNAMED and step.p_value < LEVEL
        if told and decides.worse(handed, curve.setting, uncounted=1) > decides.scattered():
            return curve.setting
    return None


def _keep(judge, outcome):
    """Fit what is handed over, if that is not what was fitted."""
    if outcome.handed.setting != outcome.fitted.setting:
        outcome.fitted = judge.fit(outcome.handed.setting, steps=0)


def _curve_instead(judge, outcome, decides, kept_of):
    """Hand over a curve where nothing has a name, or at a joint where names leave much, and it
    predicts better. kept_of(setting): the Handed of what kept-back recordings leave of it."""
    model, fitted = judge.ahead.model, outcome.fitted
    curves = missing_force.each_joint(outcome.dependences)
    if physics(fitted.setting):
        shares = share_left(fitted)
        curves = [c for c in curves if _leave_much(model, fitted, shares, c.joint)]
    curve = _best_curve(judge, outcome, decides, curves[:2]) if curves else None
    handed = kept_of(curve) if curve else None
    if handed and handed.setting:
        outcome.handed = replace(handed, gone=outcome.handed.gone)
        _keep(judge, outcome)


def _hand_over(search, held, kept_back, outcome, log):
    """Fill in the Handed, what of the findings kept-back recordings do not speak against, and how
    sure of each the judge is."""
    world, found = search.world, outcome.found
    setting, noise = outcome.fitted.setting, found.smoother.position_noise
    check = decides = Check(world, held, Smoother(world, held), noise)
    if kept_back is not held:
        decides = Check(world, kept_back, Smoother(world, kept_back), noise)
    judge, refit = found.judge, partial(_refitted, search, outcome, decides, log)
    outcome.handed = accepted(
        world, decides, setting, refit, log, told=check, doubtful=partial(_doubtful, judge)
    )
    _keep(judge, outcome)
    _curve_instead(judge, outcome, decides, partial(accepted, world, decides, log=log, told=check))
    kept = outcome.fitted.setting
    for c, v in kept.items():
        less = without(outcome.fitted, c)
        rest = {other: x for other, x in kept.items() if other is not c}
        if np.isinf(less.loss):  # of what small changes tell nothing
            less = judge.fit(rest, steps=2)
        if c.when:
            outcome.there[c] = moments.removed(judge.fit(rest, steps=0), outcome.fitted, c.when)
        outcome.p_values[c] = paired(less.score, outcome.fitted.score).p_value
        outcome.strains[c] = _strain(c, v, plausible(c, found.usual))
    if set(kept) != set(found.fitted.setting):
        outcome.trajectory = found.smoother.locate(kept, outcome.trajectory)
        outcome.left = _left(search, outcome.fitted, outcome.trajectory)
    check.locate(kept)
    outcome.held_check = check
    smoother = found.smoother
    outcome.train_check = Check(world, smoother.recordings, smoother, noise)
    outcome.train_check.trajectory = outcome.trajectory
