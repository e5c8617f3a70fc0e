"""What `up` is about to do with a pool file, before anything is changed.

Owns: the placements that a new pool would get, and what a changed file changes.
Not here: doing it (`startup`) and saying it (`fogft.cli`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from fogft.cloud.port import Accounts, Cloud
from fogft.errors import CloudError, PoolNotFound, SpecError
from fogft.model.intent import Intent
from fogft.model.replica import Observed, Offer
from fogft.model.spec import PoolSpec
from fogft.planning.observed.history import History
from fogft.planning.planner import plan
from fogft.planning.rollout import has_room
from fogft.pool.folder.store import PoolStore, digest
from fogft.pool.manager import offers
from fogft.poolfile.changes import changes, replaces_replicas
from fogft.poolfile.named_clouds import clouds_named, located

Far = Callable[[PoolSpec, Sequence[Offer]], Mapping[str, float]]
# What an age is told in: the unit, its length, and from which age on.
_UNITS = (("days", 86400.0, 2 * 86400.0), ("h", 3600.0, 5400.0), ("min", 60.0, 90.0))


@dataclass(frozen=True)
class PreviewedLaunch:
    """Where a replica would go now, and what it would cost there.

    Attributes:
        price: Where the price comes from and how old it is, in words; empty where it is made up.
    """

    slot: int
    location: str
    instance: str
    usd_per_hour: float
    price: str = ""


@dataclass(frozen=True)
class Preview:
    """What applying a pool file would do.

    Attributes:
        wanted: Replicas wanted now: the file's number, or what follows from it.
        launches: Of a new pool; by slot. Of one that exists: what it would get if it were new.
        costs_money: Its machines are paid for: nothing is ordered unasked.
        accounts: Of each cloud whose credentials were tested: empty, or what is wrong.
        changes: Of a pool that exists: what the file now says otherwise, in words.
        new_before_old: The budget has room for a replica and its successor at once.
        rolled_back: Why this very file was given up before; empty where it was not.
        notes: What may surprise: fewer placements than replicas, no prices now.
    """

    spec: PoolSpec
    cloud: str
    is_new: bool
    wanted: int = 0
    launches: tuple[PreviewedLaunch, ...] = ()
    changes: tuple[str, ...] = ()
    replaces_replicas: bool = False
    new_before_old: bool = True
    rolled_back: str = ""
    notes: tuple[str, ...] = ()
    costs_money: bool = False
    accounts: Mapping[str, str] = field(default_factory=dict)

    @property
    def usd_per_hour(self) -> float:
        """What the launches cost together."""
        return sum(launch.usd_per_hour for launch in self.launches)


@dataclass(frozen=True)
class Order:
    """A pool file that was read and judged, and what applying it would do."""

    preview: Preview
    source: str
    file: Path

    @property
    def spec(self) -> PoolSpec:
        """What the file asks for."""
        return self.preview.spec

    @property
    def digest(self) -> str:
        """What names the file's text in a pool's status."""
        return digest(self.source.encode())


def order(
    store: PoolStore,
    cloud: Cloud,
    spec: PoolSpec,
    *,
    cloud_name: str,
    source: str,
    file: Path,
    now: float = 0.0,
    far: Far = lambda spec, sold: spec.placement.rtt_s,
) -> Order:
    """Return what applying a pool file would do. Changes nothing.

    Args:
        store: The pool's folder, which may not exist yet.
        cloud: Where the pool shall run.
        spec: The file, read.
        cloud_name: The cloud's name.
        source: The file's text.
        file: Where it is.
        now: Seconds since the epoch.
        far: Says how far the regions of offers are: ``cloud/region`` -> seconds.

    Raises:
        SpecError: The cloud can never meet the file's resources.
        CloudError: A new pool, and none of the clouds that it names can be used.
    """
    before, rolled_back = _before(store, source)
    notes: list[str] = []
    accounts: Mapping[str, str] = {}
    if isinstance(cloud, Accounts):
        try:
            cloud.check_task(spec.task)
        except SpecError as error:
            raise located(error, source, file) from None
        accounts, found = _tested(cloud, clouds_named(spec), may_fail=before is not None)
        notes += found
    sold: tuple[Offer, ...] = ()
    try:
        sold = offers.ask(cloud, spec)
    except SpecError as error:
        raise located(error, source, file) from None
    except CloudError as error:
        notes.append(f"prices cannot be had now: {error.message}")
    observed = Observed(now, (), None, sold, rtt_s=far(spec, sold))
    planned = plan("0" * 16, spec, Intent(), observed, History())
    replaces = before is not None and not rolled_back and replaces_replicas(before, spec)
    usd_per_hour = sum(launch.offer.usd_per_hour for launch in planned.launches)
    cheapest = min((offer.usd_per_hour for offer in sold), default=0.0)
    preview = Preview(
        spec,
        cloud_name,
        is_new=before is None,
        wanted=planned.wanted,
        launches=tuple(_launch(launch.slot, launch.offer, now) for launch in planned.launches),
        changes=() if before is None or rolled_back else tuple(changes(before, spec)),
        replaces_replicas=replaces,
        new_before_old=has_room(spec, usd_per_hour, cheapest),
        rolled_back=rolled_back,
        notes=(*notes, *(planned.notes if before is None and sold else ())),
        costs_money=isinstance(cloud, Accounts),
        accounts=accounts,
    )
    return Order(preview, source, file)


def _before(store: PoolStore, source: str) -> tuple[PoolSpec | None, str]:
    """Return the file in force, None for none, and why this very one was given up, if it was."""
    try:
        store.identity()
        before, trial = store.spec(), store.trial()
    except (PoolNotFound, SpecError):
        return None, ""
    same = trial.file == digest(source.encode()) == store.applied()
    return before, trial.fault if same else ""


def _tested(
    cloud: Accounts, named: Sequence[str], *, may_fail: bool
) -> tuple[Mapping[str, str], list[str]]:
    """Test credentials; return the outcome by cloud, and what is worth knowing besides."""
    try:
        accounts = dict(cloud.check(named))
    except CloudError as error:
        if not may_fail:
            raise
        return {}, [f"credentials cannot be tested now: {error.message}"]
    usable = sorted(name for name, problem in accounts.items() if not problem)
    if not usable and not may_fail:
        listed = "\n".join(f"  `{name}`: {problem}" for name, problem in accounts.items())
        raise CloudError(
            f"no cloud can be used with the credentials that are here\n{listed}".rstrip(),
            "set one up as `sky check` says, or try the pool on this machine with `--cloud local`",
        )
    return accounts, [reason for name in usable if (reason := cloud.unverified(name))]


def _launch(slot: int, offer: Offer, now: float) -> PreviewedLaunch:
    place = offer.placement
    return PreviewedLaunch(
        slot, place.location, place.instance, offer.usd_per_hour, price_told(offer, now)
    )


def price_told(offer: Offer, now: float) -> str:
    """Return where an offer's price comes from and how old it is, in words."""
    if not offer.source or not offer.as_of:
        return offer.source
    return f"{offer.source}, {age_told(now - offer.as_of)} old"


def age_told(seconds: float) -> str:
    """Return an age in its one largest unit, in words: ``3 s``, ``5 min``, ``7 h``, ``2 days``."""
    for unit, length_s, from_s in _UNITS:
        if seconds >= from_s:
            return f"{seconds / length_s:.0f} {unit}"
    return f"{max(0.0, seconds):.0f} s"
