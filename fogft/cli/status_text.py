"""How a pool's status looks: a line, a table of replicas, a table of services, notes.

Owns: words, columns, units and styles.
Not here: getting the status (`fogft.app`) and printing it (`watch`, `progress`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from fogft.cli.table import GAP, Cell, columns, milliseconds, with_remark
from fogft.cli.tree_text import tree

if TYPE_CHECKING:
    from fogft.pool.commands.status import Seen
    from fogft.pool.manager.status import PoolStatus, ReplicaStatus, ServiceStatus

PHASES = {"provisioning": "soon", "starting": "soon", "ready": "good", "draining": "leaving"}
LINKS = {"up": "good", "connecting": "soon", "suspect": "bad"}
REPLICA_COLUMNS = ("REPLICA", "PHASE", "LOCATION", "$/H", "LINK", "RTT", "WON", "AGE")
STARTING_COLUMNS = ("REPLICA", "PHASE", "LOCATION", "$/H", "AGE")
SERVICE_COLUMNS = (
    *("SERVICE", "READY", "REQUESTS", "ANSWERED", "FALLBACK", "UNANSWERED", "LATE"),
    *("WAITING", "P50", "P99"),
)
NUMBERS = ("$/H", "RTT", "WON", "AGE", *SERVICE_COLUMNS[1:])


def rendered(seen: Seen, *, width: int, colour: bool) -> list[str]:
    """Return the whole screen, line by line."""
    status = seen.status
    lines = [headline(seen, colour=colour)]
    rows = [*status.replicas, *status.by_hand]
    if rows:
        lines += ["", *replicas(rows, REPLICA_COLUMNS, width=width, colour=colour)]
    if status.services:
        lines += ["", *services(status.services, colour=colour)]
    drawn = tree(status.topology, colour=colour)
    lines += ["", *drawn] if drawn else []
    remarks = notes(status, colour=colour)
    return [*lines, "", *remarks] if remarks else lines


def starting(status: PoolStatus, *, width: int, colour: bool) -> list[str]:
    """Return what `up` shows meanwhile: without what only matters later."""
    lines = replicas(status.replicas, STARTING_COLUMNS, width=width, colour=colour)
    return [*(lines if status.replicas else ()), *notes(status, colour=colour)]


def headline(seen: Seen, *, colour: bool) -> str:
    """Return the line on top: how many are ready, the price, and how old all this is."""
    status = seen.status
    ready, target = status.ready, status.target
    enough = "good" if ready >= target > 0 else "soon" if ready else "bad"
    age_s = seen.age_s
    cells = [
        Cell(status.pool, "bold"),
        Cell(f"{ready} of {target} ready", enough),
        Cell(f"{price(status.usd_per_hour)}/h on {status.cloud}"),
        Cell("not observed yet" if age_s is None else f"seen {age(age_s)} ago"),
    ]
    if status.ended and not seen.manager_alive:
        return GAP.join([Cell(status.pool, "bold").painted(colour=colour), f"ended {status.ended}"])
    alarms = {
        "NO MANAGER": not seen.manager_alive,
        "NO CLIENT PROXY": not status.proxy_alive,
        "UPLINK SUSPECTED": status.uplink_suspected,
        "ENDING": status.stopping,
    }
    cells += [Cell(text, "bad") for text, sounds in alarms.items() if sounds]
    return GAP.join(cell.painted(colour=colour) for cell in cells)


def notes(status: PoolStatus, *, colour: bool) -> list[str]:
    """Return the sentences below the tables."""
    found = [*status.notes, *_orders(status.services)]
    if status.excluded:
        found.append(f"excluded: {', '.join(status.excluded)}")
    return [f"{Cell('note:', 'note').painted(colour=colour)} {note}" for note in found]


def _orders(rows: Sequence[ServiceStatus]) -> list[str]:
    """Return which stateful services cannot be had, and why."""
    found = []
    for row in rows:
        order = row.counters.get("order") or {}
        if order.get("trouble"):
            found.append(f"`{row.name}` cannot be had: {order['trouble']}")
    return found


def replicas(
    rows: Sequence[ReplicaStatus], names: Sequence[str], *, width: int, colour: bool
) -> list[str]:
    """Return the table of replicas; a detail stands behind its replica, or below it."""
    cells = [[_of_replica(row)[name] for name in names] for row in rows]
    # One more column, empty, so that lines are filled up where a detail follows.
    header, *lines = columns([*names, ""], [[*row, Cell("")] for row in cells], right=NUMBERS,
                             colour=colour)  # fmt: skip
    plain = columns(names, cells, right=NUMBERS)
    taken, indent = max(map(len, plain)), len(names[0]) + len(GAP)
    found = [header]
    for row, line in zip(rows, lines, strict=True):
        found += with_remark(line, row.detail, taken=taken, width=width, indent=indent)
    return found


def _of_replica(row: ReplicaStatus) -> dict[str, Cell]:
    return {
        "REPLICA": Cell(f"{row.slot}.{row.generation}"),
        "PHASE": Cell(row.phase, PHASES.get(row.phase, "")),
        "LOCATION": Cell(row.location),
        "$/H": Cell(price(row.usd_per_hour).removeprefix("$")),
        "LINK": Cell(row.link or "-", LINKS.get(row.link, "dim")),
        "RTT": Cell(milliseconds(row.rtt_s)),
        "WON": Cell(number(row.won)),
        "AGE": Cell("-" if row.age_s is None else age(row.age_s)),
    }


def services(rows: Sequence[ServiceStatus], *, colour: bool) -> list[str]:
    """Return the table of services and what became of their requests."""
    cells = []
    for row in rows:
        count = row.counters
        unanswered = sum(count.get(key, 0) for key in ("silent", "empty", "turned_away"))
        cells.append(
            [
                Cell(row.name),
                Cell(number(row.ready_replicas), "" if row.ready_replicas else "bad"),
                Cell(number(count.get("received", 0))),
                Cell(number(count.get("answered", 0))),
                Cell(number(count.get("fallback", 0))),
                Cell(number(unanswered), "bad" if unanswered else ""),
                Cell(number(count.get("late", 0))),
                Cell(number(count.get("pending", 0))),
                Cell(milliseconds(count.get("p50_s"))),
                Cell(milliseconds(count.get("p99_s"))),
            ]
        )
    return columns(SERVICE_COLUMNS, cells, right=NUMBERS, colour=colour)


def price(usd: float) -> str:
    """Return an amount as ``$0.021``."""
    return f"${usd:.3f}"


def number(value: int) -> str:
    """Return a count with its thousands apart."""
    return f"{value:,}".replace(",", " ")


def age(seconds: float) -> str:
    """Return a long duration, coarser the longer: ``4.2 s``, ``3 min``, ``2 h 5 min``, ``26 h``."""
    if seconds < 10:
        return f"{seconds:.1f} s"
    if seconds < 120:
        return f"{seconds:.0f} s"
    minutes = int(seconds // 60)
    if minutes < 60:
        return f"{minutes} min"
    if minutes < 600:
        return f"{minutes // 60} h {minutes % 60} min"
    return f"{minutes // 60} h" if minutes < 2880 else f"{minutes // 1440} d"
