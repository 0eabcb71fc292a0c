"""Workers as tasks of Ray."""

import importlib

import pytest
from launched import LONG, assert_as_here, carry_out, searched

from mapg_jax.sweeps import sweep
from mapg_jax.sweeps.launchers import launcher


@pytest.fixture
def ray_cluster():
    """Two nodes with room for one worker each, beside the head."""
    cluster_utils = pytest.importorskip("ray.cluster_utils")
    cluster = cluster_utils.Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    try:
        for _ in range(2):
            cluster.add_node(num_cpus=1)
        yield cluster
    finally:
        importlib.import_module("ray").shutdown()
        cluster.shutdown()


@pytest.mark.cluster
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # Ray forks
def test_tasks_of_ray_search_and_one_whose_node_is_lost_ends_on_another(ray_cluster, tmp_path):
    """The node is lost while both train."""
    address = f"address={ray_cluster.address}"
    assert searched(tmp_path / "tasks", "ray", address) == searched(tmp_path / "local", "local")
    lost = []

    def lose_one(*_):
        if not lost and all((tmp_path / f"s{k}" / "metrics.csv").exists() for k in (0, 1)):
            node = next(iter(ray_cluster.worker_nodes))
            lost.append(ray_cluster.remove_node(node, allow_graceful=False))
            ray_cluster.add_node(num_cpus=1)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweep.SweepTable, "update", lose_one)
        together = carry_out(launcher("ray", [address]), tmp_path, LONG)
    assert lost
    assert_as_here(together, tmp_path / "alone")
