"""next.csv and next.png: an excitation to record, and what it is expected to show."""

import importlib.util
import io
import os

import numpy as np

from diagnosis.common.atomic_files import write_together
from diagnosis.design.explanations import Open, single
from diagnosis.design.optimal import Excitation, design
from diagnosis.recordings.layout import joint_of


def write_next(folder: str, seconds: float, kp=None, kd=None) -> str:
    """Design the next recording of a report's folder, write next.csv and, where matplotlib is
    installed, next.png there; what to say of them. Raises DesignError, WriteError."""
    left = Open.read(folder, kp, kd)
    best = design(left, seconds)
    files = {"next.csv": table(best, left.world.model, left.followed)}
    if importlib.util.find_spec("matplotlib"):
        files["next.png"] = picture(best, left.world.model)
    write_together({os.path.join(folder, name): data for name, data in files.items()})
    drawn = os.path.join(folder, "next.png")
    drawn = drawn if "next.png" in files else "a picture needs the extra [next], matplotlib"
    return words(best, left.world.model, os.path.join(folder, "next.csv"), drawn)


def table(best: Excitation, model, followed=()) -> str:
    """CSV of time and controls, or of targets for the joints `followed`."""
    names = []
    for a in range(model.nu):
        joint = joint_of(model, a) if a < model.nactuator else None
        names.append(f"target:{joint}" if joint in followed else f"ctrl:{model.actuator(a).name}")
    rows = np.column_stack([best.time, best.ctrl])
    lines = [",".join(["time", *names])]
    return "\n".join(lines + [",".join(f"{x:.9g}" for x in row) for row in rows]) + "\n"


def ratio(nats: float) -> str:
    """A ratio of evidence in words: what the sensors' noise alone would leave in doubt."""
    if nats < 1:
        return "about 1 to one: nothing that was tried within these limits tells them apart"
    return "over a billion to one" if nats > 9 * np.log(10) else f"{np.exp(nats):.2g} to one"


def words(best: Excitation, model, file: str, drawn: str) -> str:
    """What to do, and what is expected of it."""
    joints = single(model)
    columns = [model.jnt_qposadr[model.joint(joint).id] for joint in joints]
    places = zip(joints, best.start_qpos[columns])
    at = ", ".join(f"{joint} {place:.3g}" for joint, place in places)
    lines = [
        f"Record this next: {best.time[-1] + best.time[1]:.3g} s of controls in {file}, from rest "
        f"where the first recording began ({at})."
    ]
    if best.nats is not None:
        lines += [
            f"  It is to tell apart: {'; '.join(best.names)}",
            f"  Expected ratio of evidence, of the two hardest to tell apart: {ratio(best.nats)}",
        ]
    for name, (value, error, unit) in best.errors.items():
        lines.append(f"  {name} {value:.3g} would be known to ± {1.96 * error:.2g} {unit}")
    lines.append(f"  Motion expected under each explanation: {drawn}")
    return "\n".join(lines)


def picture(best: Excitation, model) -> bytes:
    """A PNG of the controls and of the motion under each explanation."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    joints = single(model)
    panels = model.nu + len(joints)
    figure, axes = pyplot.subplots(
        panels, 1, sharex=True, figsize=(9, 1.2 + 1.6 * panels), squeeze=False
    )
    for a, axis in zip(range(model.nu), axes[:, 0]):
        axis.plot(best.time, best.ctrl[:, a], color="black", linewidth=1)
        axis.set_ylabel(f"control of\n{model.actuator(a).name}")
    for j, axis in zip(range(len(joints)), axes[model.nu :, 0]):
        for name, motion in zip(best.names, best.motions):
            axis.plot(best.time, motion[:, j], linewidth=1, label=name)
        axis.set_ylabel(f"position of\n{joints[j]}")
    if best.nats is not None:
        axes[model.nu, 0].legend(fontsize=8, loc="upper right")
        figure.suptitle(f"Expected ratio of evidence: {ratio(best.nats)}", fontsize=11)
    axes[-1, 0].set_xlabel("time, s")
    figure.tight_layout()
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=80)
    pyplot.close(figure)
    return stream.getvalue()
