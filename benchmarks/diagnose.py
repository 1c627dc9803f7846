"""Time a diagnosis: of a two-joint arm beside mujoco.sysid, and of Hopper.

    python benchmarks/diagnose.py [--seconds 30]        # -> results/diagnose.csv

Hidden in the arm: Coulomb friction in the elbow. sysid fits all its candidates at once: it is told
which (mass, armature, damping, frictionloss: eight parameters), true start velocities and
one-second sequences; the diagnosis is told nothing. mujoco.sysid needs extra packages
(requirements-extras.txt); without them only the diagnosis is timed. Hidden in Hopper: a torso 27 %
heavier, in falls of 1.5 s each. Seconds are those of the clock, and of all threads together.
"""

import argparse
import itertools
import sys
import time
from pathlib import Path

import mujoco
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from diagnosis.command import diagnose  # noqa: E402
from diagnosis.common.atomic_files import write_table  # noqa: E402
from diagnosis.recordings.recording import Recording  # noqa: E402
from envs import model_path  # noqa: E402

ARM = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <default>
    <geom contype="0" conaffinity="0"/>
    <joint axis="0 1 0" damping="0.05" armature="0.01"/>
  </default>
  <worldbody>
    <body name="upper">
      <joint name="shoulder"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.35" size=".03" mass="1"/>
      <body name="fore" pos="0 0 -.35">
        <joint name="elbow"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".025" mass=".6"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="a" joint="shoulder"/>
    <motor name="b" joint="elbow"/>
  </actuator>
  <sensor>
    <jointpos name="shoulder_pos" joint="shoulder"/>
    <jointpos name="elbow_pos" joint="elbow"/>
  </sensor>
