"""Does each rule of the method earn its place? Every rule switched off, on the same drawn trials.

    python benchmarks/ablation.py --cache devset --only 0-19 --out results/ablation.csv
    python benchmarks/ablation.py diagnose FREE_CURVE --model sim.xml --recordings … --out report

RULES holds, for each rule, the constants of the diagnosis that switch it off. The second line runs
the diagnosis with one rule off, and is what the trials call. Rows that are done are kept beside
the table, in OUT.rows/, so that a run that was stopped goes on.
"""

import argparse
import importlib
import json
import math
import os
import pkgutil
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks import development  # noqa: E402
from diagnosis.common.atomic_files import write_table  # noqa: E402

WHOLE = "whole"  # the method as it is
RULES = {  # "a rule": {"diagnosis.package.module:CONSTANT": value that switches it off}
    WHOLE: {},
    "no price of complexity": {"diagnosis.selection.criterion:PRICE": 0.0},
    "start states are certain": {"diagnosis.estimation.ahead:FREE": 0.0},
    "a name stands whatever it leaves": {"diagnosis.unnamed:NEAREST": 2.0},
    "most of the held-out error may be left": {"diagnosis.unnamed:MOST_LEFT": 99.0},
    "what is hidden begins at rest": {"diagnosis.simulation.run_up:SETTLE": 0.0},
    "no correction for the number looked at": {"diagnosis.selection.identification:LEVEL": 1.0},
    "a beam of one": {"diagnosis.selection.beam:WIDTH": 1},
    "no values at full size": {"diagnosis.selection.starts:LADDER": ()},
    "small steps alone where something touches": {"diagnosis.selection.starts:WAYS": ()},
    "no second look at the values that suit": {"diagnosis.selection.columns:SECANTS": 0},
    "no classes": {"diagnosis.selection.rivals:REFITS": 0},
    "no sets carried on": {"diagnosis.selection.rivals:SETS": 0},
    "no rival that leaves more": {"diagnosis.selection.rivals:APART": 0.0},
    "no slow waves": {"diagnosis.selection.missing_force:WAVES": (4.0, 30.0, 0.1)},
    "tiny steps": {"diagnosis.selection.starts:STEP": 0.0},
    "nine even knots at most": {"diagnosis.selection.missing_force:FINE": 9},
    "no curves beside names": {"diagnosis.selection.missing_force:LEAST": 2.0},
    "what is within the noise counts": {"diagnosis.selection.criterion:BEYOND": 0.0},
    "a member of a class is no worse, even by chance": {"diagnosis.selection.rivals:CHANCE": 1.0},
    "differences must be alike": {"diagnosis.selection.criterion:INDEPENDENT": 0.0},
    "no first look": {"diagnosis.selection.beam:EACH": 10**6},
    "rows in which a joint sticks count": {"diagnosis.selection.missing_force:STICKS": 0.0},
    "five further effects in each first look": {"diagnosis.selection.beam:EACH": 5},
    "rounds until nothing is new": {"diagnosis.selection.identification:LEFT": 2.0},
    "all whole values are moved": {"diagnosis.selection.columns:MOVED": 10**6},
    "whatever promises at times": {"diagnosis.selection.moments:CLEARLY": 0.0},
    "nothing acts at times": {"diagnosis.selection.moments:CLEARLY": 1e9},
    "acting at times is free": {"diagnosis.selection.criterion:MOMENT": 0},
    "moments stay at windows": {"diagnosis.selection.moments:REACH": 0},
    "columns of several values as they are": {"diagnosis.selection.columns:PASSES": 0},
    "no coarse steps": {"diagnosis.simulation.rows:STEPS": 1000},
    "no minimum elsewhere": {"diagnosis.selection.judge:FARTHER": 0.0},
    "new columns in every step": {"diagnosis.selection.judge:TRUE": -1.0},
    "whole steps only": {"diagnosis.selection.judge:THIRDS": 1},
    "any difference on kept-back recordings": {"diagnosis.handover:SCATTER": 0.0},
    "a force without a name is free": {"diagnosis.unnamed:UNNAMED": 0},
    "no curves in the search": {"diagnosis.selection.identification:CURVES": 0},
    "fewer starts": {"diagnosis.selection.starts:PROBES": 4},
    "one finalist": {"diagnosis.selection.identification:FINALISTS": 1},
    "no single effects beside the finalists": {"diagnosis.selection.identification:ALONE": 0},
    "what touches is told by positions as they are": {"diagnosis.estimation.smoother:REACH": 0.0},
    "three tones": {"diagnosis.effects.transmissions:TONES": (4.0, 8.0, 16.0)},
    "blocks that do not overlap": {"diagnosis.estimation.smoother:LEAD": 0},
    "waves at the numbers tried": {"diagnosis.selection.starts:NEARER": ()},
    "one horizon": {"diagnosis.estimation.ahead:HORIZONS": (1.0,)},
}
COLUMNS = (
    "rule trials strict strict_whole lost won named named_whole false false_whole "
    "worse worse_whole error seconds seconds_whole constants"
).split()


