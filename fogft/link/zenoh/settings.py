"""Zenoh's configuration for both ends of a link, with reasons.

By default a message passes through three of Zenoh's thread pools, and each hop wakes another
thread. Callbacks need Python's lock anyway, so reading, routing and callbacks all run in *one*
thread: a round trip of 8 bytes over loopback took 168 us with one and 257 to 271 us by default
(medians of 3000, on 2 cores). So a callback that blocks would stall every link of the process.

Sending and closing have their own threads. A thread that sends a large message holds a lock of its
link while it waits for room; if that link breaks, Zenoh's sending and closing wait for that lock,
for up to `wait_before_close`: on the one thread, that would stall all other links for as long.
"""

from __future__ import annotations

import json
import os
from collections.abc import MutableMapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from fogft.link.port import Peer
from fogft.model import names
from fogft.model.credentials import CredentialPaths
from fogft.model.replica import ReplicaId

if TYPE_CHECKING:
    import zenoh

MESSAGE_BYTES_LIMIT = 256 << 20
SESSIONS_LIMIT = 128  # robots, and gateways, at one replica
_HANDSHAKES_LIMIT = 32
_SIGN_OF_LIFE_EVERY_S = 2.0


@dataclass(frozen=True)
class LinkSettings:
    """Timeouts of a link, in seconds.

    Zenoh's own two are long, because it cannot tell a slow uplink from a dead one; both ends watch
    the connection themselves (`flow_watch`, `connection_reaper`).
    """

    lease_s: float = 150.0  # Zenoh ends a session whose peer sent nothing for this long
    # Or if sending one message takes this long. Less than the lease, or healthy links stall.
    wait_before_close_s: float = 120.0
    open_timeout_s: float = 1.5
    # For every third attempt in a row that times out: a full uplink or a busy machine needs more.
    long_open_timeout_s: float = 4.0
    stall_after_s: float = 1.0  # or four round trips: then a robot gives up on a stuck queue
    stuck_after_s: float = 15.0  # when a replica does; the robot has long opened another link


def robot_settings(
    peer: Peer, credentials: CredentialPaths, settings: LinkSettings
) -> dict[str, Any]:
    """Return the settings of a robot's session to one replica."""
    keys = names.slot_key(peer.id.pool_uid, peer.id.slot, "**")
    # Zenoh makes an invalid TLS name of an IPv6 address in brackets; without them it parses it.
    endpoint = peer.endpoint.replace("[", "").replace("]", "")
    return {
        **_common(settings, "connect", credentials),
        "mode": "client",
        "connect/endpoints": [
            f"tls/{endpoint}" + (f"#iface={peer.interface}" if peer.interface else "")
        ],
        # One attempt: the link itself retries, and knows when and why.
        "connect/timeout_ms": 0,
        "connect/exit_on_failure": True,
        "listen/endpoints": [],
        # Nothing is sent to a peer with any other common name. Tested by
        # tests/link/zenoh/test_trust.py::test_nothing_is_sent_to_an_impostor_after_a_reconnect.
        "access_control": _access(
            keys, "egress", "ingress", {"cert_common_names": [peer.certificate_name]}
        ),
    }


def replica_settings(
    listen: str, id: ReplicaId, credentials: CredentialPaths, settings: LinkSettings
) -> dict[str, Any]:
    """Return the settings of a replica's session, which listens on `listen` (``host:port``)."""
    keys = names.slot_key(id.pool_uid, id.slot, "**")
    return {
        **_common(settings, "listen", credentials),
        # Not `router`: that would forward messages between robots.
        "mode": "peer",
        "connect/endpoints": [],
        "listen/endpoints": [f"tls/{listen}"],
        "listen/exit_on_failure": True,
        "transport/unicast/max_sessions": SESSIONS_LIMIT,
        "transport/unicast/accept_pending": _HANDSHAKES_LIMIT,
        # Overrides what robots request: threads that serve all robots must not wait for one.
        "qos/network": [
            {
                "id": key,
                "flows": ["ingress"],
                "messages": ["query"],
                "key_exprs": [key],
                "overwrite": {"priority": priority, "congestion_control": congestion},
            }
            for key, priority, congestion in (
                ("**", "data_low", "drop"),
                (names.slot_key(id.pool_uid, id.slot, names.PROBE), "interactive_high", "drop"),
                (names.slot_key(id.pool_uid, id.slot, names.ANSWERS), "data", "block"),
            )
        ],
        # Any name: the handshake has verified that the CA issued a robot's certificate.
        "access_control": _access(keys, "ingress", "egress", {}),
    }


def to_zenoh(settings: dict[str, Any]) -> zenoh.Config:
    """Convert settings to a Zenoh configuration; call it before the process's first session."""
    import zenoh

    ask_for_threads()
    config: zenoh.Config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _common(settings: LinkSettings, side: str, credentials: CredentialPaths) -> dict[str, Any]:
    return {
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "adminspace/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/link/protocols": ["tls"],
        "transport/link/tls": {
            "root_ca_certificate": str(credentials.ca),
            f"{side}_certificate": str(credentials.certificate),
            f"{side}_private_key": str(credentials.key),
            "enable_mtls": True,
            # Replicas have no DNS names. Instead, the connection checks their common name after
            # opening, and the access list does whenever Zenoh reconnects by itself.
            "verify_name_on_connect": False,
            "close_link_on_expiration": True,
        },
        "transport/link/tx/lease": round(settings.lease_s * 1e3),
        # Keep-alives per lease: those to an unreachable peer show up as unacknowledged bytes.
        "transport/link/tx/keep_alive": max(4, round(settings.lease_s / _SIGN_OF_LIFE_EVERY_S)),
        "transport/link/tx/queue/congestion_control/block/wait_before_close": round(
            settings.wait_before_close_s * 1e6
        ),
        "transport/link/rx/max_message_size": MESSAGE_BYTES_LIMIT,
        "transport/unicast/open_timeout": round(settings.open_timeout_s * 1e3),
        "transport/unicast/accept_timeout": round(settings.long_open_timeout_s * 1e3),
        "connect/retry": {
            "period_init_ms": 100,
            "period_max_ms": 500,
            "period_increase_factor": 2,
        },
    }


def _access(
    keys: str, requests: str, answers: str, subject: dict[str, list[str]]
) -> dict[str, Any]:
    """Return an access control list: only requests one way and answers the other way."""
    messages = {
        requests: ["query", "put"],
        answers: ["reply", "declare_queryable", "declare_subscriber"],
    }
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [
            {
                "id": flow,
                "permission": "allow",
                "flows": [flow],
                "messages": allowed,
                "key_exprs": [keys],
            }
            for flow, allowed in messages.items()
        ],
        "subjects": [{"id": "peer", **subject}],
        "policies": [{"rules": list(messages), "subjects": ["peer"]}],
    }


VARIABLE = "ZENOH_RUNTIME"
THREADS = (
    "(rx: (worker_threads: 1), app: (handover: rx), acc: (handover: rx),"
    " tx: (worker_threads: 8), net: (worker_threads: 8))"
)


def ask_for_threads(environ: MutableMapping[str, str] = os.environ) -> None:
    """Set Zenoh's thread configuration, unless the user has set one."""
    environ.setdefault(VARIABLE, THREADS)


def forget_threads(environ: MutableMapping[str, str]) -> None:
    """Remove our setting from the environment of another program that may use Zenoh."""
    if environ.get(VARIABLE) == THREADS:
        del environ[VARIABLE]
