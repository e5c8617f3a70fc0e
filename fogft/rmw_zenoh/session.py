"""The Zenoh session of a node among those of `rmw_zenoh`: configured as theirs are.

A peer that finds the others by the router of its machine, and then talks to them directly, so
that it outlives the router. ``ZENOH_SESSION_CONFIG_URI`` (a file) takes the place of all
settings, ``ZENOH_CONFIG_OVERRIDE`` (``key=value;key=value``) of some, as for every node.

Owns: these settings. Not here: those of links (`config`), which never meet such a session.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from fogft.errors import RosError
from fogft.link.zenoh import settings

if TYPE_CHECKING:
    import zenoh

FILE, OVERRIDE = "ZENOH_SESSION_CONFIG_URI", "ZENOH_CONFIG_OVERRIDE"
ROUTER = "tcp/localhost:7447"

SETTINGS: dict[str, Any] = {
    "mode": "peer",
    "connect/endpoints": [ROUTER],
    "connect/timeout_ms": -1,  # a router that starts later is found then
    "connect/exit_on_failure": False,
    "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2},
    "listen/endpoints": ["tcp/localhost:0"],
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": True,
    "scouting/gossip/target": {"router": ["router", "peer"], "peer": ["router"]},
    "scouting/gossip/autoconnect": {"router": [], "peer": ["router", "peer"]},
    "scouting/gossip/autoconnect_strategy": {
        "peer": {"to_router": "always", "to_peer": "greater-zid"}
    },
    "queries_default_timeout": 600_000,
    "transport/shared_memory/enabled": False,
    "transport/link/rx/max_message_size": 1 << 30,
}


def settings_from(environ: Mapping[str, str]) -> zenoh.Config:
    """Return the configuration that holds here.

    Raises:
        RosError: A variable names no configuration, or is none.
    """
    import zenoh

    path = environ.get(FILE)
    try:
        made = zenoh.Config.from_file(path) if path else settings.to_zenoh(SETTINGS)
    except Exception as error:
        raise RosError(f"`{FILE}={path}` cannot be used: {error}") from error
    settings.to_zenoh({})  # the runtime's own wish, whoever configures the session
    for key, value in _overrides(environ.get(OVERRIDE, "")):
        try:
            made.insert_json5(key, value)
        except Exception as error:
            raise RosError(
                f"`{OVERRIDE}` cannot be used at `{key}`: {error}",
                'write `key=value;key=value`, such as `connect/endpoints=["tcp/10.0.0.5:7447"]`',
            ) from error
    return made


def _overrides(text: str) -> list[tuple[str, str]]:
    pairs = [pair.partition("=") for pair in text.split(";") if pair.strip()]
    return [(key.strip(), value.strip()) for key, _, value in pairs]
