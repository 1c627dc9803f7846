"""The model's own sensors beside the joints': what was recorded against what MuJoCo computes.

    errors(world, settings, held_out)                # {sensor: before, after, noise, unit}
    faults(world, settings, train, trajectory)       # findings: a bias, scale or delay of one

Nothing is fitted to them but their own faults, and those only where one explains nearly all that is
left, of sensors of motion: where forces differ it may be the model that is wrong.
"""

import mujoco
import numpy as np

from diagnosis.effects.base import SLIDE
from diagnosis.estimation import windowing
from diagnosis.estimation.ahead import neighbours
from diagnosis.estimation.intervals import one_number
from diagnosis.estimation.readings import behind, difference_noise
from diagnosis.selection import transients
from diagnosis.simulation.rows import RowMap

LEVEL = 1e-3  # false-alarm rate, shared between all sensors and faults
EXPLAINED = 0.8  # of what lies above a sensor's noise, the share that its fault must explain
LATE = 0.1  # s, of a recording, before which a late sensor would read what was before it
TURNS = 4  # Gauss-Newton steps of a fault
SAME = 0.05  # errors closer than this cannot be told apart
QUATERNIONS = int(mujoco.mjtSensor.mjSENS_BALLQUAT), int(mujoco.mjtSensor.mjSENS_FRAMEQUAT)
FAULTS = "sensor_bias", "sensor_scale", "sensor_delay"
MOTION = "rad", "rad/s", "rad/s²", "m", "m/s", "m/s²"
UNITS = {
    "rad": "JOINTPOS",
    "rad/s": "JOINTVEL GYRO BALLANGVEL FRAMEANGVEL",
    "rad/s²": "FRAMEANGACC",
    "m": "TENDONPOS FRAMEPOS RANGEFINDER SUBTREECOM GEOMDIST",
    "m/s": "TENDONVEL VELOCIMETER FRAMELINVEL SUBTREELINVEL",
    "m/s²": "ACCELEROMETER FRAMELINACC",
    "N": "TOUCH FORCE",
    "N·m": "TORQUE",
    "T": "MAGNETOMETER",
    "J": "E_POTENTIAL E_KINETIC",
}


def recorded(model, recordings):
    """[(name, columns of sensordata)] of the sensors that any of the recordings measured."""
    out = []
    for i in range(model.nsensor):
        name, at = model.sensor(i).name or str(i), model.sensor_adr[i]
        if any(np.isfinite(r.sensors[name]).any() for r in recordings if name in r.sensors):
            out.append((name, slice(at, at + model.sensor_dim[i])))
    return out


def unit(model, name):
    """The SI unit of a sensor, "" where it has none or it depends on what it is at."""
    i = model.sensor(name).id
    kind = mujoco.mjtSensor(model.sensor_type[i]).name.removeprefix("mjSENS_")
    told = next((u for u, kinds in UNITS.items() if kind in kinds.split()), "")
    slide = kind in ("JOINTPOS", "JOINTVEL") and model.jnt_type[model.sensor_objid[i]] == SLIDE
    return told.replace("rad", "m") if slide else told


def read(recording, name, width):
    """(T, width) of a sensor as recorded, NaN where it was not."""
    return recording.sensors.get(name, np.full((len(recording.time), width), np.nan))


def noise_of(recordings, name):
    """Usual noise of a sensor's columns."""
    some = [(r.time, x) for r in recordings if name in r.sensors for x in r.sensors[name].T]
    return float(np.median([difference_noise(*each) for each in some]))


def errors(world, settings, recordings):
    """{sensor: {"before", "after", "noise": RMS over windows as of the reported error, "unit"}};
    infinite where it blows up."""
    known, out = recorded(world.model, recordings), {}
    if not known:
        return out
    windows = windowing.cut(recordings, windowing.HORIZON)
    begun = windowing.recorded_starts(world.model, windows)
    run = lambda s: world.simulate([s] * len(windows), *begun, windows, sensors=True)[2][:, 1:-1]
    whole = [w._replace(last=w.last - 1) for w in windows]  # the last control is what follows's
    predicted = {"before": run({}), "after": run(settings)}
    for name, columns in known:
        width = columns.stop - columns.start
        seen = windowing.measured(whole, lambda r: read(r, name, width))[:, 1:]
        here, found = np.isfinite(seen), {}
        if not here.any():
            continue
        for k, shown in predicted.items():
            shown = np.where(np.isfinite(shown[..., columns]), shown[..., columns], np.inf)
            if world.model.sensor(name).type[0] in QUATERNIONS:  # q and -q are the same rotation
                shown = np.where((shown * seen).sum(-1, keepdims=True) < 0, -shown, shown)
            found[k] = float(np.sqrt(np.mean((shown[here] - seen[here]) ** 2)))
        found |= {"noise": noise_of(recordings, name), "unit": unit(world.model, name)}
        out[name] = found
    return out


