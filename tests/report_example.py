"""A diagnosis to draw: of the arm in arm.py, with friction at the elbow, every number made
up.

diagnosis = example()        # what writer.write and sections.html_page take
"""

import types

import numpy as np
from arm import ARM, arm, run

from diagnosis.effects import unmodelled
from diagnosis.recordings.recording import Recording

KNOTS, FORCE = np.linspace(-1, 1, 9), np.linspace(0, 1, 9)


def parameter(name, nominal, value, half, unit):
    """A parameter of diagnosis.json with a symmetric interval."""
    bounds = {"low": value - half, "high": value + half}
    return {"name": name, "nominal": nominal, "value": value, **bounds, "unit": unit}


def finding(effect, kind, name, nominal, value, half, unit, **more):
    """A finding of diagnosis.json, with one parameter called `value`."""
    return {
        "effect": effect,
        "place": {"kind": kind, "name": name},
        "parameters": [parameter("value", nominal, value, half, unit)],
        "evidence": {"held_out_error_removed": 0.6, "p_value": 1e-40},
        "adequate": True,
        "strains": None,
        "depends_on": [f"velocity:{name}"],
        "when": None,
        "written_as": "mjcf",
        "also_possible": [],
        **more,
    }


def recordings(count, seed):
    """Recordings of the arm, three seconds each."""
    tables = (run(3.0, seed + k) for k in range(count))
    return [
        Recording(f"run{seed + k}.csv", t[:, 0], t[:, 1:3], t[:, 3:5], t[:, 5:7])
        for k, t in enumerate(tables)
    ]


def findings():
    """Four findings: with rivals, inadequate, not in MJCF, and without a name."""
    rival = {
        "effect": "dead_zone",
        "place": {"kind": "actuator", "name": "elbow_motor"},
        "parameters": [{"name": "half_width", "nominal": 0.0, "value": 0.11, "unit": "N·m"}],
    }
    each = [
        {"recording": f"run{k}.csv", "value": 0.12 + 0.01 * k, "interval": [0.1, 0.13 + 0.01 * k]}
        for k in range(3)
    ]
    friction = finding("coulomb_friction", "joint", "elbow", 0.0, 0.12, 0.004, "N·m")
    friction |= {"also_possible": [rival], "per_recording": each, "constancy": 1e-5}
    mass = finding("mass", "body", "lower", 0.5, 0.55, 0.01, "kg", adequate=False)
    mass |= {"strains": "1.1 times the nominal value", "depends_on": []}
    gravity = finding("gravity", "world", "world", -9.81, np.float64(-9.7), 0.02, "m/s²")
    gravity |= {"written_as": "none", "depends_on": []}
    unknown = finding("unknown", "joint", "shoulder", 0, 0, 1, "", depends_on=["position:elbow"])
    unknown["parameters"] = [
        {**parameter(f"force {k}", 0.0, f, 0.1, "N·m"), "at": x}
        for k, (x, f) in enumerate(zip(KNOTS, FORCE))
    ]
    return [friction, mass, gravity, unknown]


def figures():
    """`fit`: errors, their curve, channels and a sensor with an odd name."""
    channel = {"before": 0.03, "after": 0.002, "floor": 0.001, "unit": "rad"}
    curve = [
        {"seconds": s, "before": 30 * s + 1, "after": 2 * s + 1, "floor": 1.0}
        for s in np.linspace(0.05, 1, 12)
    ]
    curve[-1]["blown_up"] = {"before": 3, "after": 0, "of": 40}
    held_out = {
        "before": 30.0,
        "after": 2.0,
        "floor": 1.0,
        "horizon_s": 0.3,
        "curve": curve,
        "channels": {f"qpos:{name}": dict(channel) for name in ("shoulder", "elbow")},
        "sensors": {"gyro <1>": {"before": 0.3, "after": 0.02, "noise": 0.01, "unit": "rad/s"}},
    }
    return {"train": {"before": 31.0, "after": 2.0, "floor": 1.0}, "held_out": held_out}


def missing_force(recordings):
    """Courses: at the elbow friction against its velocity, at the shoulder nothing but noise."""
    rng, courses = np.random.default_rng(0), []
    for r in recordings:
        rows = slice(None, None, max(1, len(r.time) // 150))
        for k, joint in enumerate(("shoulder", "elbow")):
            velocity = r.qvel[rows, k]
            force = 0.12 * k * np.sign(velocity) + 0.01 * rng.normal(size=velocity.shape)
            course = {"joint": joint, "recording": r.name, "unit": "N·m", "time": r.time[rows]}
            course |= {"force": force, "sd": np.full(force.shape, 0.01)}
            courses.append(course | {"position": r.qpos[rows, k], "velocity": velocity})
    return courses


def traces(recordings):
    """Recorded and predicted positions; the corrected model's stop now and then."""
    return [
        {
            "recording": r.name,
            "channel": f"qpos:{name}",
            "time": r.time,
            "measured": r.qpos[:, k],
            "nominal": r.qpos[:, k] + 0.1,
            "corrected": np.where(np.arange(len(r.time)) % 30 == 0, np.nan, r.qpos[:, k]),
        }
        for r in recordings
        for k, name in enumerate(("shoulder", "elbow"))
    ]


def ranking():
    """Two candidates; of one no figures are known."""
    elbow = {"kind": "joint", "name": "elbow"}
    world = {"kind": "world", "name": "world"}
    nan = float("nan")
    return [
        {"effect": "coulomb_friction", "place": elbow, "error_removed": 0.6, "p_value": 0.0},
        {"effect": "wind", "place": world, "error_removed": nan, "p_value": nan},
    ]


def example():
    """The diagnosis, with the attributes of the one that the estimator makes."""
    train, held = recordings(2, 0), recordings(1, 5)
    place = {"kind": "joint", "name": "elbow"}
    summary = {
        "format": 2,
        "verdict": "mismatch",
        "noise": {"qpos:shoulder": 0.001, "qpos:elbow": np.float32(0.001)},
        "findings": findings(),
        "fit": figures(),
        "missing_force": missing_force(train),
        "unexplained": {"fraction": 0.05, "place": place, "depends_on": ["position:elbow"]},
        "warnings": ["run5.csv: ctrl:elbow_motor <stays> at its extreme"],
    }
    return types.SimpleNamespace(
        summary=summary,
        corrected_xml=ARM.replace('range="-2.9', 'frictionloss="0.12" range="-2.9'),
        world=types.SimpleNamespace(model=arm()),
        settings={unmodelled.curve(arm(), "shoulder", "position:elbow", KNOTS): FORCE},
        ranking=ranking(),
        traces=traces(held),
        train=train,
        held_out=held,
    )
