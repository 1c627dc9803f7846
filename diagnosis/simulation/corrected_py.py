"""corrected.py: a script beside corrected.xml that adds what MJCF cannot hold, with numpy and
mujoco alone.

    parts = python_parts(world.model, setting)      # [] where corrected.xml alone holds it
    text = corrected_py(parts, joints)              # of report/corrected.py, say
    rows = predictions("report/corrected.py", windows, world.model)  # in a process of its own
    step = module_of(parts, joints).step            # step(model, data, nstep) in this process
    batch = CorrectedBatch(model, 64, parts=parts)  # many environments at once, for training

The script is diagnosis/simulation/corrected_template.py with the laws that are needed, and the
numbers.
"""

import ast
import json
import os
import pprint
import subprocess
import sys
import tempfile
import types
from pathlib import Path

import mujoco
import numpy as np
from mujoco.batch import Batch

from diagnosis.effects import EFFECTS
from diagnosis.effects.base import Part
from diagnosis.simulation import corrected_template

TEMPLATE = Path(corrected_template.__file__)
TABLES = ("FRICTION", "FORCE", "DRIVE", "CONTROL")
SECONDS = 600.0  # a prediction may take


class ScriptError(ValueError):
    """A corrected.py that does not run. One line: which, and what it said."""


def python_parts(model, setting, written=None):
    """The Parts of a setting {Candidate: values} for corrected.py, in the order of the catalogue.

    model: the nominal MjModel. written: where each effect is held, as World.corrected_xml told;
    without it every effect with a part counts. What acts under a condition has no part.
    """
    order = {effect: k for k, effect in enumerate(EFFECTS)}
    parts = []
    for candidate, values in sorted(
        setting.items(), key=lambda item: order.get(item[0].effect, len(order))
    ):
        left = written is None or written.get(candidate) == "python"
        if left and not candidate.when and tuple(values) != candidate.nominal:
            i = candidate.effect.id(model, candidate.place.name)
            part = candidate.effect.part(model, i, values)
            parts += [part] if isinstance(part, Part) else list(part or ())
    moved = {
        c.place.name: values[0]
        for c, values in setting.items()
        if c.effect.name == "sensor_bias" and (written or {}).get(c) == "mjcf"
    }
    late = {"delay": 1, "lag": 2}  # of what the others leave
    parts = [_as_read(part, moved) for part in parts]
    return sorted(parts, key=lambda part: late.get(part.law, 0))


def _as_read(part, moved):
    """A Part over the true position of a joint, over that which corrected.xml has where a sensor's
    bias {joint: offset} is written: it reads so much more."""
    numbers = dict(part.numbers)
    of = numbers.get("of", f"position:{part.place}")
    by = moved.get(of.removeprefix("position:"), 0.0) if of.startswith("position:") else 0.0
    if by and "phase" in numbers:
        numbers["phase"] -= numbers["waves"] * by
    if by and "knots" in numbers:
        numbers["knots"] = [x + by for x in numbers["knots"]]
    return part._replace(numbers=numbers)


def corrected_py(parts, joints, xml_name="corrected.xml"):
    """The script's text: for Parts, the names of the recorded joints in order, and the MJCF file
    beside it."""
    source = TEMPLATE.read_text(encoding="utf-8")
    used = {part.law for part in parts}
    unknown = used - set().union(*(getattr(corrected_template, table) for table in TABLES))
    if unknown:
        raise ValueError(f"corrected.py has no law {sorted(unknown)[0]!r}")
    replaced = {
        "XML": f"XML = Path(__file__).with_name({json.dumps(xml_name)})",
        "JOINTS": _literal("JOINTS", list(joints)),
        "PARTS": _literal("PARTS", [tuple(part) for part in parts]),
    }
    for table in TABLES:
        laws = [law for law in getattr(corrected_template, table) if law in used]
        names = ", ".join(laws) + ("," if len(laws) == 1 else "")
        whole = f"{table} = {{f.__name__: f for f in ({names})}}"
        replaced[table] = whole if laws else f"{table} = {{}}"
    return _pruned(source, replaced)


def _literal(name, value):
    """An assignment that reads well."""
    text = pprint.pformat(value, width=96 - len(name), sort_dicts=False)
    return f"{name} = " + (text if '"' in text else text.replace("'", '"'))


