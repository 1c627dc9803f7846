"""A diagnosis in plain words and honest digits, for the terminal and for the page.

Everything here reads `Diagnosis.summary`, the dictionary that becomes diagnosis.json.
"""

import math
from collections.abc import Iterable

import numpy as np

from diagnosis.effects.joints import JointStop

SPOKEN = {
    "coulomb": "Coulomb",
    "stribeck": "Stribeck",
    "back_emf": "back-EMF",
    "center_of_mass": "centre of mass",
    "load_friction": "load-dependent friction",
    "friction_map": "friction along the travel",
    "torque_speed": "torque-speed limit",
    "gain_fade": "fading gain",
}
ALWAYS_THERE = {
    "center_of_mass",
    "gravity",
    "ground_height",
    "link_length",
}  # a nominal 0 of theirs is a value like any other
CANNOT_TELL = "these recordings cannot tell it from"
UNSTEADY = 0.01  # p, below which recordings do not agree on one value
NO_EFFECT = "no effect of the catalogue improves the prediction of recordings held out."
UNSEEN = "not seen in these recordings"
MUCH = 0.5  # of the squared error above the noise: no match, though nothing is named
SMALL = {
    "rad": ("mrad", 1e3),
    "m": ("mm", 1e3),
}  # errors and noise are small: in these they read better


def effect_words(effect: str) -> str:
    """ "coulomb_friction" -> "Coulomb friction"."""
    for name, spoken in SPOKEN.items():
        effect = effect.replace(name, spoken)
    return effect.replace("_", " ")


def place_words(place: dict) -> str:
    """{"kind": "joint", "name": "elbow"} -> "joint elbow"; "a+b" are two joints."""
    if place["kind"] == "world":
        return "the world"
    if place["kind"] == "joint" and "+" in place["name"]:
        return f"joints {place['name'].replace('+', ' and ')}"
    return f"{place['kind']} {place['name']}"


def number(value: float | None, digits: int = 3) -> str:
    """A number to so many significant digits, without a needless exponent: 0.0005, 411, 1.2e-07."""
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    if value == 0:
        return "0"
    if not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}".replace("e-0", "e-").replace("e+0", "e")
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:.{decimals}f}"


def estimate(parameter: dict) -> str:
    """A parameter with its 95 % interval, to the digits the interval warrants: "0.121 ± 0.004
    N·m"."""
    value, low, high, unit = (parameter.get(key) for key in ("value", "low", "high", "unit"))
    if value is None:
        return UNSEEN
    unit = f" {unit}" if unit and unit != "1" else ""
    if low is None or high is None or not high > low:
        return number(value) + unit
    half = (high - low) / 2
    decimals = max(
        0, (half < 2.95 * 10.0 ** math.floor(math.log10(half))) - math.floor(math.log10(half))
    )  # 0.12 but 0.4
    if decimals > 6 or half > 1e6:
        return f"{number(value)} ({number(low)} to {number(high)}){unit}"
    value = round(value, decimals) or 0.0  # not -0
    most = max(0, 3 - math.floor(math.log10(abs(value)))) if value else decimals
    if decimals > most:  # four digits of a value are enough, however narrow its interval
        return f"{value:.{most}f} ± {number(half, 1)}{unit}"
    if abs(value - (low + high) / 2) < 0.25 * half:
        return f"{value:.{decimals}f} ± {half:.{decimals}f}{unit}"
    return f"{value:.{decimals}f} ({low:.{decimals}f} to {high:.{decimals}f}){unit}"


def _force_words(finding: dict) -> str:
    """What a force without a name depends on, or how it repeats, as the middle of a sentence."""
    if (finding.get("curve") or {}).get("wave") and "time" in (finding.get("depends_on") or ()):
        # its parameters are a sine's values a quarter of a period apart
        one, other = finding["parameters"]
        hertz = 0.25 / (other["at"] - one["at"])
        amplitude = math.hypot(one["value"], other["value"])
        wave = f"repeating {number(hertz)} times a second with an amplitude of"
        return f", {wave} {number(amplitude)} {one['unit']}"
    on = depends_words(finding.get("depends_on"))
    return f", depending on {on}" if on else ""