def faults(world, settings, train, trajectory, event=None):
    """[finding] for every sensor of which one fault explains nearly all that the motion leaves.
    trajectory: of the recordings `train` under the settings: its states are right whatever the
    model lacks. event: in whose time nothing is looked for, or None."""
    known = [k for k in recorded(world.model, train) if unit(world.model, k[0]) in MOTION]
    if not known:
        return []
    shown, rows, out = readings(world, settings, train, trajectory), [], []
    for r in train:
        i = np.array([k for a, b in transients.quiet(r, event) for k in range(a, b)], int)
        rows.append(i[(r.time[i] >= r.time[0] + LATE) & (i < len(r.time) - 1)])
    group, tests = neighbours(sum(map(len, rows))), len(known) * len(FAULTS)
    for name, columns in known:
        width = columns.stop - columns.start
        target = np.concatenate([read(r, name, width)[i] for r, i in zip(train, rows)])

        def predict(measure):
            (offset, ratio, delay), late = measure, []
            for r, i, sensors in zip(train, rows, shown):
                at = lambda x: np.interp(r.time[i] - delay, r.time, x)
                late.append(np.apply_along_axis(at, 0, sensors[:, columns]))
            return ratio * np.concatenate(late) + offset

        fits = [_fitted(world.candidate(fault, name), predict, target, group) for fault in FAULTS]
        fits.sort(key=lambda fit: fit[0])
        noise = noise_of(train, name)
        best, *found = [finding(world.model, fit, noise, tests) for fit in fits]
        if best:
            bound = (1 + SAME) ** 2 * fits[0][0]
            same = [_told(f) for f, fit in zip(found, fits[1:]) if f and fit[0] < bound]
            out.append({**best, "also_possible": same})
    return out


def _told(finding):
    """A finding as it stands in another one's also_possible."""
    keys = "name", "nominal", "value", "unit"
    parameters = [{k: p[k] for k in keys} for p in finding["parameters"]]
    return {"effect": finding["effect"], "place": finding["place"], "parameters": parameters}


def _fitted(candidate, predict, target, group):
    """(squares that a fault leaves at the value that suits it, those without one; rows, candidate,
    value; sums by group (G,) of the squared slope of the readings with the value, and of that slope
    times what is left). predict(measure): readings (n, k); target (n, k); group (n,)."""
    p, measure = candidate.parameters[0], candidate.effect.measure
    value, total = p.nominal, lambda x: np.bincount(group, np.where(here, x, 0.0).sum(1))
    for _ in range(TURNS):
        now = predict(measure((value,)))
        slope, left = (predict(measure((value + p.step,))) - now) / p.step, target - now
        here = np.isfinite(left + slope)
        gram, score = total(slope**2), total(slope * left)
        best, value = value, value + score.sum() / max(gram.sum(), 1e-300)
        value = float(np.clip(value, p.low, p.high))
    bare = target - predict(measure((p.nominal,)))
    squares = total(left**2).sum(), total(bare**2).sum()
    return *squares, here.sum(), candidate, best, gram, score


def readings(world, settings, recordings, trajectory):
    """[(T, nsensordata)] of each recording: what sound sensors show along a smoothed motion under
    the located force; the last row repeats the one before."""
    rows = RowMap(world, recordings, settings)
    true = behind(world.model, settings, recordings, trajectory.qpos, trajectory.qvel)
    qpos, qvel, force = (x[rows.begin] for x in (*true, trajectory.force))
    force = np.nan_to_num(force) + rows.forces(np.arange(len(qpos)), qpos, qvel)
    data, out = mujoco.MjData(rows.model), np.empty((len(qpos), world.model.nsensordata))
    for i in range(len(qpos)):
        data.qpos[:], data.qvel[:], data.act[:] = qpos[i], qvel[i], rows.activation[i]
        data.ctrl[:], data.qfrc_applied[:] = rows.control[i, 0], force[i]
        mujoco.mj_forward(rows.model, data)
        out[i] = data.sensordata[: out.shape[1]]
    ends = np.cumsum([len(r.time) - 1 for r in recordings])[:-1]
    return [np.concatenate([part, part[-1:]]) for part in np.split(out, ends)]


def finding(model, fit, noise, tests):
    """The finding of a sensor's fault, as it was fitted, or None where it is not sure enough of so
    many tests."""
    left, bare, rows, candidate, at, gram, score = fit
    name, p = candidate.place.name, candidate.parameters[0]
    if not bare - left > EXPLAINED * max(bare - rows * noise**2, 0.2 * bare):
        return None
    # as seen from the sound sensor, its slope taken as here
    _, half, chance = one_number(gram, score + gram * (at - p.nominal))
    low, high = at - half, at + half
    if chance * tests > LEVEL or low <= p.nominal <= high:
        return None
    size = unit(model, name) if p.unit == "sensor" else p.unit
    value = {"name": p.name, "nominal": float(p.nominal), "value": at, "unit": size}
    return {
        "effect": candidate.effect.name,
        "place": {"kind": "sensor", "name": name},
        "parameters": [{**value, "low": max(low, p.low), "high": min(high, p.high)}],
        "evidence": {
            "held_out_error_removed": 0.0,
            "sensor_error_removed": float(1 - np.sqrt(left / bare)),
            "p_value": min(chance * tests, 1.0),
        },
        "adequate": True,
        "strains": None,
        "depends_on": [],
        "when": None,
        "written_as": "measurement",
        "also_possible": [],
    }
