"""The services of a pool whose file lists none, as a manager maintains them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from fogft.model.choices import Speaks
from fogft.model.replica import Observed
from fogft.model.spec import Middleware
from fogft.pool.folder.discovered import Discovery
from tests.planning.observed.test_services import SPEC, A, link, machine

LIE = ("/robot/emergency_stop", "a/srv/A")
ROUND_S = 60.0


def test_what_a_replica_claimed_while_it_was_alone_goes_once_most_deny_it(tmp_path: Path) -> None:
    """Else nobody but the liar would ever be ready, and others be launched without end."""
    spec = replace(SPEC, rmw=Middleware(robot=Speaks.ZENOH))
    discovery = Discovery(tmp_path / "discovered.json")
    machines, links = [machine(0)], [link(0, A, LIE)]
    assert discovery.look(spec, Observed(0.0, tuple(machines), tuple(links)), 1)
    assert discovery.known.services.keys() == {A[0], LIE[0]}
    machines += [machine(1), machine(2)]
    links += [link(1, A), link(2, A)]
    lasted = 0
    while LIE[0] in discovery.known.services:
        lasted += 1
        discovery.look(spec, Observed(lasted * ROUND_S, tuple(machines), tuple(links)), 3)
    assert spec.health.start_limit_s / 2 < lasted * ROUND_S < spec.health.start_limit_s
    for later in range(lasted, lasted + 30):  # what three have confirmed, one cannot take back
        discovery.look(spec, Observed(later * ROUND_S, tuple(machines), (link(0, LIE),)), 3)
    assert dict(discovery.known.services) == dict([A])
    assert Discovery(tmp_path / "discovered.json").known == discovery.known


def test_a_clock_that_is_set_takes_no_service_back(tmp_path: Path) -> None:
    """Of three replicas that start, two have not come to offer it for a second."""
    spec = replace(SPEC, rmw=Middleware(robot=Speaks.ZENOH))
    discovery = Discovery(tmp_path / "discovered.json")
    discovery.look(spec, Observed(0.0, (machine(0),), (link(0, A, LIE),)), 1)
    machines, links = tuple(map(machine, range(3))), (link(0, A, LIE), link(1, A), link(2, A))
    for now, doubt_s in ((1.0, 0.0), (3602.0, 3600.0), (3603.0, 3600.0), (3663.0, 0.0)):
        discovery.look(spec, Observed(now, machines, links, doubt_s=doubt_s), 3)
    assert LIE[0] in discovery.known.services