def finding_words(finding: dict) -> str:
    """One finding in a sentence: "joint elbow: Coulomb friction 0.121 ± 0.004 N·m was left out"."""
    place, effect = place_words(finding["place"]), effect_words(finding["effect"])
    if finding["effect"] == "unknown":
        unnamed = f"{place}: a force that the catalogue has no name for"
        return unnamed + _force_words(finding) + when_words(finding.get("when"))
    parameters, ends = finding["parameters"], ""
    absent = [
        p for p in parameters if no_stop(p["name"], p["value"]) and no_stop(p["name"], p["nominal"])
    ]
    if absent and len(absent) < len(parameters):  # a stop on one side only
        ends = " (" + " and ".join(no_stop(p["name"], p["value"]) for p in absent) + ")"
    parameters = [p for p in parameters if p not in absent]
    seen = [p for p in parameters if p["value"] is not None and p["value"] != p["nominal"]]
    parameters = seen or parameters
    if not parameters:
        return f"{place}: {effect}"
    if not there(finding["effect"], parameters[0]):
        many = len(finding["parameters"]) > 1
        values = ", ".join(
            no_stop(p["name"], p["value"]) or (f"{p['name']} " if many else "") + estimate(p)
            for p in parameters
        )
        sentence = f"{place}: {effect} {values} was left out{ends}"
    else:
        named = len(parameters) > 1 or parameters[0]["name"] not in effect
        values = ", ".join(
            (f"{p['name']} " if named and not no_stop(p["name"], p["value"]) else "") + change(p)
            for p in parameters
        )
        sentence = f"{place}: {effect}{':' if values[0].isalpha() else ''} {values}{ends}"
    return sentence + when_words(finding.get("when"))


def there(effect: str, parameter: dict) -> bool:
    """Whether the nominal model has some of an effect, so that a parameter of it is wrong rather
    than left out."""
    if effect == "joint_stop":
        return no_stop(parameter["name"], parameter["nominal"]) is None
    return effect in ALWAYS_THERE or parameter["nominal"] not in (0, None, math.inf, -math.inf)


def no_stop(name: str, value: float | None) -> str | None:
    """ "no stop below" or "no stop above" of a joint stop's bound that is out of reach, else
    None."""
    if name in ("low", "high") and (value is None or not abs(value) < JointStop.NEVER):
        return f"no stop {'below' if name == 'low' else 'above'}"
    return None


def change(parameter: dict) -> str:
    """ "4.52 ± 0.03 kg instead of 3.56 (+27 %)"."""
    nominal, stop = parameter["nominal"], no_stop(parameter["name"], parameter["value"])
    if nominal is None or math.isinf(nominal) or parameter["value"] is None:
        return stop or estimate(parameter)
    if stop:
        return f"{stop} instead of {number(nominal)} {parameter['unit']}"
    ratio = parameter["value"] / nominal if nominal else 1.0
    share = (
        ""
        if not nominal
        else f" ({ratio:.0f} times)"
        if ratio >= 10
        else f" ({100 * (ratio - 1):+.0f} %)"
    )
    return f"{estimate(parameter)} instead of {number(nominal)}{share}"


def when_words(when: dict | None) -> str:
    """The `when` of a finding as the end of a sentence."""
    if not when:
        return ""
    if "time" in when:
        begin, end = when["time"]
        decimals = max(
            0, 2 - math.floor(math.log10(max(end - begin, 1e-6)))
        )  # not so many digits: the clock may count from 1970
        begin, end = f"{begin:.{decimals}f}", f"{end:.{decimals}f}"
        if when["recording"] is None:
            return f", in every recording from {begin} s on"
        return f", in {when['recording']} from {begin} to {end} s"
    return ", where " + " and ".join(
        f"{state_words(name)} is between {number(a)} and {number(b)}"
        for name, (a, b) in when.items()
    )


def state_words(name: str) -> str:
    """ "qpos:elbow" -> "the position of elbow"."""
    kind, _, joint = name.partition(":")
    return {"qpos": "the position of ", "qvel": "the velocity of "}[kind] + joint


def depends_words(depends_on: Iterable[str] | None) -> str:
    """["velocity:elbow", "time"] -> "the velocity of elbow and time"."""
    words = []
    for item in depends_on or []:
        kind, _, name = item.partition(":")
        words.append(
            f"{kind} with {name}"
            if kind == "contact"
            else f"the {kind} of {name}"
            if name
            else kind
        )
    return " and ".join(words)