</mujoco>"""
NOISE, FRICTION, HEAVIER = 5e-4, 0.1, 1.27
FALL = 1.5  # s
COLUMNS = "system method parameter value low high truth seconds cpu_seconds".split()


def arm(seconds, seed):
    """(Recording, true qvel) of the arm with Coulomb friction in the elbow."""
    spec = mujoco.MjSpec.from_string(ARM)
    elbow = spec.joint("elbow")
    elbow.frictionloss, elbow.solref_friction[:], elbow.solimp_friction[:3] = (
        FRICTION,
        [0.004, 1],
        [0.999, 0.9999, 0.001],
    )
    return run(spec.compile(), seconds, seed, 0.01, [1.0, 0.4])


def hopper(seconds, seed):
    """(Recording, true qvel) of a fall of Hopper with a heavy torso."""
    model = mujoco.MjModel.from_xml_path(str(model_path("Hopper-v4")))
    torso = model.body("torso").id
    model.body_mass[torso] *= HEAVIER
    model.body_inertia[torso] *= HEAVIER
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return run(model, seconds, seed, 0.008, [0.2, 0.2, 0.2])


def run(model, seconds, seed, interval, strength):
    """(Recording of noisy positions, true qvel) of a model driven by sines of some strength
    (nu,)."""
    rng, data, rows = np.random.default_rng(seed), mujoco.MjData(model), round(seconds / interval)
    clock, tones = interval * np.arange(rows), (3, model.nu)
    ctrl = np.array([strength]) * np.sin(
        2 * np.pi * clock[:, None, None] * rng.uniform(0.2, 1.5, tones) + rng.uniform(0, 6, tones)
    ).sum(1)
    qpos, qvel = np.empty((rows, model.nq)), np.empty((rows, model.nv))
    for t in range(rows):
        qpos[t], qvel[t], data.ctrl[:] = data.qpos, data.qvel, ctrl[t]
        mujoco.mj_step(model, data, round(interval / model.opt.timestep))
    return Recording(
        f"run{seed}.csv",
        clock,
        qpos + NOISE * rng.normal(size=qpos.shape),
        np.full_like(qvel, np.nan),
        ctrl,
        {},
    ), qvel


def sysid_parameters(sysid):
    """The eight parameters of the arm that mujoco.sysid is told to fit."""
    parameters = sysid.ParameterDict()

    def add(name, nominal, low, high, modify):
        bounds = {"min_value": low, "max_value": high}
        parameters.add(sysid.Parameter(name, nominal=nominal, **bounds, modifier=modify))

    for body, nominal in (("upper", 1.0), ("fore", 0.6)):

        def weigh(spec, parameter, body=body):
            spec.body(body).geoms[0].mass = parameter.value[0]

        add(f"mass {body}", nominal, 0.1, 5.0, weigh)
    # friction that starts at 0 would not move
    fields = (("armature", 0.01), ("damping", 0.05), ("frictionloss", 0.01))
    for joint, (field, nominal) in itertools.product(("shoulder", "elbow"), fields):

        def modify(spec, parameter, joint=joint, field=field):
            if field == "damping":
                spec.joint(joint).damping[0] = parameter.value[0]
            else:
                setattr(spec.joint(joint), field, parameter.value[0])

        add(f"{field} {joint}", nominal, 0.0, 2.0, modify)
    return parameters


def with_sysid(recording, qvel, chunk=100):
    """{parameter: value} by mujoco.sysid from the same rows, or None where it is not installed."""
    from mujoco import sysid

    if not hasattr(sysid, "optimize"):
        return None
    spec, parameters = mujoco.MjSpec.from_string(ARM), sysid_parameters(sysid)
    model, names, starts, controls, sensors = spec.compile(), [], [], [], []
    for first in range(0, len(recording.time) - chunk, chunk):
        rows = slice(first, first + chunk)
        clock = recording.time[rows] - recording.time[first]
        names.append(f"rows{first}")
        starts.append(sysid.create_initial_state(model, recording.qpos[first], qvel[first]))
        controls.append(sysid.TimeSeries(clock, recording.ctrl[rows]))
        sensors.append(sysid.TimeSeries.from_names(clock, recording.qpos[rows], model))
    sequences = sysid.ModelSequences("arm", spec, names, starts, controls, sensors)
    found, _ = sysid.optimize(
        initial_params=parameters,
        residual_fn=sysid.build_residual_fn(models_sequences=[sequences]),
        optimizer="mujoco",
        verbose=False,
    )
    return {name: float(found[name].value[0]) for name in found.keys()}


def spent():
    """Seconds of the clock and of the processor, so far."""
    return np.array([time.monotonic(), time.process_time()])


def times(took):
    return dict(zip(("seconds", "cpu_seconds"), took.round(1).tolist()))


def diagnosed(system, model, train, held_out):
    """Rows of what a diagnosis finds."""
    begun = spent()
    found = diagnose(model, train, held_out).summary["findings"]
    took = spent() - begun
    return [
        {
            "system": system,
            "method": "diagnose",
            "parameter": f"{p['name']} {f['place']['name']}",
            **{k: p[k] for k in ("value", "low", "high")},
            **times(took),
        }
        for f in found
        for p in f["parameters"]
    ]


def sysid_rows(recording, qvel):
    """Rows of what mujoco.sysid finds in the arm; none where it fails."""
    begun = spent()
    try:
        found = with_sysid(recording, qvel)
    # an optional package: that it fails is a result, not a fault of ours
    except Exception as error:
        found = None
        print(f"mujoco.sysid failed: {type(error).__name__}: {error}", file=sys.stderr)
    same = {"system": "two-joint arm", "method": "sysid", **times(spent() - begun)}
    return [{**same, "parameter": name, "value": value} for name, value in (found or {}).items()]


def truths():
    """{parameter and place: true value} of both systems."""
    torso = mujoco.MjModel.from_xml_path(str(model_path("Hopper-v4"))).body("torso").mass[0]
    friction = {"frictionloss shoulder": 0.0, "frictionloss elbow": FRICTION}
    masses = {"mass upper": 1.0, "mass fore": 0.6, "mass torso": HEAVIER * torso}
    nominal = (("armature", 0.01), ("damping", 0.05))
    joints = itertools.product(("shoulder", "elbow"), nominal)
    return friction | masses | {f"{field} {joint}": value for joint, (field, value) in joints}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=30.0, help="of recorded motion, in all")
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "diagnose.csv")
    options = parser.parse_args()
    train, qvel = arm(0.7 * options.seconds, 0)
    falls = [hopper(FALL, i)[0] for i in range(round(options.seconds / FALL))]
    number = round(0.7 * len(falls))
    rows = diagnosed(
        "two-joint arm", mujoco.MjSpec.from_string(ARM), [train], [arm(0.3 * options.seconds, 1)[0]]
    )
    rows += sysid_rows(train, qvel)
    rows += diagnosed("Hopper", "Hopper-v4", falls[:number], falls[number:])
    truth = truths()
    options.out.parent.mkdir(exist_ok=True)
    rows = [{**row, "truth": truth.get(row["parameter"])} for row in rows]
    short = lambda value: f"{value:.5g}" if isinstance(value, float) else value
    write_table(options.out, COLUMNS, [{k: short(v) for k, v in row.items()} for row in rows])
    print(options.out.read_text())


if __name__ == "__main__":
    main()
