"""What no name earns: a force that is missing, told as `unknown`, at its joint and with what it
depends on.

findings = led(world, outcome, findings, something, channels)

A name stands first only where the error of its joint goes with it, as far as a perfect simulator's
would. Where much is left, `unknown` leads, and the name is one of those that it may be.
"""

import numpy as np

from diagnosis.effects.base import HINGE, JOINT_TRANSMISSIONS, SLIDE, is_numerical
from diagnosis.effects.unmodelled import Unknown
from diagnosis.estimation import windowing
from diagnosis.selection.criterion import BEYOND, PRICE
from diagnosis.selection.identification import LEVEL
from diagnosis.selection.judge import channel, share_left
from diagnosis.selection.plausibility import at_limit, plausible

# of a joint's error that names leave beyond a perfect simulator's, from which they are the nearest
NEAREST = 0.25
MOST_LEFT = 0.5  # of a joint's held-out error: names explain the greater part, or are the nearest
UNNAMED = 2  # units of complexity of a force where nothing has a name
MOST = 3  # names that an unknown force may have, and variables that it depends on


def _standing_out(world, outcome, joints):
    """Name of the hinge or slide among joints whose missing force stands out most, in its own
    deviations; None where there is none."""
    joints = [j for j in joints if world.model.jnt_type[j] in (HINGE, SLIDE)]
    if not joints:
        return None
    dofs = world.model.jnt_dofadr[joints]
    force, scatter = outcome.found.first.located()
    return world.model.joint(joints[int(np.argmax((force / scatter)[dofs]))]).name


def main_joint(world, outcome, candidate, shares):
    """(joint, share of its error that is left) of the joint in which a finding acts and most force
    is missing: gravity and air act in all, a time step in none; (None, NaN) where there is none.
    shares: of the channels (share_left())."""
    everywhere = () if candidate.effect.numerical else range(world.model.njnt)
    joint = _standing_out(world, outcome, sorted(world.joints(candidate.place) or everywhere))
    if joint is None:
        return None, np.nan
    dof = world.model.joint(joint).dofadr[0]
    return joint, float(shares[channel(outcome.fitted, dof)])


def held_out_share(errors):
    """(share of the nominal model's held-out error of a channel that is left, both beyond a perfect
    simulator's, infinite where it shows nothing; whether it shows clearly more than that). errors:
    {"before", "after", "floor"}."""
    before, after, floor = (errors[key] for key in ("before", "after", "floor"))
    if not np.isfinite([before, after]).all() or before <= floor:
        return np.inf, False
    left = np.sqrt(max(after**2 - floor**2, 0.0) / (before**2 - floor**2))
    return left, before > BEYOND * floor


def missing_most(world, outcome):
    """The hinge or slide in which a perfect simulator would gain most, of those in which that is
    worth the price of a force without a name, and no chance; None where there is none."""
    model, level = world.model, LEVEL / len(outcome.lacks)
    gains = {}
    for j in np.flatnonzero(np.isin(model.jnt_type, (HINGE, SLIDE))):
        lack = outcome.lacks[channel(outcome.fitted, model.jnt_dofadr[j])]
        if lack.gain > PRICE * UNNAMED and lack.p_value < level:
            gains[model.joint(j).name] = lack.gain
    return max(gains, key=gains.get, default=None)


def depends_on(model, candidate):
    """What an effect's force varies with, in the contract's words."""
    if isinstance(candidate.effect, Unknown):
        return list(candidate.effect.depends_on)
    variable, name = candidate.effect.acts_through, candidate.place.name
    if variable == "velocity" and candidate.place.kind == "actuator":
        actuator = model.actuator(name)
        if (
            actuator.trntype[0] not in JOINT_TRANSMISSIONS
        ):  # a site or tendon moves with many joints
            return []
        name = windowing.joint_name(model, actuator.trnid[0])
    return [f"{variable}:{name}"] if variable else []


def unknown(joint, outcome, on=()):
    """The finding of a force at a joint, without a name and without a curve, that depends on some
    variables and on what the force follows best that is left there."""
    told = [variable for d in outcome.left if d.joint == joint for variable in d.variables]
    return {
        "effect": "unknown",
        "place": {"kind": "joint", "name": joint},
        "parameters": [],
        "evidence": {"held_out_error_removed": 0.0, "p_value": None},
        "adequate": False,
        "strains": None,
        "depends_on": list(dict.fromkeys((*on, *told)))[:MOST],
        "when": None,
        "written_as": "none",
        "also_possible": [],
    }


