"""A Ray cluster, for what flies over one."""

from collections.abc import Iterator
from typing import Any

import pytest
from ray.cluster_utils import Cluster


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Cluster]:
    """Two nodes on this machine."""
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    # Its workers would wait for all other tests' processes.
    monkeypatch.setenv("RAY_worker_niceness", "0")
    nodes: Any = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False}
    )
    nodes.add_node(num_cpus=1)
    yield nodes
    nodes.shutdown()
