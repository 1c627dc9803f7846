"""The rows that were measured, by experiment: returns and one-step errors by arm and seed."""

from collections import defaultdict

import numpy as np

from training.results import SAME


class Data:
    """The rows of one experiment and one version: returns (rounds,) by arm and
    seed, and reference lines by seed."""

    def __init__(self, rounds, judged):
        self.returns, self.errors = defaultdict(dict), defaultdict(dict)
        self.lines = defaultdict(dict)  # by arm too: a policy of other settings has its own line
        self.envs = {row["env"] for row in rounds}
        for row in sorted(rounds, key=lambda r: int(r["grounding_step"])):
            arm, seed = row["arm"], int(row["seed"])
            value = float(row["real_return_deterministic"])
            self.returns[arm].setdefault(seed, []).append(value)
            error = float(row["at_one_step_error"] or "nan")
            self.errors[arm].setdefault(seed, []).append(error)
        for row in judged:
            self.lines[row["arm"]][int(row["seed"])] = float(row["trained_on_real"])
        self.version = rounds[0]["version"] if rounds else ""
        self.commits = sorted({row["commit"] for row in rounds})

    def paired(self, *arms):
        """Seeds that all arms have, over as many rounds as all of them have:
        [arrays (seeds, rounds)], seeds."""
        seeds = sorted(set.intersection(*(set(self.returns[arm]) for arm in arms)))
        if not seeds:
            return [np.empty((0, 1)) for _ in arms], []
        length = min(len(self.returns[arm][seed]) for arm in arms for seed in seeds)
        return [
            np.array([self.returns[arm][seed][:length] for seed in seeds]) for arm in arms
        ], seeds

    def line(self):
        """The line of the figure and the table: that of the arm with most seeds, (seeds,); none
        where the arms act in different tasks."""
        if len(self.envs) > 1 or not self.lines:
            return np.array([])
        arm = max(["rgat", *self.lines], key=lambda arm: len(self.lines.get(arm, ())))
        return np.array(list(self.lines[arm].values()))

    def with_lines(self, arm):
        """Returns (seeds, rounds) of an arm and the reference lines (seeds,)
        of the seeds that have one."""
        [returns], seeds = self.paired(arm)
        lines = self.lines[arm]
        keep = [k for k, seed in enumerate(seeds) if seed in lines]
        return returns[keep], np.array([lines[seeds[k]] for k in keep])


def by_experiment(rounds, judged):
    """{experiment: Data} of the runs that have ended, of each the version with the most runs."""
    found = {}
    run = lambda row: tuple(str(row[k]) for k in SAME)
    ended = {run(row) for row in judged}
    rounds = [row for row in rounds if run(row) in ended]
    for name in sorted({row["experiment"] for row in rounds}):
        mine = [row for row in rounds if row["experiment"] == name]
        runs = defaultdict(set)
        for row in mine:
            runs[row["version"]].add((row["arm"], row["seed"]))
        version = max(runs, key=lambda v: (len(runs[v]), v))
        of = lambda rows: [r for r in rows if (r["experiment"], r["version"]) == (name, version)]
        found[name] = Data(of(mine), of(judged))
    return found
