"""Who predicts a real machine best? results/contest.csv, docs/contest.png, docs/contest.md.

    python benchmarks/contest.py [--recordings ../shared/recordings] [--only go2_leg] [--by sysid]
    python benchmarks/contest.py --draw                  # the picture and the table from the CSV

Entrants on every rig: the nominal model; mujoco.sysid on masses, armatures, damping, friction and
gains, chosen by BIC; what was published of the rig or fitted by hand; the diagnosis. All that fit
do so on the same recordings, and all are judged on the same others, by the RMS position error in
windows of 0.3 s, each begun as recorded, in stock MuJoCo on the files that they hand over. scatter:
median over the fitted parameters of the standard deviation between recordings, each fitted alone,
over the value of all of them. Seconds are of the processor. What is absent is skipped, and keeps
its rows.
"""

import argparse
import csv
import json
import logging
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from matplotlib.figure import Figure

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks" / "entrants")]

import sysid as entrant  # noqa: E402
from common import Recording  # noqa: E402
from fields import fields  # noqa: E402

from diagnosis.common.atomic_files import write_table, write_whole  # noqa: E402
from diagnosis.estimation import windowing  # noqa: E402
from diagnosis.handover import Files  # noqa: E402
from diagnosis.nominal.model import load_world  # noqa: E402
from diagnosis.recordings import recording as recorded  # noqa: E402

COLUMNS = ("rig", "entrant", "unit", "error", "scatter", "values", "seconds", "commit")
PAGE = ROOT / "docs" / "contest.md"
BEGIN, END = "<!-- table of benchmarks/contest.py -->", "<!-- end of the table -->"
COLORS = {"nominal": "#999999", "sysid": "#d98b1f", "published": "#7b5aa6", "diagnosis": "#1f5fa8"}
SECONDS = 3600  # of the processor, for one entrant


def of_joints(effect, **values):
    """{(effect, joint): value}."""
    return {(effect, joint): value for joint, value in values.items()}


def leg(armature, damping, friction):
    """A fit of the leg's hip, thigh and calf."""
    joints = "hip", "thigh", "calf"
    fitted = zip(("armature", "viscous_damping", "coulomb_friction"), (armature, damping, friction))
    return {(name, j): v for name, values in fitted for j, v in zip(joints, values)}


LEG = leg((0.01165, 0.01611, 0.0426), (0.17258, 0.15001, 0.33334), (0.17204, 0.19227, 0.71385))
TORQUE = {
    (("bias", f"{j}_servo")): v for j, v in (("hip", -0.17), ("thigh", -0.13), ("calf", -0.04))
}
# {rig: {who: {(effect, place): value or values}}}, as in the READMEs of the recordings
PUBLISHED = {
    "go2_leg": {
        "PACE": leg(
            (0.01525, 0.02287, 0.04346), (0.21184, 0.23816, 0.23462), (0.29261, 0.21584, 0.9082)
        ),
        "sysid, published": LEG,
        "sysid, published, and a constant torque": LEG | TORQUE,
    },
    "emps": {
        "published": {
            ("viscous_damping", "x"): 203.5034,
            ("coulomb_friction", "x"): 20.3935,
            ("bias", "drive"): 3.1648,
        }
    },
    "ur10e_joint1": {
        "published": {("viscous_damping", "base"): 21.3, ("coulomb_friction", "base"): 12.5}
    },
    "simple_pendulum": {
        "by hand": {("coulomb_friction", "pivot"): 0.15, ("gain", "drive"): 0.83},
    },
    "bam_xl330": {
        "published": {
            ("load_friction", "output"): (0.284, 0.284, 0.136 / 0.284),
            ("viscous_damping", "output"): 0.0377 + 0.0082,
        }
    },
    "cart_friction": {"by hand": {("coulomb_friction", "rail"): 3.8}},
    "double_pendulum": {
        "published": of_joints("coulomb_friction", shoulder=0.146, elbow=0.123)
        | of_joints("armature", shoulder=0.0036, elbow=0.0036)
        | of_joints("viscous_damping", shoulder=0.001, elbow=0.001)
    },
    "arm_pendulum_double_val": {"by hand": {("coulomb_friction", "second"): 2e-4}},
    "arm_pendulum_single": {"published": {("viscous_damping", "arm"): 2.2394e-4}},
    "panda": {
        "published": {
            ("coulomb_friction", f"joint{k + 1}"): v
            for k, v in enumerate((0.27, 0.44, 0.32, 0.64, 0.42, 0.15, 0.28))
        }
    },
    "cube_toss": {"published": {("contact_friction", "cube_box"): 0.18}},
}


class Entry(NamedTuple):
    """What an entrant hands over: Files, scatter of its values (NaN: none), its values in words,
    seconds."""

    files: Files
    scatter: float
    values: str
    seconds: float