def _pruned(source, replaced):
    """The source with statements {name: text} exchanged, and functions that nothing mentions any
    more left out."""
    tree, lines = ast.parse(source), source.splitlines()
    blocks, end = [], 0  # (name or None, what stands above it, text)
    for node in tree.body:
        name = getattr(node, "name", None)
        if isinstance(node, ast.Assign):
            name = getattr(node.targets[0], "id", None)
        above, text = (
            lines[end : node.lineno - 1],
            "\n".join(lines[node.lineno - 1 : node.end_lineno]),
        )
        text = replaced.get(name, text)
        blocks.append([name, above, text, isinstance(node, ast.FunctionDef)])
        end = node.end_lineno
    laws = {law for table in TABLES for law in getattr(corrected_template, table)}
    helpers = {"variable", "asked", "factor_of", "drive", "drives"}
    while True:
        texts = [b[2] for b in blocks]
        mentioned = set()
        for block, text in zip(blocks, texts):
            names = {n.id for n in ast.walk(ast.parse(text)) if isinstance(n, ast.Name)}
            mentioned |= names - {block[0]}
        gone = [b for b in blocks if b[3] and b[0] in laws | helpers and b[0] not in mentioned]
        if not gone:
            break
        for block in gone:  # a heading above it stays for the next function, if it has none
            following = blocks[blocks.index(block) + 1]
            if following[3] and not any(line.startswith("#") for line in following[1]):
                following[1] = block[1]
            blocks.remove(block)
    out = [line for block in blocks for line in (*block[1], block[2])]
    return "\n".join(out) + "\n"


RUNNER = """
import importlib.util, sys, numpy as np
spec = importlib.util.spec_from_file_location("corrected", sys.argv[1])
script = importlib.util.module_from_spec(spec)
spec.loader.exec_module(script)
model, given, out = script.load()[0], np.load(sys.argv[2], allow_pickle=False), {}
for k in range(int(given["count"])):
    row = {name: given[f"{name}{k}"] for name in ("time", "qpos", "qvel", "ctrl", "windows")}
    for number, qpos in zip(given[f"numbers{k}"], script.predict(model, **row)):
        out[str(number)] = qpos
np.savez(sys.argv[3], **out)
"""


def predictions(script, windows, model):
    """What a corrected.py predicts in Windows, [(rows, nq)], worked out by importing it in another
    process.

    model: the nominal MjModel, whose coordinates the recordings have. Velocities that were not
    measured are differences of the rows around. Raises ScriptError.
    """
    recordings = list(dict.fromkeys(w.recording for w in windows))
    given = {"count": len(recordings)}
    for k, recording in enumerate(recordings):
        own = [n for n, w in enumerate(windows) if w.recording is recording]
        rows = [(windows[n].first, windows[n].last) for n in own]
        velocity = np.where(
            np.isfinite(recording.qvel), recording.qvel, _differences(model, recording)
        )
        arrays = recording.time, recording.qpos, velocity, recording.ctrl, rows, own
        names = "time", "qpos", "qvel", "ctrl", "windows", "numbers"
        given |= {f"{name}{k}": np.asarray(array) for name, array in zip(names, arrays)}
    with tempfile.TemporaryDirectory() as folder:
        there, back = os.path.join(folder, "given.npz"), os.path.join(folder, "out.npz")
        np.savez(there, **given)
        command = [sys.executable, "-I", "-c", RUNNER, os.path.abspath(script), there, back]
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, timeout=SECONDS, cwd=folder, check=False
            )
        except subprocess.TimeoutExpired:
            raise ScriptError(f"{script}: no prediction within {SECONDS:.0f} s") from None
        if done.returncode:
            said = (done.stderr.strip().splitlines() or ["nothing"])[-1]
            raise ScriptError(f"{script} does not run: {said}")
        with np.load(back, allow_pickle=False) as out:
            return [out[str(n)] for n in range(len(windows))]


def _differences(model, recording):
    """Central differences (T, nv) of a Recording's positions."""
    count, out = len(recording.time), np.full((len(recording.time), model.nv), np.nan)
    for k in range(count):
        a, b = max(k - 1, 0), min(k + 1, count - 1)
        if b > a:
            seconds = recording.time[b] - recording.time[a]
            mujoco.mj_differentiatePos(model, out[k], seconds, recording.qpos[a], recording.qpos[b])
    return out


