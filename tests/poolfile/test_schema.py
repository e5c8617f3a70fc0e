"""The JSON Schema agrees with the reader on every example, and on what is wrong in one."""

from __future__ import annotations

import jsonschema
import pytest
import yaml

from fogft.errors import SpecError
from fogft.poolfile import file, schema
from tests.docs.documents import ROOT

SCHEMA = jsonschema.Draft202012Validator(schema.pool_schema())
POOL_FILES = sorted((ROOT / "templates").glob("*/pool.yaml"))
PAGE = (ROOT / "docs" / "reference" / "pool-file.md").read_text()
EXAMPLES = [part.split("```")[0] for part in PAGE.split("```yaml\n")[1:4]]
TEXTS = [*(path.read_text() for path in POOL_FILES), *EXAMPLES]


def pool(ours: str) -> str:
    return f"run: x\nfogft:\n  services: [{{name: /a, type: a/srv/A}}]\n  {ours}\n"


def test_it_is_a_schema() -> None:
    jsonschema.Draft202012Validator.check_schema(schema.pool_schema())


@pytest.mark.parametrize("text", TEXTS)
def test_every_example_fits(text: str) -> None:
    assert [error.message for error in SCHEMA.iter_errors(yaml.safe_load(text))] == []
    file.parse(text, file="pool.yaml")


@pytest.mark.parametrize("path", POOL_FILES, ids=lambda path: path.parent.name)
def test_every_example_names_the_schema(path) -> None:
    assert path.read_text().startswith(f"# yaml-language-server: $schema={schema.FILE}\n")


@pytest.mark.parametrize(
    "ours",
    [
        "replcas: 3",
        "replicas: 101",
        "replicas: two",
        "max_usd_per_hour: 0",
        "health: {suspect_after_s: -1}",
        "on_demand: {base: 1.5}",
        "availability: 1.5",
        "advanced: {migration: {gain: 0.1}}",
        "topics: [{name: /t, type: p/msg/T}]",
        "rmw: dds",
        "metrics: {proxy: 9464}",
        "schedule: {time_zone: UTC}",
        "rendezvous: []",
    ],
)
def test_a_mistake_does_not_fit_and_is_refused(ours: str) -> None:
    """What the schema refuses, the reader refuses as well."""
    assert list(SCHEMA.iter_errors(yaml.safe_load(pool(ours))))
    with pytest.raises(SpecError):
        file.parse(pool(ours), file="pool.yaml")


@pytest.mark.parametrize(
    "ours",
    [
        "availability: 0.999",
        "availability: {target: 0.999, recovery_s: 60}",
        "rmw: zenoh",
        "rmw: {robot: zenoh}",
        "advanced: {migration: false}",
        "topics: [{name: /t, type: p/msg/T, from: robot}]",
    ],
)
def test_what_is_right_in_a_short_form_fits(ours: str) -> None:
    assert not list(SCHEMA.iter_errors(yaml.safe_load(pool(ours))))
    file.parse(pool(ours), file="pool.yaml")
