"""Preview what `up` would do with a pool file, before anything is changed.

Owns: the placements that a new pool would get, and what a changed file changes.
Not here: applying the file (`startup`) and showing the preview (`fogft.cli`).
"""

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from fogft.cloud.port import RealCloud
from fogft.errors import CloudError, PoolNotFound, SpecError
from fogft.model.choices import Speaks
from fogft.model.intent import Intent
from fogft.model.replica import Observed, Offer
from fogft.model.spec import PoolSpec
from fogft.planning.buying import PlannedLaunch
from fogft.planning.lifetime import HOUR_S
from fogft.planning.observed.history import History
from fogft.planning.planner import plan
from fogft.planning.rollout import has_room
from fogft.planning.sizing import Inputs
from fogft.pool.commands.composition import LOCAL, make_cloud, make_store
from fogft.pool.commands.plan import far
from fogft.pool.commands.sweep import left_of
from fogft.pool.folder.store import Identity, PoolStore, digest
from fogft.pool.manager import launched_gateway, offers
from fogft.poolfile import file as pool_file
from fogft.poolfile.changes import changes, replaces_replicas
from fogft.poolfile.named_clouds import cloud_named_by, clouds_named, located
from fogft.poolfile.pool import Checks
from fogft.reason_words import words
from fogft.ros.reservations import own_domain


@dataclass(frozen=True)
class Preview:
    """The effect of applying a pool file.

    Attributes:
        launches: The launches of a new pool, by slot; of an existing pool, those if it were new.
        costs_money: Its machines cost money: nothing is ordered without asking.
        accounts: Each cloud whose credentials were tested -> the problem; empty for none.
        changes: For an existing pool, the changes of the file, in words.
        new_before_old: The budget has room for a replica and its successor at once.
        rolled_back: Why this same file was given up before; empty if it was not.
    """

    spec: PoolSpec
    cloud: str
    source: str
    file: Path
    is_new: bool
    wanted: int = 0
    launches: tuple[PlannedLaunch, ...] = ()
    observed_at: float = 0.0
    changes: tuple[str, ...] = ()
    replaces_replicas: bool = False
    new_before_old: bool = True
    rolled_back: str = ""
    notes: tuple[str, ...] = ()
    costs_money: bool = False
    accounts: Mapping[str, str] = field(default_factory=dict)

    @property
    def usd_per_hour(self) -> float:
        """The total price of the launches."""
        return sum(launch.offer.usd_per_hour for launch in self.launches)


def order(
    file: Path, cloud: str | None = None, *, told: Callable[[str], None] = lambda _: None
) -> Preview:
    """Read and check a pool file, and preview its effect. Changes nothing.

    The pool runs on `cloud`, by default the one that its resources name, else `local`; `told` is
    called before slow steps. Raises FogftError: the file, or ROS_DOMAIN_ID, cannot be used.
    """
    source = pool_file.read_text(file)
    spec = pool_file.parse(source, str(file), checks_here(), file.resolve().parent)
    # Before machines are launched that no client proxy could use.
    own_domain(of_dds=spec.rmw.robot is Speaks.RCLPY)
    cloud_name = cloud or cloud_named_by(spec, source, file)
    concrete = make_cloud(cloud_name)
    store = make_store(spec.name)
    with contextlib.suppress(PoolNotFound):
        check_same(store.identity(), spec, file.resolve(), cloud_name)
    before, rolled_back = _before(store, source)
    notes: list[str] = []
    accounts: Mapping[str, str] = {}
    sold: tuple[Offer, ...] = ()
    beside: tuple[PlannedLaunch, ...] = ()
    try:
        if isinstance(concrete, RealCloud):
            told("asking SkyPilot for usable clouds and prices")
            concrete.check_task(spec.task)
            accounts, found = _tested(concrete, clouds_named(spec), may_fail=before is not None)
            notes += found
            usable = [name for name, problem in accounts.items() if not problem]
            ends_at = None if spec.max_hours is None else time.time() + spec.max_hours * HOUR_S
            try:
                notes += concrete.hindrances(usable, ends_at)
                notes += concrete.exposures(
                    usable,
                    open_port=None if spec.dials_out else spec.link_port,
                    allow_from=spec.allow_from,
                )
            except CloudError as error:
                notes.append(f"cannot tell now which files a VM gets: {error.message}")
        try:
            sold = offers.ask(concrete, spec)
            beside = launched_gateway.planned(concrete, spec)
            notes += concrete.left_out() if isinstance(concrete, RealCloud) else ()
        except CloudError as error:
            notes.append(f"prices are not available now: {error.message}")
    except SpecError as error:
        raise located(error, source, file) from None
    if before is None:
        notes += left_of(spec.name, cloud_name, concrete)
    known, _ = far(spec, sold, told=told)
    rtt_s = {region: distance.rtt_s for region, distance in known.items()}
    now = time.time()
    observed = Observed(now, (), None, sold, rtt_s=rtt_s)
    planned = plan("0" * 16, Inputs(spec, Intent(), observed, History()))
    after = spec
    if before is not None and before.gateway.launch and before.dial_in and spec.gateway.launch:
        after = spec.behind(before.dial_in.rpartition(":")[0])
    replaces = before is not None and not rolled_back and replaces_replicas(before, after)
    usd_per_hour = sum(launch.offer.usd_per_hour for launch in planned.launches)
    cheapest = min((offer.usd_per_hour for offer in sold), default=0.0)
    return Preview(
        spec,
        cloud_name,
        source,
        file,
        is_new=before is None,
        wanted=planned.wanted,
        launches=(*planned.launches, *beside),
        observed_at=now,
        changes=() if before is None or rolled_back else tuple(changes(before, after)),
        replaces_replicas=replaces,
        new_before_old=has_room(spec, usd_per_hour, cheapest),
        rolled_back=rolled_back,
        notes=(*notes, *(map(words, planned.notes) if before is None and sold else ())),
        costs_money=isinstance(concrete, RealCloud),
        accounts=accounts,
    )


