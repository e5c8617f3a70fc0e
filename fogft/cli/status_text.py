"""Format a pool's status: a headline, tables of replicas and services, the gateway tree."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from fogft.cli import output
from fogft.cli.output import cell
from fogft.model.topic import PREFIX

if TYPE_CHECKING:
    from rich.console import Group, RenderableType
    from rich.text import Text
    from rich.tree import Tree

    from fogft.pool.commands.status import Seen
    from fogft.pool.manager.status import PoolStatus, ReplicaStatus, ServiceStatus, TopicStatus

PHASES = {
    "provisioning": "yellow",
    "starting": "yellow",
    "ready": "green",
    "draining": "magenta",
    "unready": "bold red",
}
LINKS = {"up": "green", "connecting": "yellow", "suspect": "bold red"}
REPLICA_COLUMNS = ("REPLICA", "PHASE", "LOCATION", "$/H", "LINK", "RTT", "FIRST", "AGE")
STARTING_COLUMNS = ("REPLICA", "PHASE", "LOCATION", "$/H", "AGE")
SERVICE_COLUMNS = (
    *("SERVICE", "READY", "REQUESTS", "ANSWERED", "FALLBACK", "UNANSWERED", "LATE"),
    *("WAITING", "P50", "P99"),
)
TOPIC_COLUMNS = ("TOPIC", "FROM", "HEARD BY", "RATE", "MESSAGES", "PASSED", "DROPPED", "REFUSED")
RARE = ("FALLBACK", "UNANSWERED", "LATE", "WAITING")
UNKNOWN = "?"
_STRANGERS_SHOWN = 20  # port scans and broken links cause fewer
LOST = "unready"  # it has served, but does not now
NUMBERS = ("$/H", "RTT", "FIRST", "AGE", *SERVICE_COLUMNS[1:], *TOPIC_COLUMNS[3:])


def rendered(seen: Seen, *, width: int | None) -> Group:
    """Return the whole status for a given line width."""
    from rich.console import Group

    status, links_known = seen.status, seen.links_known
    rows = [*status.replicas, *status.by_hand]
    services = [_of_service(row, links_known) for row in status.services]
    topics = [_of_topic(row, links_known) for row in status.topics]
    parts: list[Sequence[RenderableType]] = [
        [_headline(seen, width)],
        _replicas(rows, REPLICA_COLUMNS, width, links_known),
        _counted(SERVICE_COLUMNS, services, width, RARE),
        _counted(TOPIC_COLUMNS, topics, width, ("REFUSED",)),
        topology(status.topology),
        notes(status),
    ]
    return Group(*[line for part in parts if part for line in ("", *part)][1:])


def starting(status: PoolStatus, *, width: int | None) -> Group:
    """Return the shorter status that `up` shows while it waits."""
    from rich.console import Group

    return Group(*_replicas(status.replicas, STARTING_COLUMNS, width, True), *notes(status))


def readiness(seen: Seen) -> str:
    """Return ``2 of 3 ready``, or ``3 ready, 2 wanted`` while one stands in for another."""
    ready, target = seen.status.ready, seen.status.target
    if seen.links_known and ready > target:
        return f"{ready} ready, {target} wanted"
    return f"{ready if seen.links_known else UNKNOWN} of {target} ready"


def _headline(seen: Seen, width: int | None) -> Text:
    status = seen.status
    pool = cell(status.pool, "bold")
    if status.ended and not seen.manager_alive:
        return _joined([pool, cell(f"ended {status.ended}")])
    ready, target = status.ready, status.target
    enough = "green" if ready >= target > 0 else "yellow" if ready else "bold red"
    usd_per_hour = UNKNOWN if seen.stale else price(status.usd_per_hour)
    hangs = status.proxy_alive and not seen.links_known
    links_age_s = seen.report_age_s if hangs else None
    alarms = {
        "NO MANAGER": not seen.manager_alive,
        "NO CLIENT PROXY": not status.proxy_alive,
        "UPLINK SUSPECTED": status.uplink_suspected,
        "ENDING": status.stopping,
    }
    return _joined(
        [
            pool,
            *_answering(seen),
            cell(readiness(seen), enough),
            cell(f"{usd_per_hour}/h on {status.cloud}"),
            *([cell(f"{price(status.usd_to_date)} so far")] if status.usd_to_date else []),
            cell("not observed yet" if seen.age_s is None else f"seen {age(seen.age_s)} ago"),
            *([] if links_age_s is None else [cell(f"links seen {age(links_age_s)} ago")]),
            *(cell(text, "bold red") for text, sounds in alarms.items() if sounds),
        ],
        width,
    )


def _answering(seen: Seen) -> list[Text]:
    if seen.answers:
        return [cell("answering", "green")]
    if seen.answers is None:
        return [] if seen.links_known or seen.age_s is None else [cell("answering?", "yellow")]
    some = len(seen.unanswered) < len(seen.status.services)
    named = f": {', '.join(seen.unanswered)}" if some and seen.unanswered else ""
    return [cell(f"not answering{named}", "bold red")]


def _joined(words: Sequence[Text], width: int | None = None) -> Text:
    joined, column = words[0].copy(), len(words[0])
    for word in words[1:]:
        fits = width is None or column + 2 + len(word) <= width
        joined.append("  " if fits else "\n").append_text(word)
        column = (column + 2 if fits else 0) + len(word)
    return joined


def notes(status: PoolStatus) -> list[Text]:
    """Return the sentences below the tables."""
    found = [*status.notes, *troubles(status)]
    for row in status.services:
        order = row.counters.get("order") or {}
        if order.get("trouble"):
            found.append(f"`{row.name}` is unavailable: {order['trouble']}")
        if row.ready_replicas and not row.answers:
            quorum = row.counters["quorum"]
            found.append(f"`{row.name}`: its `quorum` is {quorum}, and fewer replicas are ready")
        needed = row.counters.get("needed_replicas")
        if needed:
            found.append(
                f"`{row.name}`: load exceeds the capacity of its replicas; {needed} would suffice"
            )
        poisoned_at = row.counters.get("poisoned_at")
        if poisoned_at is not None:
            poison = row.counters.get("poison", 0)  # without those that the fallback answered
            requests = {0: "requests", 1: "a request"}.get(poison, f"{poison} requests")
            at = time.strftime("%F %T", time.localtime(poisoned_at))
            found.append(
                f"`{row.name}` ({row.type}): crashed by {requests}, not retried; "
                f"most recently at {at}"
            )
    for one in status.replicas:
        if one.strangers >= _STRANGERS_SHOWN:
            found.append(
                f"replica {one.slot}.{one.generation} has refused {number(one.strangers)} "
                "unauthenticated connections: restrict access to its port with a firewall"
            )
    if status.excluded:
        found.append(f"excluded: {', '.join(status.excluded)}")
    lines: list[Text] = []
    for note in found:  # a log's last lines go below the note that they explain
        first, *more = note.splitlines() or [""]
        lines.append(cell("note:", "bold cyan") + cell(f" {first}"))
        lines += [cell(f"  {line}") for line in more]
    return lines


def troubles(status: PoolStatus) -> list[str]:
    """Return a sentence with the reason for each service or topic whose messages do not arrive."""
    found = [row.counters["trouble"] for row in status.services if row.counters.get("trouble")]
    differing = {name for one in status.replicas for name in one.differing}  # their details say it
    for row in status.topics:
        if row.counters.trouble:
            found.append(row.counters.trouble)
        elif not row.heard_by and status.ready and PREFIX + row.name not in differing:
            found.append(f"`{row.name}` has no subscriber with compatible QoS on a replica")
    return found


def _replicas(
    rows: Sequence[ReplicaStatus], names: Sequence[str], width: int | None, links_known: bool
) -> list[RenderableType]:
    """Return the table of replicas, with their details in it if there is room, else below it."""
    from fogft.cli.table import table

    if not rows:
        return []
    cells = [[*map(_of_replica(row, links_known).__getitem__, names)] for row in rows]
    details = [cell(row.detail) for row in rows]
    own = table(names, cells, width=width, right=NUMBERS, folds=("LOCATION",))
    if not any(details):
        return [own]
    taken = sum(max(len(one) + 2 for one in column) for column in zip(names, *cells, strict=True))
    if width is None or taken + max(map(len, details)) <= width:
        beside = [[*row, one] for row, one in zip(cells, details, strict=True)]
        return [table([*names, ""], beside, right=NUMBERS)]
    below = [(row[0], one) for row, one in zip(cells, details, strict=True) if one]
    return [own, "", table(("", "DETAIL"), below, width=width, folds=("DETAIL",), titled=False)]


def _of_replica(row: ReplicaStatus, links_known: bool) -> dict[str, str | Text]:
    link = row.link or ("-" if links_known else UNKNOWN)
    phase = LOST if row.phase == "starting" and row.has_served else row.phase
    return {
        "REPLICA": f"{row.slot}.{row.generation}",
        "PHASE": cell(phase, PHASES.get(phase, "")) if row.known else UNKNOWN,
        "LOCATION": row.location,
        "$/H": price(row.usd_per_hour).removeprefix("$"),
        "LINK": cell(link, LINKS.get(row.link, "dim")),
        "RTT": milliseconds(row.rtt_s) if links_known else UNKNOWN,
        "FIRST": number(row.won),
        "AGE": "-" if row.age_s is None else age(row.age_s),
    }


def _counted(
    names: Sequence[str], rows: list[list[str | Text]], width: int | None, optional: Sequence[str]
) -> list[RenderableType]:
    """Return a table of traffic counters, whose first column may wrap."""
    from fogft.cli.table import table

    if not rows:
        return []
    return [table(names, rows, width=width, right=NUMBERS, folds=names[:1], optional=optional)]


def _of_service(row: ServiceStatus, links_known: bool) -> list[str | Text]:
    count = row.counters
    ready = number(row.ready_replicas) if links_known else UNKNOWN
    unanswered = sum(count.get(key, 0) for key in ("silent", "empty", "turned_away", "poison"))
    return [
        row.name,
        cell(ready, "" if row.answers else "bold red"),
        number(count.get("received", 0)),
        number(count.get("answered", 0)),
        number(count.get("fallback", 0)),
        cell(number(unanswered), "bold red" if unanswered else ""),
        number(count.get("late", 0)),
        number(count.get("pending", 0)),
        milliseconds(count.get("p50_s")),
        milliseconds(count.get("p99_s")),
    ]


def _of_topic(row: TopicStatus, links_known: bool) -> list[str | Text]:
    count, heard = row.counters, ", ".join(row.heard_by)
    return [
        row.name,
        row.origin,
        (heard or cell("nobody", "bold red")) if links_known else UNKNOWN,
        f"{count.rate_hz:.3g} Hz",
        *map(number, (count.messages, count.passed, count.dropped, count.refused)),
    ]


def topology(drawn: Mapping[str, Any]) -> list[RenderableType]:
    """Return a tree of gateways for each robot; empty without gateways.

    Link states are known only for the links of this machine's robot to its own gateways.
    """
    if not drawn:
        return []
    from rich.tree import Tree

    gateways = {one["name"]: one for one in drawn["gateways"]}
    # Of several links to a gateway, such as to two generations, the one that is up counts.
    links = {one["name"]: one for one in sorted(drawn["links"], key=lambda x: x["state"] == "up")}
    here, named = drawn["robot"], drawn["robots"]
    robots = {here or "this robot": named.get(here, drawn["through"])}
    robots |= {name: through for name, through in named.items() if name != here}

    def below(tree: Tree, through: Sequence[str], links: Mapping[str, Any]) -> Tree:
        for name in through:
            branch = tree.add(_gateway(gateways[name], links.get(name)))
            below(branch, gateways[name]["through"], {})
        if not through:
            tree.add("replicas")
        return tree

    trees: list[RenderableType] = [cell("TOPOLOGY", "bold")]
    for at, (robot, through) in enumerate(robots.items()):
        trees.append(below(Tree(cell(f"robot {robot}")), through, {} if at else links))
    if here and drawn["through"] and len(robots) > 1:
        trees.append(below(Tree("all other robots"), drawn["through"], {}))
    return trees


def _gateway(gateway: Mapping[str, Any], link: Mapping[str, Any] | None) -> Text:
    words = [cell(f"gateway {gateway['name']}"), cell(gateway["endpoint"])]
    if not gateway["generations"]:
        words.append(cell("no certificate", "bold red"))
    if link is not None:
        words.append(cell(link["state"], LINKS.get(link["state"], "")))
        if link.get("rtt_s") is not None and link["state"] == "up":
            words.append(cell(milliseconds(link["rtt_s"])))
        if link.get("detail"):
            words.append(cell(link["detail"]))
    return _joined(words)


def show_table(header: Iterable[str], rows: Iterable[Iterable[str | Text]], **layout: Any) -> None:
    """Write a table to stdout, wrapped to its width; `layout` as in `fogft.cli.table`."""
    from fogft.cli.table import table

    output.show(table(header, rows, width=output.width(sys.stdout), **layout))


def price(usd: float) -> str:
    """Return an amount as ``$0.021``."""
    return f"${usd:.3f}"


def number(value: int) -> str:
    """Return a count with separated thousands."""
    return f"{value:,}".replace(",", " ")


def milliseconds(seconds: float | None) -> str:
    """Return a short duration with three digits: ``0.42 ms``, ``12.3 ms``, ``1.20 s``."""
    if seconds is None:
        return "-"
    if seconds >= 1:
        return f"{seconds:.2f} s"
    value = seconds * 1000
    return f"{value:.{2 if value < 10 else 1 if value < 100 else 0}f} ms"


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
