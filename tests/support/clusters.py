"""Ray clusters on this machine, for tests."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from packages import package

ray = package("ray")
from ray.cluster_utils import Cluster as Cluster  # noqa: E402  tests without Ray are not run

SUPPORT = Path(__file__).parent


def add_node(cluster: Cluster, cores: int = 1, **environment: str) -> Any:
    """A new machine of the cluster, whose processes have these environment variables."""
    return cluster.add_node(num_cpus=cores, object_store_memory=10**8, env_vars=environment, include_dashboard=False)


@contextlib.contextmanager
def two_cores(**environment: str) -> Iterator[Cluster]:
    """A head without cores and a machine with two, whose workers find the modules of this folder."""
    changes = {"PYTHONPATH": f"{SUPPORT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}", **environment}
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    cluster = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 0, "object_store_memory": 10**8, "include_dashboard": False}
    )
    try:
        add_node(cluster, 2)
        yield cluster
    finally:
        ray.shutdown()
        cluster.shutdown()
        for name, value in before.items():
            del os.environ[name]
            if value is not None:
                os.environ[name] = value