def errors(summary: dict) -> tuple[float, float, float, str, str]:
    """Held-out error (before, after, floor, unit, place), three numbers and two texts: in SI at the
    channel that the correction betters most (or worsens most, where it worsens the whole), or,
    where they are the same, which is farthest from a perfect one; or over all channels in multiples
    of the noise. Infinite: the model blows up."""
    fit, place, factor = summary["fit"]["held_out"], "", 1
    unit = "times the noise"
    channels = {name: _infinite(c) for name, c in (fit.get("channels") or {}).items() if c["floor"]}
    if channels:
        match = summary["verdict"] == "match" or not summary["findings"]
        whole = _infinite(fit)
        sign = -1 if whole["after"] > whole["before"] else 1
        gains = {
            name: (c["before"] if match else sign * (c["before"] - c["after"])) / c["floor"]
            for name, c in channels.items()
        }
        name = max(gains, key=lambda n: (math.isinf(channels[n]["after"]), np.nan_to_num(gains[n])))
        fit, place = channels[name], " at " + channel_words(name)
        unit, factor = SMALL.get(fit["unit"], (fit["unit"], 1))
    fit = _infinite(fit)
    return *(fit[key] * factor for key in ("before", "after", "floor")), unit, place


def _infinite(fit):
    """Errors with infinity where diagnosis.json has null."""
    return {
        **fit,
        **{key: math.inf if fit[key] is None else fit[key] for key in ("before", "after", "floor")},
    }


def channel_words(name: str) -> str:
    """ "qpos:elbow" -> "elbow", "qpos:root:rot" -> "root (rotation)"; a joint without a name goes
    by its index."""
    joint, _, part = name.split(":", 1)[1].partition(":")
    part = {"pos": " (position)", "rot": " (rotation)"}.get(part, f":{part}" if part else "")
    return ("joint " if joint.isdigit() else "") + joint + part


def error_words(summary: dict) -> str:
    """ "held-out error 0.3 s ahead falls from 31 to 2 mrad at elbow; a perfect simulator's would be
    1, from noise in ..."."""
    *values, unit, place = errors(summary)
    before, after, floor = (number(value, 2) for value in values)
    blown = [not math.isfinite(value) for value in values[:2]]
    ahead = f"held-out error {summary['fit']['held_out'].get('horizon_s', 0.3):g} s ahead"
    perfect = f"a perfect simulator would show {floor}, for it too starts from noisy measurements"
    if all(blown):
        which = "" if summary["verdict"] == "match" else "corrected "
        return f"{ahead} has no number, for the {which}model blows up{place}; {perfect}"
    if blown[1]:
        nominal = f"{before} {unit}{place} with the nominal model"
        return f"{ahead} is {nominal}, but the corrected one blows up; {perfect}"
    if blown[0]:
        return f"{ahead} is {after} {unit}{place}, where the nominal model blows up; {perfect}"
    fit = _infinite(summary["fit"]["held_out"])
    falls = "falls" if fit["after"] < fit["before"] else "goes"
    change = (
        f"is {before} {unit}"
        if summary["verdict"] == "match"
        else f"stays at {after} {unit}"
        if before == after
        else f"{falls} from {before} to {after} {unit}"
    )
    return f"{ahead} {change}{place}; {perfect}"


def blown_words(blown: dict) -> str:
    """{"before": 3, "after": 0, "of": 40} -> what the curve of error against horizon leaves out."""
    parts = [
        f"{blown[key]} of {blown['of']} windows blow up under the {name} model"
        for key, name in (("before", "nominal"), ("after", "corrected"))
        if blown[key]
    ]
    return sentence(" and ".join(parts) + ": from then on they are left out of its line")


def unexplained_words(summary: dict) -> str:
    """What is left over, in a sentence, or "" where nothing worth saying is."""
    left = summary.get("unexplained") or {}
    if not (left.get("fraction") or 0) >= 0.02:
        return ""
    at = f" at {place_words(left['place'])}" if left.get("place") else ""
    on = depends_words(left.get("depends_on"))
    share, on = f"{100 * left['fraction']:.0f} %", f", depending on {on}" if on else ""
    if summary["verdict"] == "match":
        return f"{share} of the squared error is more than noise{at}{on}, and no effect explains it"
    return f"{share} of the original squared error stays unexplained{at}{on}"


