"""Do a trial's true values explain its recordings? What the search should end with, judged.

    python benchmarks/truths.py --cache devset [--only 3,8-12] --out truths.csv

Of each drawn trial with effects of the catalogue the judge compares the nominal model, the model
with the true values, and that one fitted from there, in finer steps where they help. left: share of
the nominal model's error that this leaves, of the channel that it leaves most in; lacks, p: what a
perfect simulator would still gain, in nats, and by what chance. Where it leaves much, a trial is
simulated wrongly, an effect is, or a recording begins where the judge does not know.
"""

import argparse
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402

from benchmarks.development import choice, chosen, place  # noqa: E402
from benchmarks.rows import append, finished  # noqa: E402
from diagnosis.preparation import prepared  # noqa: E402
from diagnosis.selection.identification import Identification  # noqa: E402
from diagnosis.selection.judge import lacking, share_left  # noqa: E402
from diagnosis.trials.kept import BENCH, read_answer  # noqa: E402


def true_setting(world, answer):
    """{Candidate: true values}, or None where something hidden is in no catalogue."""
    out = {}
    for item in answer["hidden"]:
        try:
            candidate = world.candidate(item["effect"], item["place"]["name"])
        except KeyError:
            return None
        told, names = item["parameters"], [p.name for p in candidate.parameters]
        if len(told) == len(names) == 1:
            told = {names[0]: next(iter(told.values()))}
        if not told.keys() <= set(names):
            return None
        each = zip(names, candidate.nominal)
        out[candidate] = tuple(told.get(name, nominal) for name, nominal in each)
    return out or None


def judged(folder):
    """The columns of a trial that the judge decides, or None without a true setting."""
    answer, _ = read_answer(folder)
    bench = folder / BENCH
    given = prepared(bench / "sim.xml", sorted(bench.glob("train_*.csv")))
    truth = true_setting(given.world, answer)
    if not truth:
        return None
    search = Identification(given.world, given.train)
    judge = search.begin(truth, search.locate(truth)[0])
    nominal, true = judge.fit({}), judge.fit(truth, steps=0)
    fitted = search.finer(judge, judge.fit(truth, steps=3))
    shares, most = share_left(fitted), max(lacking(fitted), key=lambda c: c.gain)
    values = [f"{v:.4g}" for some in fitted.setting.values() for v in some]
    return {
        "gate": answer["gate"],
        "touches": f"{answer['touched']:.2f}" if answer["touched"] else "",
        "hidden": "; ".join(map(place, answer["hidden"])),
        "truth": f"{true.loss - nominal.loss:.3f}",
        "fitted": f"{fitted.loss - nominal.loss:.3f}",
        "left": "" if np.isnan(shares).all() else f"{np.nanmax(shares):.2f}",
        "lacks": f"{most.gain:.2f}",
        "p": f"{most.p_value:.1e}",
        "values": " ".join(values),
    }


def main():
    """A row for each drawn trial, as it is done."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    choice(parser)
    parser.add_argument("--out", type=Path, required=True, help="CSV; trials in it are kept")
    options = parser.parse_args()
    for _, folder in chosen(options):
        done = finished(options.out, {"trial": folder.name})
        row = None if done else judged(folder)
        if row:
            append(options.out, [{"trial": folder.name, **row}])
            print(folder.name, *row.values(), flush=True)


if __name__ == "__main__":
    main()
