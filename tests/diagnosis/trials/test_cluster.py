"""Trials on a Ray cluster of two nodes, one of which is killed half-way. Skipped without ray."""

import threading
import time
from collections import Counter

import pytest

from diagnosis.trials import table
from diagnosis.trials.table import Task, read_rows, run_tasks

COUNT = 24


@pytest.fixture
def cluster():
    """A cluster of two nodes, two cores each, with a head that runs nothing."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    yield made
    made.shutdown()


def test_a_node_killed_half_way_loses_nothing_and_doubles_nothing(cluster, tmp_path, monkeypatch):
    nodes = [cluster.add_node(num_cpus=2) for _ in range(2)]
    log = tmp_path / "log"
    log.touch()
    lost = nodes[1].node_id

    def trial(task, template, limit):
        import ray

        where = ray.get_runtime_context().get_node_id()
        with open(log, "a") as file:
            file.write(f"{task.number} {where}\n")
        time.sleep(60 if where == lost else 0.1)  # it is at work when it dies, however slow that is
        return {"number": task.number, "note": template}

    def kill():
        while lost not in log.read_text():
            time.sleep(0.05)
        cluster.remove_node(nodes[1], allow_graceful=False)

    monkeypatch.setattr(table, "run_trial", trial)
    tasks = [Task(number, (1, number), "development") for number in range(COUNT)]
    killer = threading.Thread(target=kill)
    killer.start()
    out = tmp_path / "table.csv"
    rows = run_tasks(tasks, "tool", out, 1, 10, ray_address=cluster.address)
    killer.join()
    begun = Counter(int(line.split()[0]) for line in log.read_text().splitlines())
    assert set(begun) == set(range(COUNT))
    assert max(begun.values()) > 1  # something was under way on the lost node, and begun again
    assert [int(row["number"]) for row in read_rows(out)] == list(range(COUNT)) and len(
        rows
    ) == COUNT