def beside(finding, names):
    """A finding of an unknown force, with the findings that it may be and that are written in its
    place. It depends on what its curve does, if it has one, then on what they do."""
    every = [finding, *names]
    named = [{key: name[key] for key in ("effect", "place", "parameters")} for name in names]
    members = [other for name in names for other in name["also_possible"]]
    told = [f["evidence"]["p_value"] for f in every if f["evidence"]["p_value"] is not None]
    removed = sum(f["evidence"]["held_out_error_removed"] for f in every)
    written = [f["written_as"] for f in every if f["written_as"] != "none"]
    order = every if "curve" in finding else [*names, finding]
    on = [variable for f in order for variable in f["depends_on"]]
    return {
        **finding,
        "evidence": {
            **finding["evidence"],
            "held_out_error_removed": removed,
            "p_value": min(told, default=None),
        },
        "depends_on": list(dict.fromkeys(on))[:MOST],
        "when": next((f["when"] for f in every if f["when"]), None),
        "written_as": written[0] if written else "none",
        "also_possible": [*finding["also_possible"], *named, *members][:MOST],
    }


def _at_edge(outcome, candidate):
    """Whether a value lies at the edge of what was tried: the truth may lie anywhere beyond."""
    values = outcome.fitted.setting[candidate]
    return at_limit(candidate, values, plausible(candidate, outcome.found.usual))


def _unearned(world, outcome):
    """(joint or None, variables) where a force is missing that no finding tells of: that of what
    the search found and kept-back recordings spoke against, or the one that stands out most. A
    curve that was only tried beside it is not even earned."""
    found = outcome.found.fitted.setting
    for candidate in outcome.handed.gone:
        if isinstance(candidate.effect, Unknown) and candidate not in found:
            continue
        joint = _standing_out(world, outcome, sorted(world.joints(candidate.place) or ()))
        if joint:
            return joint, depends_on(world.model, candidate)
    return missing_most(world, outcome), ()


def led(world, outcome, findings, something, channels):
    """Findings with `unknown` in the place of names that leave much of the error of their joint or
    have a value at the edge of what was tried, or where held-out recordings show that something is
    missing and nothing has a name: a finer time step is none.

    findings: [(candidate or None, finding)], the most important first; channels {channel: errors}:
    of held-out recordings. Where these or those that names were found on show that they leave
    little, they do, unless these show clearly that they leave most.
    """
    # of two at a joint the more important one: what acts at times may stand beside a curve
    leads = {f["place"]["name"]: f for _, f in reversed(findings) if f["effect"] == "unknown"}
    order, shares = [], share_left(outcome.fitted)  # findings, and the joints of unknown forces
    names = {}  # that these may have
    # joints whose held-out errors are those of sensors that files do not hold
    off = {f["place"]["name"] for _, f in findings if f["written_as"] == "measurement"}
    for candidate, finding in findings:
        joint = finding["place"]["name"] if finding["effect"] == "unknown" else None
        if candidate and joint is None:
            at, share = main_joint(world, outcome, candidate, shares)
            held = at not in off and not candidate.when  # no file holds what comes and goes
            errors = channels.get(f"qpos:{at}") if held else None
            shown, clearly = held_out_share(errors) if errors else (np.inf, False)
            least = min(share, shown)
            told = least if np.isfinite(least) else None
            finding = {**finding, "evidence": {**finding["evidence"], "error_left": told}}
            edge = _at_edge(outcome, candidate)
            if at and (edge or least > NEAREST or (clearly and shown > MOST_LEFT)):
                joint = at
                names.setdefault(joint, []).append(finding)
            elif edge:
                finding |= {"adequate": False}
        if joint is None:
            order.append(finding)
        elif joint not in order:
            order.append(joint)
    physics = [f for f in order if isinstance(f, str) or not is_numerical(f["effect"])]
    joint, on = (None, ()) if physics or not something else _unearned(world, outcome)
    order += [joint] if joint else []
    told = lambda joint: leads.get(joint) or unknown(joint, outcome, on)
    force = lambda joint: beside(told(joint), names.get(joint, []))
    return [force(each) if isinstance(each, str) else each for each in order]
