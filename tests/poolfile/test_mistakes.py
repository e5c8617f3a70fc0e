"""All that is wrong in a file, each mistake once."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.errors import SpecError
from fogft.poolfile import yaml_tree
from fogft.poolfile.pool import Checks, pool_spec
from fogft.poolfile.tree import Mistakes

BAD = """\
name: Pool!
runs: x
run: serve
num_nodes: 2
envs: {1A: x}
fogft:
  replcas: 3
  max_surge: 9
  services:
    - {name: /a, timeout_s: -1, hedging: some}
    - {name: /b, type: p/srv/B, quorum: 9}
    - {name: /b, type: p/srv/B}
  health: {suspect_after_s: 0, start_limit: 3}
  availability: 2
"""
ALL = [
    (1, "name: `Pool!` is not a pool name"),
    (2, "runs: unknown key"),
    (4, "num_nodes: must be 1"),
    (5, "envs.1A: is not the name"),
    (7, "fogft.replcas: unknown key"),
    (8, "fogft.max_surge: must be from 0 to 4"),
    (10, "fogft.services[0].type: is missing"),
    (10, "fogft.services[0].timeout_s: must be above 0"),
    (10, "fogft.services[0].hedging: must be `auto`"),
    (12, "fogft.services[2].name: `/b` is listed twice"),
    (13, "fogft.health.start_limit: unknown key"),
    (13, "fogft.health.suspect_after_s: must be above 0"),
    (14, "fogft.availability: must be above 0"),
]


def found(text: str, **checks) -> list[SpecError]:
    mistakes = Mistakes(keep=True)
    with mistakes.step():
        pool_spec(yaml_tree.tree(text, "p.yaml"), "p.yaml", Checks(**checks), mistakes)
    return sorted(mistakes.found, key=lambda error: error.line)


def test_every_mistake_is_found_with_its_line():
    shown = [(one.line, one.message) for one in found(BAD)]
    assert len(shown) == len(ALL)
    for line, what in ALL:
        assert any(at == line and what in message for at, message in shown), (line, what)
    assert [line for line, _ in shown] == sorted(line for line, _ in shown)


def test_advanced_is_of_fogft_and_not_of_a_task():
    """No key of the task is looked for there."""
    below = "{num_nodes: 2, workdir: 1, envs: {A: b}, secrets: {}, resources: {}, setup: x}"
    told = found(f"run: x\nadvanced: {below}\nfogft: {{services: [{{name: /a, type: p/srv/A}}]}}\n")
    assert ["advanced: unknown key" in one.message for one in told] == [True]


def test_what_only_this_machine_tells_is_asked_of_each_service():
    """Once the file itself is right: two types that are not installed are two mistakes."""
    text = "run: x\nfogft:\n  services:\n" + "".join(
        f"    - {{name: /s{n}, type: p/srv/T{n}}}\n" for n in range(3)
    )
    lacking = SpecError("no package", "install it")
    told = found(text, types=lambda name: None if name == "p/srv/T1" else lacking)
    assert [(one.line, one.key) for one in told] == [
        (4, "fogft.services[0].type"),
        (6, "fogft.services[2].type"),
    ]
    assert {one.hint for one in told} == {"install it"}


lines = BAD.splitlines(keepends=True)


@pytest.mark.parametrize("without", range(len(lines)))
def test_the_first_mistake_is_one_of_all(without):
    """`up` and `check` read by the same rules, whichever lines a file has."""
    text = "".join(line for n, line in enumerate(lines) if n != without)
    try:
        tree = yaml_tree.tree(text, "p.yaml")
    except SpecError:
        return
    with pytest.raises(SpecError) as first:
        pool_spec(tree, "p.yaml")
    assert first.value.message in [one.message for one in found(text)]


@given(st.lists(st.sampled_from(lines), max_size=12))
def test_a_file_is_right_exactly_where_nothing_is_found(some):
    text = "".join(some)
    try:
        tree = yaml_tree.tree(text, "p.yaml")
    except SpecError:
        return
    try:
        pool_spec(tree, "p.yaml")
    except SpecError:
        assert found(text)
    else:
        assert not found(text)


SMALL = "run: x\n%s\nfogft:\n  services: [{name: /a, type: std_srvs/srv/Trigger}]\n  %s\n"
NO_MAP = "any_of[0]: must be a map"


@pytest.mark.parametrize(
    ("task", "keys", "line", "message"),
    [
        ("secrets: [HF_TOKEN]", "", 2, "secrets: must be a map"),
        ("secrets: {HF_TOKEN: null}", "", 2, "secrets.HF_TOKEN: must have a text"),
        ("resources: {labels: [team-a]}", "", 2, "resources.labels: must be a map"),
        ("", "gateway: {launch: true, resources: {any_of: [aws]}}", 5, NO_MAP),
        ("", "groups: [{name: a, replicas: 1, resources: {labels: [b]}}]", 5, "must be a map"),
        ("resources: 5", "groups: [{name: a, replicas: 1}]", 2, "resources: must be a map"),
    ],
)
def test_what_skypilot_would_take_for_something_else_is_told(task, keys, line, message):
    """In each place in which resources stand, and before anything is launched."""
    [first, *_] = found(SMALL % (task, keys))
    assert message in first.message
    assert first.line == line or first.message.startswith(f"p.yaml:{line}: ")


@pytest.mark.parametrize(("written", "told"), [("25:00", "25:00"), ("true", "True"), ("-5", "-5")])
def test_a_time_that_there_is_not_is_told_as_it_was_written(written, told):
    """YAML 1.1 reads 25:00 as the number 1500."""
    window = f"{{from: {written}, to: '6:00', replicas: 0}}"
    [mistake] = found(SMALL % ("", f"schedule: {{time_zone: UTC, windows: [{window}]}}"))
    assert f"`{told}` is not a time of the day" in str(mistake)


def test_a_schedule_may_ask_for_no_replica_at_night():
    window = "{from: '20:00', to: '6:00', replicas: 0}"
    assert found(SMALL % ("", f"schedule: {{time_zone: UTC, windows: [{window}]}}")) == []


@pytest.mark.parametrize("host", ["meet..example.org", "x" * 64 + ".org", ".org", ".."])
def test_a_host_name_that_no_resolver_takes_is_told(host):
    """Python's own raises an error for it that is none of the network's."""
    [first] = found(SMALL % ("", f"rendezvous: ['{host}:7450']"))
    assert "not `host:port`" in first.message
    assert found(SMALL % ("", "rendezvous: ['example.org.:7450', '[::1]:7450']")) == []
