"""The keys of a pool file: which there are, where each is at home, and which are not built yet.

Pure. The readers of each section (`spec_reader`, `spec_task`, `spec_services`) use them.
"""

from __future__ import annotations

DAY_S = 86_400.0
CONCURRENCY_LIMIT = 512  # a replica holds no more requests

FOGFT_KEYS = (
    "services",
    "replicas",
    "max_surge",
    "max_usd_per_hour",
    "max_hours",
    "health",
    "orphan_after_s",
    "availability",
    "placement",
    "on_demand",
    "groups",
    "schedule",
    "migration",
    "rendezvous",
    "dial_in",
    "topology",
    "uplinks",
    "metrics",
    "topics",
    "actions",
    "rmw",
)
SERVICE_KEYS = (
    *("name", "type", "timeout_s", "on_timeout", "ok_field"),
    *("hedging", "hedging_budget", "concurrency", "cancel"),
    *("fallback", "trace", "advertise"),
    *("uplinks", "freshness", "compression"),
    *("replicas", "traffic", "quorum", "tolerance", "state"),
)
RMW_KEYS = ("robot", "replica")
TOPOLOGY_KEYS = ("gateways", "robots", "through")
GATEWAY_KEYS = ("name", "endpoint", "through")
ROBOT_KEYS = ("name", "through")
TOPIC_KEYS = ("name", "type", "from", "select", "depth", "reliable", "latched")
ACTION_KEYS = ("name", "type", "timeout_s", "result_timeout_s")
METRICS_KEYS = ("proxy", "manager", "replica")
FALLBACK_KEYS = ("service", "after_s", "while_none_ready", "limit_s")
HEALTH_KEYS = ("suspect_after_s", "replace_after_s", "start_limit_s")
AVAILABILITY_KEYS = (
    "target",
    "spot_uptime_s",
    "on_demand_uptime_s",
    "recovery_s",
    "correlation",
)
CORRELATION_KEYS = ("zone", "region", "cloud")
PLACEMENT_KEYS = ("price_weight", "latency_weight", "robot_at", "rtt_s")
ON_DEMAND_KEYS = ("base", "fallback")
GROUP_KEYS = ("name", "replicas", "resources", "on_demand")
SCHEDULE_KEYS = ("time_zone", "prelaunch_s", "windows")
WINDOW_KEYS = ("days", "from", "to", "replicas", "max_usd_per_hour")
MIGRATION_KEYS = ("gain", "stay_s")
TRAFFIC_KEYS = ("requests_per_s", "request_bytes", "response_bytes")
# The task schema of SkyPilot 0.14.1, without the keys that it keeps for itself.
TASK_KEYS = (
    "name",
    "workdir",
    "event_callback",
    "num_nodes",
    "resources",
    "file_mounts",
    "setup",
    "run",
    "envs",
    "secrets",
    "managed_secrets",
    "inputs",
    "outputs",
    "config",
    "volumes",
    "api_server_access",
)
REFUSED_TASK_KEYS = {
    "service": "it is SkyServe's; list what to replicate under `fogft.services` instead",
    "pool": "it is for SkyPilot's own worker pools; the file is a pool by its `fogft` section",
}
# Designed, not built. Ignoring one would promise what nobody does.
LATER_KEYS = {
    "autoscale": "remove it; `fogft scale` or `schedule` say how many replicas there are",
}


def places(here: tuple[str, ...]) -> dict[str, str]:
    """Say of every key that is not at home here where it is."""
    homes = (
        (HEALTH_KEYS, "under `fogft.health`"),
        (SERVICE_KEYS[2:], "in a service, under `fogft.services`"),
        (FOGFT_KEYS, "under `fogft`"),
        (("run", "setup", "resources", "workdir", "envs"), "at the top level of the file"),
    )
    return {key: place for keys, place in homes for key in keys if key not in here}
