"""Detect DDS vendors that cannot call each other, and other servers of a service. Pure.

Two DDS implementations discover each other and exchange topics, but not services: Fast DDS and
CycloneDDS put different headers before requests, so a discovered service never answers. The vendor
id at the start of every GID tells them apart.
"""

from collections.abc import Iterable

FAST_DDS, CYCLONE_DDS = b"\x01\x0f", b"\x01\x10"  # as the OMG assigns them
_MIDDLEWARE = {FAST_DDS: "rmw_fastrtps_cpp", CYCLONE_DDS: "rmw_cyclonedds_cpp"}
_OF_DYNAMIC = {"rmw_fastrtps_dynamic_cpp": "rmw_fastrtps_cpp"}


def strangers(ours: str, identifiers: Iterable[bytes]) -> list[str]:
    """Return the middleware of each endpoint (by its GID) that is incompatible with ours.

    Unknown middlewares are left out. `ours` is a name such as ``rmw_fastrtps_cpp``.
    """
    ours = _OF_DYNAMIC.get(ours, ours)
    if ours not in _MIDDLEWARE.values():
        return []
    theirs = [_MIDDLEWARE.get(bytes(one[:2]), ours) for one in identifiers]
    return [one for one in theirs if one != ours]


def of_client(service: str, ours: str, theirs: str) -> str:
    """Return a message about a client that is not received, with advice."""
    return (
        f"a client of `{service}` runs on {theirs} and the client proxy on {ours}: it gets no "
        f"answers; set RMW_IMPLEMENTATION={ours} where that node starts, or ={theirs} for "
        "`fogft up`, after `fogft down`"
    )


def of_others(service: str, nodes: Iterable[str]) -> str:
    """Return a message about other servers of a service, with advice; empty without any."""
    names = ", ".join(f"`{name}`" for name in sorted(set(nodes)))
    if not names:
        return ""
    return (
        f"`{service}` is also offered by {names}: each request goes to all, and the first answer "
        "counts; stop that node, or rename one of the services"
    )


def of_server(service: str, ours: str, theirs: str) -> str:
    """Return a message about a service that cannot be called, with advice."""
    return (
        f"`{service}` runs on {theirs} and the server proxy on {ours}: it cannot be called; write "
        "`envs: {RMW_IMPLEMENTATION: ...}` in the pool file, which applies to both, and set it "
        "nowhere else"
    )
