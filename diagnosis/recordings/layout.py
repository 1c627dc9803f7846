"""How a file's own columns become those of the model.

    plan = Layout().plan(path, header, natural, model)
    columns, gains = plan.apply(path, raw, model)

Beside the model's own columns a file may name, joint by joint, `effort:<joint>` (torque or force at
the joint), `target:<joint>` (where its position controller is told to go) and `kp:<joint>`,
`kd:<joint>` (that controller's gains): the control of the actuator on that joint follows from them.
Every fault raises RecordingError with one line: file, row, column, and what to do.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import mujoco
import numpy as np

from diagnosis.recordings.columns import GAINS, WIDTHS, Names, RecordingError, columns_of

HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)


class Source(NamedTuple):
    """Where a column comes from: `offset + scale * file's column`; column None: `offset` in every
    row."""

    column: str | None
    scale: float = 1.0
    offset: float = 0.0


class Raw(NamedTuple):
    """One run as its file has it.

    label: for messages; name: of the recording; columns: {the file's own name: (T,) float64};
    natural: {our name: the file's own}, as its format implies; first_row: what the file's own
    reader calls the row of columns[...][0]; notes.
    """

    label: str
    name: str
    columns: dict
    natural: dict
    first_row: int = 0
    notes: tuple = ()


@dataclass(frozen=True)
class Layout:
    """How the user says that files are to be read.

    label: of the map's file, for messages; columns: {our name: Source}, ahead of what the format
    implies; joints: {model's joint: its name in the files}; ros: topics of ROS 2 bags, {"topic",
    "targets", "joints"}; degrees: hinges' positions, velocities and targets are in degrees; gains:
    the joints whose motors follow position targets (--kp).
    """

    label: str = ""
    columns: Mapping[str, Source] = field(default_factory=dict)
    joints: Mapping[str, str] = field(default_factory=dict)
    ros: Mapping[str, object] = field(default_factory=dict)
    degrees: bool = False
    gains: frozenset[str] = frozenset()

    @property
    def mapped(self) -> bool:
        """Whether the user names columns: then those that he does not name are of no interest."""
        return bool(self.columns or self.joints)

    def renamed(self, natural: Mapping[str, str]) -> dict:
        """What the format implies, with the files' joints under the model's names."""
        theirs = {name: joint for joint, name in self.joints.items()}
        out = {}
        for ours, column in natural.items():
            kind, _, place = ours.partition(":")
            out[f"{kind}:{theirs[place]}" if place in theirs else ours] = column
        return out

    def plan(
        self, path: str, header: Iterable[str], natural: Mapping[str, str], model: mujoco.MjModel
    ) -> "Plan":
        """Which of the file's columns makes which of the model's.

        Raises RecordingError on unknown, repeated or missing ones.
        """
        names, header = Names(model), list(header)
        sources = {}
        self._check_joints(path, natural, model)
        for wish, source in self.columns.items():
            ours = names.canonical(wish)
            if ours is None:
                raise RecordingError(f"{self.label}: {wish!r}: {names.unknown(wish)}")
            if source.column is not None and source.column not in header:
                raise RecordingError(
                    f"{path}: column {source.column!r}, which {self.label} names for {wish!r}, is "
                    f"not in "
                    f"the file; it has {_few(header)}"
                )
            sources[ours] = source
        taken = {source.column for source in sources.values()}
        for wish, column in self.renamed(natural).items():
            ours = names.canonical(wish)
            if ours in sources or column in taken:
                continue
            if ours is not None:
                sources[ours] = Source(column)
        foreign = self.mapped or any(ours != column for ours, column in natural.items())
        return Plan(self, _with_controls(path, sources, header, model, self, foreign))

    def _check_joints(self, path, natural, model):
        """Raises RecordingError where [joints] names one that the model or the file does not
        have."""
        ours = {model.joint(j).name or str(j) for j in range(model.njnt)}
        theirs = {name.partition(":")[2] for name in natural if ":" in name}
        for joint, name in self.joints.items():
            if joint not in ours:
                raise RecordingError(
                    f"{self.label}: [joints] {joint!r}: the model has no such joint; it has "
                    f"{_few(sorted(ours))}"
                )
            if name not in theirs:
                raise RecordingError(
                    f"{path}: joint {name!r}, which {self.label} names for {joint!r}, is not in "
                    f"the file; it has "
                    f"{_few(sorted(theirs))}"
                )


def _few(names):
    """The first names of a list, in words."""
    names = list(names)
    return ", ".join(repr(n) for n in names[:12]) + (", ..." if len(names) > 12 else "")


def _with_controls(path, sources, header, model, layout, foreign):
    """The sources with one for every control that follows from an effort or a target. Raises
    RecordingError on what is missing."""
    sources = dict(sources)
    _complete(path, sources, ("time", "qpos:"), header, model, foreign)
    known = columns_of(model)
    for a in range(model.nactuator):
        control = f"ctrl:{model.actuator(a).name or a}"
        if control in sources or control not in known:
            continue
        joint = joint_of(model, a)
        if joint is None:
            continue
        servo = is_servo(model, a)
        if not (servo or is_motor(model, a)):
            continue
        gear = float(model.actuator_gear[a, 0])
        target, effort = sources.get(f"target:{joint}"), sources.get(f"effort:{joint}")
        if target and (servo or joint in layout.gains or f"kp:{joint}" in sources):
            factor = gear if servo else 1.0
            sources[control] = target._replace(
                scale=target.scale * factor, offset=target.offset * factor
            )
        elif effort and not servo:
            if joint in layout.gains or f"kp:{joint}" in sources:  # its control is a position then
                raise RecordingError(
                    f"{path}: with --kp or 'kp:{joint}' the control of {model.actuator(a).name!r} "
                    f"is a target, and nothing in the file is one; add 'target:{joint}', or leave "
                    f"the gains out: 'effort:{joint}' is a torque"
                )
            factor = 1 / (gear * float(model.actuator_gainprm[a, 0]))
            sources[control] = effort._replace(
                scale=effort.scale * factor, offset=effort.offset * factor
            )
        elif target:
            raise RecordingError(
                f"{path}: 'target:{joint}' is a position and {model.actuator(a).name!r} a motor; "
                f"give --kp and "
                "--kd, the gains of the controller that follows it"
            )
        elif effort:
            raise RecordingError(
                f"{path}: 'effort:{joint}' is a torque and {model.actuator(a).name!r} a position "
                f"servo; give "
                "its targets, or a model with motors"
            )
    _complete(path, sources, "ctrl:", header, model, foreign)
    return sources


def _complete(path, sources, kinds, header, model, foreign):
    """Raises RecordingError where a column of these kinds has no source."""
    for name in ["time", *columns_of(model)]:
        if name not in sources and name.startswith(kinds):
            hint = (
                "filled with nan if that joint was not measured"
                if name.startswith("qpos:")
                else "the simulation cannot be driven without it"
                if name.startswith("ctrl:")
                else "seconds, increasing"
            )
            if not foreign:
                raise RecordingError(
                    f"{path}: column {name!r} is missing from the header; add it ({hint})"
                )
            raise RecordingError(
                f"{path}: {name!r} is missing, and nothing in the file becomes it; it has "
                f"{_few(header)}; say which with --map ({hint})"
            )


def joint_of(model: mujoco.MjModel, actuator: int) -> str | None:
    """The name of the hinge or slide that an actuator acts on by itself, or None."""
    if model.actuator_trntype[actuator] not in (
        int(mujoco.mjtTrn.mjTRN_JOINT),
        int(mujoco.mjtTrn.mjTRN_JOINTINPARENT),
    ):
        return None
    j = model.actuator_trnid[actuator, 0]
    return None if model.jnt_type[j] in WIDTHS else model.joint(j).name or str(j)


def is_servo(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator pulls towards a position that its control names."""
    return bool(model.actuator_biasprm[actuator, 1] != 0)


def is_motor(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator's force is its control times a constant."""
    return bool(
        model.actuator_gaintype[actuator] == int(mujoco.mjtGain.mjGAIN_FIXED)
        and model.actuator_dyntype[actuator] == int(mujoco.mjtDyn.mjDYN_NONE)
        and model.actuator_gainprm[actuator, 0] != 0
        and not model.actuator_biasprm[actuator, :3].any()
    )


@dataclass(frozen=True)
class Plan:
    """sources: {our column: Source in the file}, complete for one model."""

    layout: Layout
    sources: Mapping[str, Source]

    def apply(self, path: str, raw: Mapping[str, np.ndarray], model: mujoco.MjModel):
        """({our column: (T,) float64, SI}, {joint: {"kp": ..., "kd": ...}}) from the file's own
        columns."""
        rows = len(next(iter(raw.values())))
        known, columns, gains = columns_of(model), {}, {}
        turning = self._turning(model) if self.layout.degrees else ()
        for name, source in self.sources.items():
            if source.column is None:
                values = np.full(rows, source.offset)
            else:
                values = np.asarray(raw[source.column], dtype=float)
                if (source.scale, source.offset) != (1, 0):
                    values = source.scale * values + source.offset
            if name in turning:
                values = np.deg2rad(values)
            kind, _, joint = name.partition(":")
            if kind in GAINS:
                gains.setdefault(joint, {})[kind] = _constant(path, name, values)
            elif name == "time" or name in known:
                columns[name] = values
        return columns, gains

    def doubts(self, columns: Mapping[str, np.ndarray]) -> tuple[str, ...]:
        """What looks wrong about the units that the user gave, one line each."""
        if not self.layout.degrees:
            return ()
        largest = [np.nanmax(np.abs(v)) for n, v in columns.items() if n.startswith("qpos:")]
        if max(largest, default=1.0) < np.deg2rad(2 * np.pi):
            return ("no position leaves ±6.3 degrees; were they in rad, --degrees is wrong",)
        return ()

    def _turning(self, model):
        """The columns that are angles or their rates: of hinges, and the controls that are targets
        of theirs."""
        hinges = {
            model.joint(j).name or str(j) for j in range(model.njnt) if model.jnt_type[j] == HINGE
        }
        out = {f"{kind}:{joint}" for joint in hinges for kind in ("qpos", "qvel")}
        for a in range(model.nactuator):
            joint = joint_of(model, a)
            followed = joint in self.layout.gains or f"kp:{joint}" in self.sources
            if joint in hinges and (is_servo(model, a) or is_motor(model, a) and followed):
                out.add(f"ctrl:{model.actuator(a).name or a}")
        return out


def _constant(path, name, values):
    """The one value of a gain's column. Raises RecordingError where it changes or is none."""
    values = values[~np.isnan(values)]
    if not len(values) or values.min() < 0 or not np.isfinite(values).all():
        raise RecordingError(f"{path}: column {name!r}: a gain has to be a number from 0 upwards")
    if np.ptp(values) > 1e-9 * np.abs(values).max():
        raise RecordingError(
            f"{path}: column {name!r} changes from {values[0]:g} to "
            f"{values[np.argmax(values != values[0])]:g}; one "
            "run has one gain: put the parts into files of their own, and diagnose each gain by "
            "itself"
        )
    return float(values[0])
