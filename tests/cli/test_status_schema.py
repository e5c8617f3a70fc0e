"""What `fogft status --json` prints is what its schema promises."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path

import jsonschema
import pytest
from hypothesis import given

from fogft.cli import main
from fogft.model.plain import from_plain, to_plain
from fogft.model.reason import Cause, Reason
from fogft.planning.observed.history import Event, EventKind
from fogft.pool.commands.status import Seen, status_schema
from fogft.pool.folder.store import Identity
from fogft.pool.manager import status
from fogft.pool.manager.reconciler import Tick
from tests.fakes.pools import STATUS, lay_down
from tests.planning.pool_worlds import NOW, UID, World, worlds

SCHEMA = status_schema()
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)
FULL = Reason(
    Cause.TARGET_UNMET, 1, "1.2", "c/r/a", "/plan", 1.5, 2, 3, 0.5, 0.9, 0.1, 0.2, "full",
    (Reason(Cause.OVER_CAP),),
)  # fmt: skip
# Settled: later versions of the same number have these and more.
KEYS = {
    "age_s", "answers", "applied", "by_hand", "cloud", "cloud_reachable", "credentials_end_at",
    "ended", "epoch",
    "events", "excluded", "file", "links_known", "manager_alive", "manager_pid",
    "manager_version", "notes", "observed_at", "pool", "proxy_alive", "proxy_pid",
    "proxy_version", "ready", "reasons", "replicas", "report_age_s", "services", "stopping",
    "target", "topics", "topology", "uid", "unanswered", "update", "uplink_suspected",
    "usd_per_hour", "usd_to_date", "version",
}  # fmt: skip


def check(shown: object) -> None:
    VALIDATOR.validate(json.loads(json.dumps(shown)))


@given(worlds())
def test_every_status_is_valid(world: World) -> None:
    """Whatever the world, and the same after it was read back from the file."""
    identity = Identity("pool", UID, "mock", "/pool.yaml", NOW)
    tick = Tick(identity, world.spec, world.intent, world.observed, world.plan(), None)
    seen = status.of_tick(
        tick,
        history=world.history,
        recent=[Event(NOW, EventKind.FAILED, 0, 1, "c/r/a", FULL)],
    ).joined(None, proxy_alive=True, links=world.observed.links)
    check(Seen(seen, None, manager_alive=True).to_json())
    again = status.from_json(json.loads(json.dumps(to_plain(seen))), Path("status.json"))
    assert (again.reasons, again.events) == (seen.reasons, seen.events)


def test_the_command_prints_what_is_valid_and_its_schema(home, capsys) -> None:
    stopped = status.UpdateStatus("stopped", 1, 3, "no", FULL)
    lay_down(home, replace(STATUS, update=stopped, reasons=(FULL,)))
    assert main.run(["status", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    check(shown)
    assert shown["reasons"][0]["because"] == [{"cause": "over_cap"}]
    assert main.run(["status", "--schema"]) == 0
    assert json.loads(capsys.readouterr().out) == SCHEMA


@pytest.mark.parametrize("wrong", [{"ready": "2"}, {"reasons": [{}]}, {"update": {}}])
def test_what_is_no_status_is_not_valid(wrong: dict[str, object]) -> None:
    with pytest.raises(jsonschema.ValidationError):
        check({**Seen(STATUS, 1.0, manager_alive=True).to_json(), **wrong})


def test_the_keys_of_this_version_are_settled() -> None:
    """A key that goes, or is named otherwise, is another version's."""
    assert status.VERSION == 1
    assert set(SCHEMA["required"]) == KEYS


def test_the_schema_in_the_docs_is_this_one() -> None:
    """Written by `fogft status --schema > docs/reference/status.schema.json`."""
    path = Path(__file__).parents[2] / "docs/reference/status.schema.json"
    assert json.loads(path.read_text()) == SCHEMA
    assert [name for name in SCHEMA["$defs"] if f"#/$defs/{name}" not in path.read_text()] == []


def test_a_reason_survives_json() -> None:
    assert from_plain(Reason, json.loads(json.dumps(to_plain(FULL)))) == FULL
    assert all(getattr(FULL, field.name) for field in fields(FULL)), "every field is tried"
    assert to_plain(Reason(Cause.NOTICE)) == {"cause": "preemption_notice"}
