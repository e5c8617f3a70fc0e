"""A service's policy as plain values and back, for the proxies' configuration files. Pure.

Only what differs from the default is written, so that a configuration stays short and one
written by an older manager means what it meant.

Owns: the keys of a service in `proxy.yaml` and `replica.yaml`, which are the pool file's.
Not here: judging a pool file (`services`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any

from fogft.model.choices import Compression, FallbackSpec, Freshness
from fogft.model.spec import Advertise, HedgingMode, OnTimeout, Part, ServiceSpec
from fogft.model.uplinks import UplinkPolicy
from fogft.poolfile import state

LONGEST_S = 1e7  # what a request's header can carry
# What a replica must know; the rest is the robot's.
REPLICA_KEYS = ("name", "type", "concurrency", "cancel", "freshness", "state", "part")
_NOT_THE_PROXIES = ("replicas", "traffic")
_ALWAYS = ("name", "type", "timeout_s")


def to_plain(service: ServiceSpec, keys: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return what a configuration file says of a service; only `keys`, where some are given."""
    written = {}
    for field in fields(ServiceSpec):
        value = getattr(service, field.name)
        if field.name in _NOT_THE_PROXIES or (keys and field.name not in keys):
            continue
        if value != field.default or field.name in _ALWAYS:
            is_map = isinstance(value, FallbackSpec)
            written[field.name] = asdict(value) if is_map else getattr(value, "value", value)
    if service.state is not None and "state" in written:
        written["state"] = service.state.to_plain()
    if "tolerance" in written:
        written["tolerance"] = dict(service.tolerance)
    return written


def from_plain(raw: Mapping[str, Any]) -> ServiceSpec:
    """Return the service of a configuration file.

    Raises:
        KeyError: Name or type are missing.
        ValueError: A value is out of range or unknown.
        TypeError: A value is of the wrong type.
    """
    return ServiceSpec(
        name=str(raw["name"]),
        type=str(raw["type"]),
        timeout_s=seconds(raw.get("timeout_s") or ServiceSpec.timeout_s),
        on_timeout=OnTimeout(raw.get("on_timeout") or ServiceSpec.on_timeout),
        ok_field=str(raw.get("ok_field") or ""),
        hedging=HedgingMode(raw.get("hedging") or ServiceSpec.hedging),
        hedging_budget=_share(raw.get("hedging_budget") or ServiceSpec.hedging_budget),
        concurrency=int(raw.get("concurrency") or 0),
        cancel=str(raw.get("cancel") or ""),
        quorum=int(raw.get("quorum") or 1),
        tolerance=tuple((str(k), float(v)) for k, v in (raw.get("tolerance") or {}).items()),
        state=state.from_plain(raw.get("state")),
        fallback=_fallback(raw.get("fallback")),
        trace=bool(raw.get("trace")),
        uplinks=UplinkPolicy(raw.get("uplinks") or ServiceSpec.uplinks),
        freshness=Freshness(raw.get("freshness") or ServiceSpec.freshness),
        compression=Compression(raw.get("compression") or ServiceSpec.compression),
        advertise=Advertise(raw["advertise"]) if raw.get("advertise") else None,
        part=Part(raw.get("part") or ""),
    )


def _fallback(raw: Mapping[str, Any] | None) -> FallbackSpec | None:
    if raw is None:
        return None
    after_s = raw.get("after_s")
    return FallbackSpec(
        service=str(raw["service"]),
        after_s=None if after_s is None else seconds(after_s),
        while_none_ready=bool(raw.get("while_none_ready")),
        limit_s=seconds(raw.get("limit_s") or FallbackSpec.limit_s),
    )


def seconds(raw: Any) -> float:
    """Return a duration above 0. Raises ValueError or TypeError."""
    value = float(raw)
    if not 0 < value <= LONGEST_S:  # false for NaN too
        raise ValueError(f"{raw!r:.40} is not a time in seconds")
    return value


def _share(raw: Any) -> float:
    value = float(raw)
    if not (0 < value <= 1 and math.isfinite(value)):
        raise ValueError(f"{raw!r:.40} is not a share above 0 and at most 1")
    return value