class Rig(NamedTuple):
    """A rig's World, paths, and Recordings of both kinds."""

    world: object
    model: Path
    train: list
    held: list
    fitted: list


def loaded(folder):
    """The Rig of a folder, or None where it is not there."""
    model = folder / "model.xml"
    train, held = (sorted(folder.glob(f"{kind}_*.csv")) for kind in ("train", "heldout"))
    if not model.exists() or not train or not held:
        return None
    world = load_world(model)
    return Rig(world, model, train, held, recorded.load(train, world.model))


def errors(rig, files):
    """{unit: RMS error} over all numbers of a unit of the held-out recordings."""
    model = rig.world.model
    windows = windowing.cut(recorded.load(rig.held, model), windowing.HORIZON)
    gap, known = windowing.gaps(model, windows, files.predicted(model, windows))
    unit = np.full(model.nv, "rad")
    for j, kind, _, v in windowing.joint_slices(model):
        if kind == mujoco.mjtJoint.mjJNT_SLIDE:
            unit[v] = "m"
        elif kind == mujoco.mjtJoint.mjJNT_FREE:
            unit[v.start : v.start + 3] = "m"
    return {
        str(u): float(np.sqrt((gap[..., unit == u] ** 2).sum() / known[..., unit == u].sum()))
        for u in dict.fromkeys(unit)
    }


def fixed(rig, values):
    """The Entry of given effects."""
    setting = {
        rig.world.candidate(*key): tuple(np.ravel(value).astype(float))
        for key, value in values.items()
    }
    said = "; ".join(f"{e} {p} {np.ravel(v)[0]:.4g}" for (e, p), v in values.items())
    return Entry(Files.of(rig.world, setting), np.nan, said, 0.0)


def sysid(rig):
    """mujoco.sysid's Entry, its parameters chosen by BIC."""
    logging.disable(logging.WARNING)
    begun = time.process_time()
    spec = mujoco.MjSpec.from_file(str(rig.model))
    told = [whole(r) for r in rig.fitted]
    of = lambda some: entrant.sysid.build_residual_fn(
        models_sequences=[entrant.sequences(spec, some)]
    )
    chosen, values, _ = entrant.by_bic(fields(spec, usual=True), of(told))
    seconds = time.process_time() - begun
    each = [entrant.fit(chosen, of([r]))[0] for r in told] if chosen and len(told) > 1 else []
    for field in chosen:
        field.set(spec, values[field.key])
    scatter = spread({f.key: (values[f.key], [v[f.key] for v in each]) for f in chosen})
    said = "; ".join(f"{f.effect} {f.name} {values[f.key]:.4g}" for f in chosen)
    spec.compile()
    return Entry(Files(spec.to_xml(), "", {}), scatter, said, seconds)


def whole(recording):
    """A Recording with its holes filled in along straight lines: a fit of sequences needs that."""
    qpos = recording.qpos.copy()
    for column in qpos.T:
        known = np.isfinite(column)
        column[:] = np.interp(recording.time, recording.time[known], column[known])
    return Recording(recording.time, qpos, np.nan_to_num(recording.ctrl))