def verdict_words(summary: dict) -> str:
    """The first line of everything."""
    if summary["verdict"] == "unresolved":
        effects = {finding["effect"] for finding in summary["findings"]}
        if effects == {"unknown"}:
            return "Something is missing, and the catalogue has no name for it."
        nearest = "; the nearest names are these." if effects else "."
        return f"Something is missing, and no name explains it well enough{nearest}"
    if summary["verdict"] == "match":
        if ((summary.get("unexplained") or {}).get("fraction") or 0) > MUCH:
            return f"Something is missing, but {NO_EFFECT}"
        return f"Nothing is missing: {NO_EFFECT}"
    sensors = sum(f.get("written_as") == "measurement" for f in summary["findings"])
    simulator = len(summary["findings"]) - sensors
    things = lambda count: "one thing is" if count == 1 else f"{count} things are"
    if not simulator:
        return f"The simulator shows no fault, but {things(sensors)} wrong with the sensors."
    more = f", and {things(sensors)} wrong with the sensors" if sensors else ""
    return sentence(f"{things(simulator)} wrong with the simulator{more}")


def terminal(summary: dict, out: str, files: list[str]) -> str:
    """The summary for the terminal, several lines; the last names the files written into folder
    out."""
    lines = [verdict_words(summary)]
    for finding in summary["findings"]:
        lines.append(f"  {finding_words(finding)}")
        rivals = ", ".join(
            f"{effect_words(other['effect'])} of {place_words(other['place'])}"
            for other in finding.get("also_possible") or []
        )
        words = "the nearest names" if finding["effect"] == "unknown" else CANNOT_TELL
        lines += [f"    ({words}: {rivals})"] if rivals else []
        lines += [f"    ({doubt})" for doubt in doubts(finding)]
    lines.append(sentence(error_words(summary)))
    left = unexplained_words(summary)
    lines += [sentence(left)] if left else []
    warnings = summary.get("warnings", [])
    lines += [f"Note: {warning}" for warning in warnings[:8]]
    lines += [f"({len(warnings) - 8} more notes are in the report)"] if len(warnings) > 8 else []
    lines.append(f"Written: {out}/{', '.join(files)}")
    return "\n".join(lines)


def doubts(finding: dict) -> list[str]:
    """What speaks against the name of a finding, a few words each."""
    found = []
    if finding.get("adequate") is False and finding["effect"] != "unknown":
        found.append(f"the nearest name only: {nearest_only(finding)}")
    if finding.get("strains"):
        found.append(f"hard to believe: {finding['strains']}")
    constancy = finding.get("constancy")
    if constancy is not None and constancy < UNSTEADY:
        found.append(f"the recordings do not agree on one value: p {p_value(constancy)}")
    return found


def nearest_only(finding: dict) -> str:
    """Why a finding is not adequate."""
    seen = [p for p in finding["parameters"] if p.get("low") is not None]
    if not seen:
        return "none of its values shows"
    if all(p["low"] <= (p["nominal"] or 0.0) <= p["high"] for p in seen):
        return "its intervals hold the nominal values"
    return "its value lies at the edge of what was tried"


def sentence(words: str) -> str:
    """With a capital and a full stop."""
    return words[:1].upper() + words[1:] + "."


def p_value(p: float | None) -> str:
    """ "< 1e-16", "0.03"."""
    if p is None or not math.isfinite(p):
        return "–"
    return "< 1e-16" if p < 1e-16 else number(p, 2)


def axis_words(variable: str, unit: str | None = None) -> str:
    """ "velocity:elbow" -> "velocity of elbow (rad/s)"."""
    kind, _, name = variable.partition(":")
    return (f"{kind} of {name}" if name else kind) + (
        f" ({unit})" if unit else " (s)" if variable == "time" else ""
    )


def model_title(model) -> str:
    """The model's own name: the first of MuJoCo's NUL-separated names."""
    return bytes(model.names).split(b"\0", 1)[0].decode(errors="replace") or "the mechanism"