class UnknownConstant(ValueError):
    """A constant that the diagnosis does not have: the list of rules is out of date."""


def switch_off(constants):
    """Set {"module:NAME": value} in the module and wherever it was imported from it by name."""
    import diagnosis

    for found in pkgutil.walk_packages(diagnosis.__path__, "diagnosis."):
        if not found.name.startswith("diagnosis.trials") and "__main__" not in found.name:
            importlib.import_module(found.name)
    for address, value in constants.items():
        module, _, name = address.partition(":")
        if not hasattr(sys.modules.get(module), name):
            raise UnknownConstant(f"{address}: there is no such constant; mend RULES")
        before = getattr(sys.modules[module], name)
        value = tuple(value) if isinstance(before, tuple) else value
        for other in [m for k, m in sys.modules.items() if k.startswith("diagnosis.")]:
            if getattr(other, name, None) is before:
                setattr(other, name, value)


def diagnose(words):
    """Run the diagnosis's command line with one rule off; returns its exit status."""
    from diagnosis.command import main as command

    switch_off(RULES[words[0]])
    return command(words[1:])


def compare(rule, rows, whole):
    """A row of the table: a rule's trials against the whole method's, paired by number."""
    base = {int(row["trial"]): row for row in whole}
    pairs = [(row, base[int(row["trial"])]) for row in rows if int(row["trial"]) in base]
    total = lambda side, name: sum(float(pair[side][name] or 0) for pair in pairs)
    named = lambda side: sum(p[side]["found"] == p[side]["needed"] for p in pairs)
    worse = lambda side: sum(float(p[side]["prediction"] or 1) > 1.01 for p in pairs)
    ratio = lambda p: float(p[0]["prediction"] or 1) / float(p[1]["prediction"] or 1)
    count = max(len(pairs), 1)
    return {
        "rule": rule,
        "trials": len(pairs),
        "strict": int(total(0, "strict")),
        "strict_whole": int(total(1, "strict")),
        "lost": sum(int(a["strict"]) < int(b["strict"]) for a, b in pairs),
        "won": sum(int(a["strict"]) > int(b["strict"]) for a, b in pairs),
        "named": named(0),
        "named_whole": named(1),
        "false": int(total(0, "false")),
        "false_whole": int(total(1, "false")),
        "worse": worse(0),
        "worse_whole": worse(1),
        "error": f"{math.exp(sum(math.log(ratio(p)) for p in pairs) / count):.3f}",
        "seconds": f"{total(0, 'seconds') / count:.1f}",
        "seconds_whole": f"{total(1, 'seconds') / count:.1f}",
        "constants": json.dumps(RULES[rule]),
    }


def parse():
    """The options of development.py's score, and which rules."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    development.choice(parser)
    parser.add_argument("--rules", help="some of RULES, by commas (all)")
    parser.add_argument("--limit", type=int, default=300, help="processor seconds for a diagnosis")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    return parser.parse_args()


def main():
    """Score every rule's trials, write the table after each."""
    options = parse()
    os.environ["OMP_NUM_THREADS"] = "1"
    names = [WHOLE, *(options.rules.split(",") if options.rules else list(RULES)[1:])]
    unknown = sorted(set(names) - set(RULES))
    if unknown:
        sys.exit(f"{', '.join(unknown)}: no rule of that name; RULES has {', '.join(RULES)}")
    table, out, options.keep, options.version = [], options.out, None, ROOT
    for name in names:
        script = f"{{python}} {Path(__file__).resolve()} diagnose '{name}'"
        options.tool = f"{script} --model {{model}} --recordings {{recordings}} --out {{out}}"
        options.out = Path(f"{out}.rows") / f"{name.replace(' ', '_')}.csv"
        print(name)
        rows = development.score_all(options)
        if name == WHOLE:
            whole = rows
        else:
            table.append(compare(name, rows, whole))
            write_table(out, COLUMNS, table)


if __name__ == "__main__":
    if sys.argv[1:2] == ["diagnose"]:
        sys.exit(diagnose(sys.argv[2:]))
    main()
