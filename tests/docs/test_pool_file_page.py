"""docs/pool-file.md says what the code does: its keys, defaults, limits and example."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from fogft.errors import SpecError
from fogft.model.choices import MigrationSpec, OnDemandSpec, ScheduleSpec
from fogft.model.middleware import Middleware
from fogft.model.scoring import Weights
from fogft.model.spec import HealthSpec, PoolSpec, ServiceSpec
from fogft.planning.availability import Assumption, Correlation
from fogft.poolfile import file
from fogft.poolfile import keys as spec_keys
from fogft.poolfile.keys import (
    FOGFT_KEYS,
    HEALTH_KEYS,
    LATER_KEYS,
    REFUSED_TASK_KEYS,
    SERVICE_KEYS,
    TASK_KEYS,
)
from fogft.poolfile.state import STATE_KEYS

PAGE = (Path(__file__).parents[2] / "docs" / "pool-file.md").read_text()
EXAMPLES = [part.split("```")[0] for part in PAGE.split("```yaml\n")[1:4]]
EXAMPLE = EXAMPLES[0]


def section(title):
    return PAGE.split(f"## {title}\n")[1].split("\n#")[0]


def rows(title):
    """Return the cells of a table's rows, by the first."""
    lines = [line for line in section(title).splitlines() if line.startswith("| `")]
    return {
        line.split("|")[1].strip(): [c.strip() for c in line.split("|")[2:-1]] for line in lines
    }


TABLES = {"Under `fogft`": FOGFT_KEYS, "Each of `services`": SERVICE_KEYS, "`health`": HEALTH_KEYS}
STATE_TABLE = "`state`"


MORE_TABLES = {
    "`fallback`": spec_keys.FALLBACK_KEYS,
    "`traffic`": spec_keys.TRAFFIC_KEYS,
    "`availability`": spec_keys.AVAILABILITY_KEYS,
    "`correlation`": spec_keys.CORRELATION_KEYS,
    "`placement`": spec_keys.PLACEMENT_KEYS,
    "`on_demand`": spec_keys.ON_DEMAND_KEYS,
    "Each of `groups`": spec_keys.GROUP_KEYS,
    "`schedule`": spec_keys.SCHEDULE_KEYS,
    "Each of `windows`": spec_keys.WINDOW_KEYS,
    "`migration`": spec_keys.MIGRATION_KEYS,
    "`rmw`": spec_keys.RMW_KEYS,
    "`topology`": spec_keys.TOPOLOGY_KEYS,
    "Each of `gateways`": spec_keys.GATEWAY_KEYS,
    "Each of `robots`": spec_keys.ROBOT_KEYS,
    "`metrics`": spec_keys.METRICS_KEYS,
}
TOPIC_TABLES = {
    "Each of `topics`": spec_keys.TOPIC_KEYS,
    "Each of `actions`": spec_keys.ACTION_KEYS,
}


@pytest.mark.parametrize("title", [*TABLES, *MORE_TABLES, *TOPIC_TABLES])
def test_every_key_has_its_row(title):
    keys = {**TABLES, **MORE_TABLES, **TOPIC_TABLES}[title]
    assert [key.strip("`") for key in rows(title)] == list(keys)


def test_every_state_key_has_its_row():
    assert [key.strip("`") for key in rows(STATE_TABLE)] == list(STATE_KEYS)


def test_every_task_key_has_its_row():
    named = re.findall(r"`(\w+)`", " ".join(rows("The rest: the task")))
    assert sorted(named) == sorted([*TASK_KEYS, *REFUSED_TASK_KEYS])


def test_planned_keys_are_listed():
    [listed] = re.findall(r"\n\n([^\n]*) are planned\.", section("`health`"))
    assert set(re.findall(r"`(\w+)`", listed)) == set(LATER_KEYS)


def test_defaults_are_the_codes():
    ours, services, health = (rows(title) for title in TABLES)
    defaults = {key: cells[1] for key, cells in {**services, **health, **ours}.items()}
    assert {key: value for key, value in defaults.items() if re.match(r"[0-9`]", value)} == {
        "`replicas`": str(PoolSpec.replicas),
        "`max_surge`": str(PoolSpec.max_surge),
        "`orphan_after_s`": f"{HealthSpec.orphan_after_s:g}",
        "`timeout_s`": f"{ServiceSpec.timeout_s:g}",
        "`on_timeout`": f"`{ServiceSpec.on_timeout.value}`",
        "`rmw`": f"`{Middleware().robot.value}`",
        "`hedging`": f"`{ServiceSpec.hedging.value}`",
        "`hedging_budget`": f"{ServiceSpec.hedging_budget:g}",
        "`trace`": f"`{str(ServiceSpec.trace).lower()}`",
        "`freshness`": f"`{ServiceSpec.freshness.value}`",
        "`compression`": f"`{ServiceSpec.compression.value}`",
        "`suspect_after_s`": f"{HealthSpec.suspect_after_s:g}",
        "`replace_after_s`": f"{HealthSpec.replace_after_s:g}",
        "`start_limit_s`": f"{HealthSpec.start_limit_s:g}",
    }