def check_same(identity: Identity, spec: PoolSpec, file: Path, cloud: str) -> None:
    """Raise SpecError if a pool of this name runs from another file or on another cloud."""
    if Path(identity.file) != file:
        raise SpecError(
            f"{file}: name: pool `{spec.name}` was started from `{identity.file}`",
            "give this one another `name`, put that file back if it was moved, or shut its pool "
            f"down with `fogft down {spec.name}`",
        )
    if identity.cloud != cloud:
        raise SpecError(
            f"{file}: pool `{spec.name}` runs on cloud `{identity.cloud}`, not `{cloud}`",
            f"shut it down with `fogft down {spec.name}` first",
        )


def _before(store: PoolStore, source: str) -> tuple[PoolSpec | None, str]:
    """Return the file in force (None for none), and why `source` was given up, if it was."""
    try:
        store.identity()
        before, trial = store.spec(), store.trial()
    except (PoolNotFound, SpecError):
        return None, ""
    same = trial.file == digest(source.encode()) == store.applied()
    return before, words(trial.fault) if same else ""


def _tested(
    cloud: RealCloud, named: Sequence[str], *, may_fail: bool
) -> tuple[Mapping[str, str], list[str]]:
    """Test credentials; return the outcome by cloud, and notes."""
    try:
        accounts = dict(cloud.check(named))
    except CloudError as error:
        if not may_fail:
            raise
        return {}, [f"credentials cannot be checked now: {error.message}"]
    usable = sorted(name for name, problem in accounts.items() if not problem)
    if not usable and not may_fail:
        listed = "\n".join(f"  `{name}`: {problem}" for name, problem in accounts.items())
        raise CloudError(
            f"no cloud can be used with the credentials on this machine\n{listed}".rstrip(),
            "set one up as `sky check` says, or try the pool locally with `--cloud local`",
        )
    return accounts, [reason for name in usable if (reason := cloud.unverified(name))]


def checks_here() -> Checks:
    """Return the checks that depend on this machine: installed types and their fields."""
    from fogft.ros.messages import Comparison, bool_field
    from fogft.ros.state_bytes import StateBytes
    from fogft.ros.types import load_type, trouble

    made = (load_type, bool_field, StateBytes, Comparison)
    return Checks(*(partial(trouble, make) for make in made))


def mistakes(file: Path) -> list[SpecError]:
    """Return all mistakes in a pool file, by line.

    Whether real clouds accept `resources` is left to `fogft plan` and `fogft up`, which ask them.
    """
    checks = checks_here()
    found = pool_file.mistakes(file, checks)
    if found:
        return found
    try:
        source = pool_file.read_text(file)
        spec = pool_file.parse(source, str(file), checks, file.resolve().parent)
        if cloud_named_by(spec, source, file) == LOCAL:
            make_cloud(LOCAL).offers(spec.task.get("resources") or {})
    except SpecError as error:
        return [error if error.line else located(error, source, file)]
    return []