def diagnosed(rig):
    """The diagnosis' Entry: its command on the same files."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, str(ROOT / "diagnose.py"), "--model", str(rig.model)]
        command += ["--recordings", *map(str, rig.train), "--held-out", *map(str, rig.held)]
        begun = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([*command, "--out", folder], check=True, capture_output=True)
        ended = resource.getrusage(resource.RUSAGE_CHILDREN)
        summary = json.loads(Path(folder, "diagnosis.json").read_text(encoding="utf-8"))
        script = Path(folder, "corrected.py")
        files = Files(
            Path(folder, "corrected.xml").read_text(encoding="utf-8"),
            script.read_text(encoding="utf-8") if script.exists() else "",
            {},
        )
    each = {}
    for number, finding in enumerate(summary["findings"]):
        for p in finding["parameters"]:
            alone = [
                row["value"]
                for row in finding.get("per_recording", [])
                if row["parameter"] == p["name"] and row["value"] is not None
            ]
            each[number, p["name"]] = p["value"], alone
    said = "; ".join(
        f"{f['effect']} {f['place']['name']}"
        + "".join(f" {p['value']:.4g}" for p in f["parameters"][:3] if p["value"] is not None)
        for f in summary["findings"]
    )
    seconds = ended.ru_utime + ended.ru_stime - begun.ru_utime - begun.ru_stime
    return Entry(files, spread(each), f"{summary['verdict']}: {said or 'nothing'}", seconds)


def spread(values):
    """Median of the standard deviations of {key: (value, [values alone])} over the values; NaN of
    none."""
    shares = [
        np.std(alone, ddof=1) / abs(value)
        for value, alone in values.values()
        if value and len(alone) > 1
    ]
    return float(np.median(shares)) if shares else np.nan


def entries(rig, name, wanted):
    """(who, kind, function of the Entry) of a rig."""
    known = [(who, "published", lambda v=v: fixed(rig, v)) for who, v in PUBLISHED[name].items()]
    every = [
        ("nominal", "nominal", lambda: fixed(rig, {})),
        *known,
        ("mujoco.sysid, BIC", "sysid", lambda: sysid(rig)),
        ("diagnosis", "diagnosis", lambda: diagnosed(rig)),
    ]
    return [(who, make) for who, kind, make in every if not wanted or kind in wanted]


def rows_of(rig, name, who, make, commit):
    """The rows of an entrant on a rig, one for each unit."""
    entry = make()
    return [
        {
            "rig": name,
            "entrant": who,
            "unit": unit,
            "error": f"{error:.4g}",
            "scatter": "" if np.isnan(entry.scatter) else f"{entry.scatter:.2g}",
            "values": entry.values,
            "seconds": f"{entry.seconds:.1f}" if entry.seconds else "",
            "commit": commit,
        }
        for unit, error in errors(rig, entry.files).items()
    ]


def read(path):
    """Rows of a CSV, none where there is no file."""
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def draw(rows, path):
    """Errors of all entrants over the nominal model's, a line for each rig."""
    rigs = list(dict.fromkeys((r["rig"], r["unit"]) for r in rows))
    figure = Figure(figsize=(8.0, 0.6 + 0.42 * len(rigs)), layout="constrained")
    axes, seen = figure.subplots(), set()
    for line, key in enumerate(rigs):
        mine = [r for r in rows if (r["rig"], r["unit"]) == key]
        base = next(float(r["error"]) for r in mine if r["entrant"] == "nominal")
        axes.axhline(line, color="#dddddd", lw=0.8, zorder=0)
        for row in mine:
            kind = {"nominal": "nominal", "diagnosis": "diagnosis", "mujoco.sysid, BIC": "sysid"}
            kind = kind.get(row["entrant"], "published")
            label = {"sysid": "mujoco.sysid, BIC", "published": "published, or by hand"}
            axes.plot(
                float(row["error"]) / base,
                line,
                "o" if kind == "diagnosis" else "D",
                ms=8 if kind == "diagnosis" else 6,
                color=COLORS[kind],
                label=None if kind in seen else label.get(kind, kind),
            )
            seen.add(kind)
    axes.set_yticks(range(len(rigs)), [f"{rig} ({unit})" for rig, unit in rigs])
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.set_xlabel("held-out error over the nominal model's, 0.3 s ahead")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.legend(frameon=False, ncols=4, loc="lower center", bbox_to_anchor=(0.4, 1.0))
    figure.savefig(path, dpi=150)


def table(rows):
    """The rows as Markdown, the least error of each rig in bold."""
    head = (
        "| rig | entrant | held-out error | scatter | seconds | commit |\n|---|---|---|---|---|---|"
    )
    least = {}
    for r in rows:
        key = r["rig"], r["unit"]
        least[key] = min(least.get(key, np.inf), float(r["error"]))
    lines = []
    for r in rows:
        best = float(r["error"]) == least[r["rig"], r["unit"]]
        error = f"{r['error']} {r['unit']}"
        lines.append(
            f"| {r['rig']} | {r['entrant']} | {f'**{error}**' if best else error} |"
            f" {r['scatter'] or '–'} | {r['seconds'] or '–'} | {r['commit']} |"
        )
    return "\n".join([head, *lines])


def put_into(text, rows):
    """The page's text with the table of the rows."""
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n\n{table(rows)}\n\n{END}{after}"


def parse():
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--recordings", type=Path, default=ROOT / ".." / "shared" / "recordings", help="the rigs"
    )
    parser.add_argument("--only", nargs="*", default=list(PUBLISHED), help="rigs to do again (all)")
    parser.add_argument("--by", nargs="*", choices=list(COLORS), help="entrants to do again (all)")
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "contest.csv")
    parser.add_argument("--draw", action="store_true", help="only the picture and the table")
    return parser.parse_args()


def main():
    """Run the entrants, then draw."""
    options = parse()
    rows = read(options.out)
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True
    ).stdout.strip()
    for name in [] if options.draw else options.only:
        rig = loaded(options.recordings / name)
        if rig is None:
            print(f"{name}: not here, skipped")
            continue
        for who, make in entries(rig, name, options.by):
            new = rows_of(rig, name, who, make, commit)
            rows = [r for r in rows if (r["rig"], r["entrant"]) != (name, who)] + new
            order = list(PUBLISHED)
            rows.sort(key=lambda r: (order.index(r["rig"]), r["entrant"] == "diagnosis"))
            write_table(options.out, COLUMNS, rows)
            for row in new:
                print(*row.values(), sep=" | ", flush=True)
    if rows:
        draw(rows, ROOT / "docs" / "contest.png")
        write_whole(PAGE, put_into(PAGE.read_text(encoding="utf-8"), rows))


if __name__ == "__main__":
    main()
