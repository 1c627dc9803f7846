"""mujoco.sysid as a tool: every parameter that MJCF holds at once, or the usual ones by BIC.

    python benchmarks/entrants/sysid.py all {model} {recordings} {out}
    python benchmarks/entrants/sysid.py usual {model} {recordings} {out}

"all" fits every field together and names those whose 95 % interval leaves out the nominal value.
"usual" adds masses, armatures, damping, friction and gains one by one while that lowers the BIC.
"""

import logging
import sys
from pathlib import Path

import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

from command_line import words  # noqa: E402
from common import finding, opened, states, write  # noqa: E402
from fields import fields  # noqa: E402
from mujoco import sysid  # noqa: E402

LENGTH = 0.5  # s, of the sequences that are simulated from measured states
MOST = 5  # parameters that BIC may add
ITERATIONS = 10


def observed(spec):
    """A copy of a spec with a sensor for every number of qpos, in its order."""
    spec = spec.copy()
    model, kinds = spec.compile(), mujoco.mjtSensor
    for index in range(model.njnt):
        joint, body = model.joint(index).name, model.body(model.jnt_bodyid[index]).name
        free = model.jnt_type[index] == int(mujoco.mjtJoint.mjJNT_FREE)
        pose = ((kinds.mjSENS_FRAMEPOS, body), (kinds.mjSENS_FRAMEQUAT, body))
        for number, (kind, name) in enumerate(pose if free else [(kinds.mjSENS_JOINTPOS, joint)]):
            place = mujoco.mjtObj.mjOBJ_XBODY if free else mujoco.mjtObj.mjOBJ_JOINT
            spec.add_sensor(name=f"{joint}_{number}", type=kind, objtype=place, objname=name)
    return spec


def sequences(spec, recordings):
    """The recordings as sysid's sequences of LENGTH."""
    spec = observed(spec)
    model = spec.compile()
    names, starts, controls, measured = [], [], [], []
    for number, recording in enumerate(recordings):
        qpos, qvel, _ = states(recording, model)
        rows = int(LENGTH / np.median(np.diff(recording.time)))
        for first in range(2, len(recording.time) - rows, rows):
            part = slice(first, first + rows)
            clock = recording.time[part] - recording.time[first]
            names.append(f"{number}:{first}")
            starts.append(sysid.create_initial_state(model, qpos[first], qvel[first]))
            controls.append(sysid.TimeSeries(clock, recording.ctrl[part]))
            measured.append(sysid.TimeSeries.from_names(clock, recording.qpos[part], model))
    return sysid.ModelSequences("robot", spec, names, starts, controls, measured)


def parameters(chosen):
    """sysid's parameters of some Fields, off their bounds."""
    out = sysid.ParameterDict()
    for field in chosen:
        reach = field.high - field.low
        start = min(max(field.nominal, field.low + 2e-3 * reach), field.high - 2e-3 * reach)
        out.add(
            sysid.Parameter(
                field.key,
                start,
                field.low,
                field.high,
                modifier=lambda spec, p, field=field: field.set(spec, float(p.value[0])),
            )
        )
    return out


def fit(chosen, residual):
    """({key: value}, half-widths (n,), sum of squares, residuals) of a fit of Fields."""
    found, result = sysid.optimize(
        parameters(chosen), residual, optimizer="mujoco", verbose=False, max_iters=ITERATIONS
    )
    left, _, _ = residual(found.as_vector(), found)
    _, half = sysid.calculate_intervals(left, result.jac)
    squares = float(np.sum(np.concatenate([np.ravel(r) for r in left]) ** 2))
    count = sum(np.size(r) for r in left)
    return {key: float(found[key].value[0]) for key in found.keys()}, half, squares, count


def by_bic(candidates, residual):
    """(chosen Fields, values, half-widths): greedy by the gradient's promise, while BIC falls."""
    start = parameters(candidates)
    base, _, _ = residual(start.as_vector(), start)
    base = np.concatenate([np.ravel(r) for r in base])
    columns = []
    for k, field in enumerate(candidates):
        moved, step = start.as_vector(), 1e-3 * (field.high - field.low)
        moved[k] += step
        left, _, _ = residual(moved, start)
        columns.append((np.concatenate([np.ravel(r) for r in left]) - base) / step)
    columns = np.stack(columns, 1)
    chosen, values, half, squares = [], {}, np.zeros(0), float(base @ base)
    for _ in range(MOST):
        inside = columns[:, [candidates.index(f) for f in chosen]]
        clean = lambda y: y - inside @ np.linalg.lstsq(inside, y)[0] if chosen else y
        left = clean(base)
        promise = [
            -1.0 if f in chosen else (left @ clean(c)) ** 2 / max(clean(c) @ clean(c), 1e-30)
            for f, c in zip(candidates, columns.T)
        ]
        more = [*chosen, candidates[int(np.argmax(promise))]]
        trial, widths, after, count = fit(more, residual)
        if count * np.log(after / squares) + np.log(count) >= 0:
            break
        chosen, values, half, squares = more, trial, widths, after
    return chosen, values, half


def main():
    """Fit, name what differs, write the model with it."""
    logging.disable(logging.WARNING)
    args = words(main.__doc__, which={"choices": ("all", "usual"), "help": "of the parameters"})
    if not hasattr(sysid, "build_residual_fn"):
        sys.exit("mujoco.sysid is not installed whole: pip install -r requirements-extras.txt")
    spec, recordings, out = opened(args)
    candidates = fields(spec, usual=args.which == "usual")
    residual = sysid.build_residual_fn(models_sequences=[sequences(spec, recordings)])
    if args.which == "usual":
        chosen, values, half = by_bic(candidates, residual)
    else:
        chosen = candidates
        values, half, _, _ = fit(chosen, residual)
    findings = {}
    for field, width in zip(chosen, half):
        value = values[field.key]
        field.set(spec, value)
        if not np.isfinite(width) or abs(value - field.nominal) <= width:
            continue
        place = (field.effect, field.kind, field.name)
        told = (field.nominal, value, value - float(width), value + float(width))
        findings.setdefault(place, {})[field.parameter] = told
    write(out, spec, [finding(*place, told) for place, told in findings.items()])


if __name__ == "__main__":
    main()
