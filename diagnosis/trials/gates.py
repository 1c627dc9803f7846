"""When and where a hidden law acts, if not always and everywhere.

laws = gate(rng, laws, plan, settings, usage)
gate_name(laws)         # "part of the travel", "one recording", "from a moment on", or None
"""

from diagnosis.trials.laws import Gate, Law, Payload, Transmission


def gate(rng, laws, plan, settings, usage):
    """In some trials a law acts from some moment on, in one recording, or in part of the travel."""
    fate = rng.random()
    train, runs = settings.train_runs, settings.train_runs + settings.held_out_runs
    start = float(rng.uniform(0.3, 0.6) * plan.seconds)
    some = (int(rng.integers(train)), *range(train, runs))
    if laws and isinstance(laws[0], Payload):  # one that never changes is a mass
        laws[0].__dict__.update({"start": start} if fate < 0.5 else {"runs": some})
        return laws
    gates = ({"start": start}, {"runs": some})
    if fate > 0.24 or not all(_gateable(law) for law in laws):
        return laws
    if fate < 0.16:
        return [Gate(law, **gates[fate < 0.08]) for law in laws]
    quantiles = [usage.quantiles[law.link] for law in laws]
    if any(law.effect for law in laws):  # no name says where in the travel it acts
        return laws
    return [Gate(law, within=(float(q[25]), float(q[65]))) for law, q in zip(laws, quantiles)]


def _gateable(law):
    """May a law come and go? Not what delays, measures, couples, or carries a rotor."""
    fixed = ("control", "measure", "couple")
    same = all(getattr(type(law), name) is getattr(Law, name) for name in fixed)
    return same and not isinstance(law, Transmission)


def gate_name(laws):
    """Which of the three, as a column says it; None where nothing comes and goes."""
    for law in laws:
        if isinstance(law, (Gate, Payload)):
            if getattr(law, "within", None):
                return "part of the travel"
            return "one recording" if law.runs else "from a moment on"
    return None