def test_defaults_of_the_plan_are_the_codes():
    usual = {
        "`availability`": Assumption(),
        "`correlation`": Correlation(),
        "`placement`": Weights(),
        "`on_demand`": OnDemandSpec(),
        "`schedule`": ScheduleSpec("UTC", ()),
        "`migration`": MigrationSpec(),
    }
    for title, values in usual.items():
        for key, cells in rows(title).items():
            name = key.strip("`").removesuffix("_weight")
            if hasattr(values, name) and re.match(r"[\d.]+$", cells[1]):
                assert float(cells[1]) == getattr(values, name), key


def plan_limits():
    for title in MORE_TABLES:
        for key, cells in rows(title).items():
            found = re.match(r"number (above|from) 0, at most ([\d.]+)", cells[0])
            if found:
                yield key.strip("`"), float(found[2]), found[1] == "above"


@pytest.mark.parametrize(("key", "high", "above"), list(plan_limits()))
def test_limits_of_the_plan_are_the_codes(key, high, above):
    """At a limit a value is accepted, beyond it not."""
    pattern = rf"\b{key}: [^,}}\n]+"
    assert re.search(pattern, EXAMPLES[1])
    level = re.search(r"\{zone: .*?\}", EXAMPLES[1])[0]
    if key in spec_keys.CORRELATION_KEYS:  # none may be above the one before
        top, low = "{zone: 1, region: 1, cloud: 1}", "{zone: 0, region: 0, cloud: 0}"
    else:
        top = low = level
    for value, others in ((f"{high:.5f}", top), ("0.00001" if above else "0", low)):
        changed = EXAMPLES[1].replace(level, others)
        file.parse(re.sub(pattern, f"{key}: {value}", changed), file="p.yaml")
    for value in (high * 1.001 + 1e-6, 0 if above else -1):
        with pytest.raises(SpecError, match=rf"{key}: must be"):
            file.parse(re.sub(pattern, f"{key}: {value:.8f}", EXAMPLES[1]), file="p.yaml")


def limits():
    for title in TABLES:
        for key, cells in rows(title).items():
            found = re.search(r"(\d+) to (\d+)|above (0), at most (\d+)", cells[0])
            if found:
                low, high = (int(text) for text in found.groups() if text)
                yield key.strip("`"), low, high, "above" in cells[0]


@pytest.mark.parametrize(("key", "low", "high", "above"), list(limits()))
def test_limits_are_the_codes(key, low, high, above):
    """At a limit a value is accepted, beyond it not."""
    example = EXAMPLE
    if key == "quorum":  # no more than can be asked
        example = EXAMPLE.replace("replicas: 3", "replicas: 16")
    elif key == "replicas":
        example = re.sub(r" +(quorum|tolerance): .*\n", "", EXAMPLE)

    def parse(value):
        assert re.search(rf"\b{key}: \S+", example)
        file.parse(re.sub(rf"\b{key}: \S+", f"{key}: {value}", example), file="p.yaml")

    parse(high)
    parse(low + 0.001 if above else low)
    for value in (high + 1, low if above else low - 1):
        with pytest.raises(SpecError, match=rf"{key}: must be"):
            parse(value)


def test_the_examples_are_complete_and_right():
    """They parse, and show every key of ours."""
    spec = file.parse(EXAMPLE, file="pool.yaml")
    assert spec.name == "perception"
    assert file.parse(EXAMPLES[1], file="pool.yaml").name == "picking"
    assert file.parse(EXAMPLES[2], file="pool.yaml").name == "watching"
    for key in (
        *FOGFT_KEYS,
        *SERVICE_KEYS,
        *HEALTH_KEYS,
        *sum({**MORE_TABLES, **TOPIC_TABLES}.values(), ()),
    ):
        assert re.search(rf"\b{key}:", "".join(EXAMPLES)), key


def test_the_mistake_is_told_as_printed():
    with pytest.raises(SpecError) as caught:
        file.parse(EXAMPLE.replace("replicas:", "replcas:"), file="pool.yaml")
    printed = section("Mistakes")
    assert re.sub(r":\d+:", ":14:", caught.value.message) in printed
    assert f"hint: {caught.value.hint}\n" in printed
