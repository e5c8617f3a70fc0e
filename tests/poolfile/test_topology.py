"""`topology` in a pool file: what it means, and how mistakes are told."""

from __future__ import annotations

import pytest

from fogft.errors import SpecError
from fogft.model.topology import Gateway, RobotRoute, Topology
from fogft.poolfile import file

FILE = """name: p
run: exec serve
fogft:
  services: [{name: /s, type: std_srvs/srv/SetBool%s}]
  rendezvous: [meet:7450]
  topology: %s
"""


def parse(topology: str, service: str = "", drop: str = ""):
    text = (FILE % (service, topology)).replace(drop or "\0", "")
    return file.parse(text, file="p.yaml").topology


def test_what_is_written_is_what_is_meant():
    found = parse(
        "{gateways: [{name: a, endpoint: h:1, upstream: [b]}, {name: b, endpoint: h:2}],"
        " robots: [{name: ada, gateways: [a, b]}, {name: bob, gateways: []}],"
        " default_gateways: [b]}"
    )
    assert found == Topology(
        (Gateway("a", "h:1", ("b",)), Gateway("b", "h:2")),
        (RobotRoute("ada", ("a", "b")), RobotRoute("bob", ())),
        ("b",),
    )


ONE = "gateways: [{name: a, endpoint: h:1}]"
WRONG = {
    "a loop": ("{gateways: [{name: a, endpoint: h:1, upstream: [b]},"
               " {name: b, endpoint: h:2, upstream: [a]}]}", "loop: a -> b -> a"),
    "itself": ("{gateways: [{name: a, endpoint: h:1, upstream: [a]}]}", "loop: a -> a"),
    "unknown": ("{" + ONE + ", default_gateways: [c]}", "there is no gateway"),
    "unknown of a robot": ("{" + ONE + ", robots: [{name: r, gateways: [c]}]}", "there is no"),
    "robot twice": (
        "{" + ONE + ", robots: [{name: r, gateways: []}, {name: r, gateways: []}]}", "twice"),
    "gateway twice": ("{gateways: [{name: a, endpoint: h:1}, {name: a, endpoint: h:2}]}", "twice"),
    "listed twice": ("{" + ONE + ", default_gateways: [a, a]}", "twice"),
    "no list": ("{" + ONE + ", default_gateways: a}", "must be a list"),
    "no endpoint": ("{gateways: [{name: a}]}", "is missing"),
    "bad endpoint": ("{gateways: [{name: a, endpoint: here}]}", "not `host:port`"),
    "bad name": ("{gateways: [{name: a b, endpoint: h:1}]}", "is not a name"),
    "no gateways": ("{default_gateways: []}", "is missing"),
    "unknown key": ("{" + ONE + ", robot: x}", "unknown key"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_mistakes_are_told_with_line_and_remedy(case):
    topology, words = WRONG[case]
    with pytest.raises(SpecError, match=words) as found:
        parse(topology)
    assert found.value.message.startswith("p.yaml:6: fogft.topology")
    assert found.value.hint


def test_what_does_not_go_with_gateways_is_refused():
    """Votes and states need every replica to be asked by the robot itself."""
    with pytest.raises(SpecError, match="which has `quorum`"):
        parse("{" + ONE + "}", ", quorum: 2")
    with pytest.raises(SpecError, match="which has `state`"):
        parse("{" + ONE + "}", ", state: {snapshot: /a, restore: /b}")
    with pytest.raises(SpecError, match="needs a `rendezvous`"):
        parse("{" + ONE + "}", drop="  rendezvous: [meet:7450]\n")


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("dial_in: h:1", "dial_in: cannot be combined with `gateway"),
        ("topology: {" + ONE + "}", "topology: cannot be combined with `gateway"),
        ("max_hours: 1", "rendezvous: cannot be combined with `gateway"),
    ],
)
def test_a_launched_gateway_sets_all_that_is_about_it(more, words):
    text = FILE.replace("topology: %s", "gateway: {launch: true}\n  " + more).replace("%s", "")
    dropped = text if "rendezvous" in words else text.replace("  rendezvous: [meet:7450]\n", "")
    with pytest.raises(SpecError, match=words):
        file.parse(dropped, file="p.yaml")


def test_a_launched_gateway_is_what_all_talk_through_once_its_address_is_known():
    text = FILE.replace("topology: %s", "gateway: {launch: true, port: 9000}").replace("%s", "")
    spec = file.parse(text.replace("  rendezvous: [meet:7450]\n", ""), file="p.yaml")
    assert (spec.dials_out, spec.topology, spec.dial_in) == (True, Topology(), "")
    there = spec.behind("h")
    assert there.topology == Topology((Gateway("gateway", "h:9000"),), through=("gateway",))
    assert (there.rendezvous, there.dial_in) == (("h:9001",), "h:9002")
    assert there.replica_hash != there.behind("elsewhere").replica_hash
