"""A sweep on a real Ray cluster of two nodes, one of which is killed while it works."""

import pytest

from tests.sweep_runs import (
    attempts,
    end_of,
    last_checkpoint,
    processes_with,
    result,
    rounds_measured,
    start_sweep,
    wait_until,
)
from tests.toy_runs import toy_flags

pytest.importorskip("ray", reason="ray is not installed: pip install -e '.[ray]'")

SEEDS = (0, 1)


@pytest.fixture
def cluster():
    """Two nodes on this machine, with a core each."""
    from ray.cluster_utils import Cluster

    small = {"num_cpus": 1, "object_store_memory": 80_000_000}
    cluster = Cluster(initialize_head=True, head_node_args=small | {"include_dashboard": False})
    cluster.add_node(**small)
    yield cluster
    cluster.shutdown()


def test_nothing_is_lost_or_run_twice_when_a_node_is_killed(cluster, tmp_path):
    work = tmp_path / "work"
    flags = toy_flags(num_rounds=1, train__num_steps=120, policies="('random',)")
    flags += ["--axis=seed=0:2", "--engine=ray", f"--ray_address={cluster.address}"]
    process = start_sweep([*flags, f"--workdir={work}"])

    def at_work():
        """Round 0 of these seeds is half made."""
        folders = [work / "initial" / f"seed_{seed}" for seed in SEEDS]
        busy = [f for f in folders if not (f / "round_0.json").exists() and last_checkpoint(f) > 3]
        return busy if len(busy) == 2 else None

    wait_until(at_work, process)
    before = {folder: last_checkpoint(folder) for folder in at_work() or ()}
    other = next(node for node in cluster.worker_nodes)
    cluster.remove_node(other, allow_graceful=False)
    code, out = end_of(process)
    assert code == 0, out
    assert "retried" in out and "its machine or its worker is gone" in out
    assert not processes_with(str(work))

    tries = {path.parent: attempts(path.parent) for path in work.glob("*/seed_*/log.txt")}
    assert sorted(tries.values()) == [1, 1, 1, 2], tries
    assert tries.keys() == {work / p / f"seed_{s}" for p in ("initial", "random") for s in SEEDS}
    (again,) = (folder for folder, number in tries.items() if number == 2)
    assert again in before
    assert all(result(work, "random", seed)["completed"] for seed in SEEDS)
    wanted = {("initial", seed, 0) for seed in SEEDS} | {("random", seed, 1) for seed in SEEDS}
    assert rounds_measured(work) == dict.fromkeys(wanted, 1)
    assert (work / "report.html").exists()
