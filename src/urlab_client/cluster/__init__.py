"""Rollouts on a Ray cluster: episodes by actors or tasks, each on its own simulated server or a leased address.

Requires the extra `ray`. The driver must call `ray.init()` first.
"""

import importlib.util

from urlab_client._installation import install_command

for _module in ("ray", "gymnasium"):
    if importlib.util.find_spec(_module) is None:
        raise ImportError(f"{_module} is not installed; run: {install_command('ray')}", name=_module)

from urlab_client.cluster.episodes import Episode, Policy, RolloutError, run_episode  # noqa: E402
from urlab_client.cluster.leases import Lease, LeaseLost, LeasePool  # noqa: E402
from urlab_client.cluster.rollouts import Rollouts, WorkerPool, rollouts  # noqa: E402
from urlab_client.cluster.saved import load_episodes, missing_ids, save_episode  # noqa: E402

__all__ = [
    "Episode",
    "Lease",
    "LeaseLost",
    "LeasePool",
    "Policy",
    "RolloutError",
    "Rollouts",
    "WorkerPool",
    "load_episodes",
    "missing_ids",
    "rollouts",
    "run_episode",
    "save_episode",
]
