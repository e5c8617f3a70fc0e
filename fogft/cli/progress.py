"""What ``fogft up`` shows: what it will do, then each replica as it comes.

On a terminal a table that is redrawn; elsewhere one line for each change. All of it goes
to stderr.

Owns: the words and the waiting.
Not here: what is done (`fogft.app`).
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from fogft.cli import output

if TYPE_CHECKING:
    from fogft.model.spec import PoolSpec
    from fogft.pool.commands.preview import Preview
    from fogft.pool.commands.status import Seen

LOOK_EVERY_S = 0.2


def announce(preview: Preview) -> None:
    """Say what will be done."""
    spec = preview.spec
    for name, problem in preview.accounts.items():
        output.say(f"`{name}` " + (f"cannot be used: {problem}" if problem else "can be used"))
    if preview.is_new:
        count = _count(preview.wanted or spec.replicas, "replica")
        output.say(f"pool `{spec.name}`: {count} on `{preview.cloud}`")
        _say_launches(preview)
    elif preview.changes:
        output.say(f"pool `{spec.name}` changes:")
        for change in preview.changes:
            output.say(f"  {change}")
        if preview.replaces_replicas:
            order = "new before old" if preview.new_before_old else "old before new"
            output.say(f"  so its replicas are replaced one after the other, {order}")
            if not preview.new_before_old:
                output.say(f"  {_no_room(spec)}")
        if preview.costs_money and preview.launches:
            output.say(f"  at the prices of now all of it costs ${preview.usd_per_hour:.3f}/h")
    elif not preview.rolled_back:
        output.say(f"pool `{spec.name}` is as its file says; nothing changes")
    for note in preview.notes:
        output.warn(note)


def _no_room(spec: PoolSpec) -> str:
    """Say why a replica ends before its successor exists, and what that means."""
    if spec.max_surge == 0:
        why = "`max_surge` is 0"
    else:
        why = f"${spec.max_usd_per_hour:g}/h (`max_usd_per_hour`) has no room for both"
    if spec.replicas == 1:
        return f"{why}, and a single replica is not ended before: it stays as it is"
    return f"{why}: meanwhile one fewer answers"


def _say_launches(preview: Preview) -> None:
    """Say where each replica will go, at what price, and how sure that is."""
    rows = [
        (f"  {x.slot}", x.location, x.instance, f"${x.usd_per_hour:.3f}/h", x.price)
        for x in preview.launches
    ]
    if rows:
        told = any(launch.price for launch in preview.launches)
        output.say(output.aligned(row if told else row[:-1] for row in rows))
        output.say(f"  together ${preview.usd_per_hour:.3f}/h")


def wait(
    look: Callable[[], Seen], until: Callable[[Seen], bool], timeout_s: float
) -> tuple[Seen, bool]:
    """Show a pool's progress until it is as wanted; return what was last seen, and whether it is.

    Args:
        look: Returns the pool's status; raises what ends the waiting.
        until: Whether a status is good enough.
        timeout_s: The longest to wait.
    """
    deadline = time.monotonic() + timeout_s
    with _shown() as show:
        while True:
            seen = look()
            show(seen)
            good = until(seen)
            if good or time.monotonic() >= deadline:
                return seen, good
            time.sleep(LOOK_EVERY_S)


@contextmanager
def _shown() -> Iterator[Callable[[Seen], None]]:
    """Yield a function that shows a status, in the way that stderr is fit for."""
    if not output.is_terminal(sys.stderr):
        yield PhaseLines(output.say)
        return
    from fogft.cli import status_text

    room, colour = output.width(sys.stderr), output.coloured(sys.stderr)
    with output.redrawn(sys.stderr) as show:
        yield lambda seen: show(status_text.starting(seen.status, width=room, colour=colour))


class PhaseLines:
    """One line for each replica's change of phase, and for each new note."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._known: dict[str, tuple[str, str]] = {}
        self._notes: set[str] = set()

    def __call__(self, seen: Seen) -> None:
        """Say what is new."""
        replicas = {f"{r.slot}.{r.generation}": r for r in seen.status.replicas}
        for name, replica in replicas.items():
            phase, detail = self._known.get(name, ("", ""))
            self._known[name] = (replica.phase, replica.detail)
            if phase != replica.phase:
                where = "" if phase else f" at {replica.location}"
                self._say(f"{name}  {replica.phase}{where}")
            if replica.detail not in ("", detail):
                self._say(f"{name}  {replica.detail}")
        for name in [name for name in self._known if name not in replicas]:
            del self._known[name]
            self._say(f"{name}  gone")
        for note in seen.status.notes:
            if note not in self._notes:
                self._notes.add(note)
                self._say(f"note: {note}")


def _count(count: int, word: str) -> str:
    return f"{count} {word}{'' if count == 1 else 's'}"