def module_of(parts, joints=()):
    """The script as a module, with its functions; nothing is written."""
    module = types.ModuleType("corrected")
    module.__file__ = str(TEMPLATE)
    exec(compile(corrected_py(parts, joints), "corrected.py", "exec"), module.__dict__)
    return module


def parts_in(text):
    """The Parts of a corrected.py, read from its text without running it; [] of no text.

    Raises ScriptError.
    """
    if not text:
        return []
    try:
        (value,) = (
            ast.literal_eval(node.value)
            for node in ast.parse(text).body
            if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "PARTS"
        )
        return [Part(*part) for part in value]
    except (ValueError, SyntaxError, TypeError):
        raise ScriptError("not a corrected.py: it has no PARTS to read") from None


class BatchLook:
    """What the laws see of all the simulations of a mujoco Batch: as corrected_template.Look,
    (nsim,)."""

    def __init__(self, batch):
        self.batch, self.model = batch, batch.model
        self.time, self.step = batch.bind("time").copy(), batch.model.opt.timestep
        names = ("qpos", "qvel", "ctrl", "qfrc_bias", "actuator_force")
        self._state = {name: batch.bind(name) for name in names}

    def position(self, joint):
        return self._state["qpos"][:, self.model.joint(joint).qposadr[0]]

    def velocity(self, joint):
        return self._state["qvel"][:, self.model.joint(joint).dofadr[0]]

    def bias(self, joint):
        return self._state["qfrc_bias"][:, self.model.joint(joint).dofadr[0]]

    def force(self, actuator):
        return self._state["actuator_force"][:, self.model.actuator(actuator).id]

    def control(self, actuator):
        if self.model.actuator(actuator).actadr[0] >= 0:
            raise ValueError(f"actuator {actuator}: a batch does not tell its filtered control")
        return self.command(actuator)

    def command(self, actuator):
        a = self.model.actuator(actuator).id
        u, value = (
            self.model.actuator_ctrladr[a],
            self._state["ctrl"][:, self.model.actuator_ctrladr[a]],
        )
        if self.model.actuator_delay[a] > 0:
            raise ValueError(f"actuator {actuator}: a batch does not tell its delayed control")
        limited = self.model.actuator_ctrllimited[u]
        return np.clip(value, *self.model.actuator_ctrlrange[u]) if limited else value


class CorrectedBatch(Batch):
    """A mujoco Batch of corrected.xml whose steps add what corrected.py does, for training.

    batch = CorrectedBatch(model, nsim=64, parts=parts_in(text))      # and then as any Batch

    Joints whose friction varies get a dof_frictionloss of each simulation's own. step() raises
    ValueError for a force over the control of an actuator with a delay or the filter of a lag.
    """

    def __init__(self, model, nsim, nthread=0, parts=()):
        super().__init__(model, nsim, nthread)
        self._parts, self.memory = list(parts), {}  # of the laws of control
        self._script = module_of(self._parts)
        dry = any(part.law in self._script.FRICTION for part in self._parts)
        self._loss = self.expand("dof_frictionloss") if dry else None

    def recall(self, batch, times=1):
        """Take over what has reached the drives of another batch, of each of its simulations so
        many times."""
        repeated = lambda x: np.repeat(x, times) if np.ndim(x) else x
        self.memory = {
            part: {law: tuple(map(repeated, kept)) for law, kept in laws.items()}
            for part, laws in batch.memory.items()
        }

    def step(self, ids=None, nstep=1, stage=0):
        """As Batch.step, with the corrections worked out at the beginning of each step."""
        if not self._parts:
            super().step(ids, nstep, stage)
            return
        ctrl, pushed = self.bind("ctrl"), self.bind("qfrc_applied")
        wanted, before = ctrl.copy(), pushed.copy()
        for k in range(nstep):
            look = BatchLook(self)
            ctrl[:] = self._script.controls(self.model, look, wanted, self.memory)
            if self._loss is not None:
                self._loss[:] = self.model.dof_frictionloss
            self.forward(ids)
            force, level = self._script.corrections(self.model, look)
            for dof, value in force:
                pushed[:, dof] += value
            for dof, value in level:
                self._loss[:, dof] += value
            super().step(ids, 1, stage if k == nstep - 1 else 0)
            ctrl[:], pushed[:] = wanted, before
