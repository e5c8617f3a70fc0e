"""docs/pool-file.md says what the code does: its keys, defaults, limits and example."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from fogft.core.errors import SpecError
from fogft.core.spec import HealthSpec, PoolSpec, ServiceSpec
from fogft.core.spec_keys import (
    FOGFT_KEYS,
    HEALTH_KEYS,
    LATER_KEYS,
    REFUSED_TASK_KEYS,
    SERVICE_KEYS,
    TASK_KEYS,
)
from fogft.pool import pool_file

PAGE = (Path(__file__).parents[2] / "docs" / "pool-file.md").read_text()
EXAMPLE = PAGE.split("```yaml\n")[1].split("```")[0]


def section(title):
    return PAGE.split(f"## {title}\n")[1].split("\n#")[0]


def rows(title):
    """Return the cells of a table's rows, by the first."""
    lines = [line for line in section(title).splitlines() if line.startswith("| `")]
    return {
        line.split("|")[1].strip(): [c.strip() for c in line.split("|")[2:-1]] for line in lines
    }


TABLES = {"Under `fogft`": FOGFT_KEYS, "Each of `services`": SERVICE_KEYS, "`health`": HEALTH_KEYS}


@pytest.mark.parametrize("title", TABLES)
def test_every_key_has_its_row(title):
    assert [key.strip("`") for key in rows(title)] == list(TABLES[title])


def test_every_task_key_has_its_row():
    named = re.findall(r"`(\w+)`", " ".join(rows("The rest: the task")))
    assert sorted(named) == sorted([*TASK_KEYS, *REFUSED_TASK_KEYS])


def test_planned_keys_are_listed():
    listed = section("`health`").split("`availability`")[1].split("are planned")[0]
    assert {"availability", *re.findall(r"`(\w+)`", listed)} == set(LATER_KEYS)


def test_defaults_are_the_codes():
    ours, services, health = (rows(title) for title in TABLES)
    defaults = {key: cells[1] for key, cells in {**ours, **services, **health}.items()}
    assert {key: value for key, value in defaults.items() if re.match(r"[0-9`]", value)} == {
        "`replicas`": str(PoolSpec.replicas),
        "`max_surge`": str(PoolSpec.max_surge),
        "`orphan_after_s`": f"{HealthSpec.orphan_after_s:g}",
        "`timeout_s`": f"{ServiceSpec.timeout_s:g}",
        "`on_timeout`": f"`{ServiceSpec.on_timeout.value}`",
        "`hedging`": f"`{ServiceSpec.hedging.value}`",
        "`hedging_budget`": f"{ServiceSpec.hedging_budget:g}",
        "`suspect_after_s`": f"{HealthSpec.suspect_after_s:g}",
        "`replace_after_s`": f"{HealthSpec.replace_after_s:g}",
        "`start_limit_s`": f"{HealthSpec.start_limit_s:g}",
    }


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

    def parse(value):
        assert re.search(rf"\b{key}: \S+", EXAMPLE)
        pool_file.parse(re.sub(rf"\b{key}: \S+", f"{key}: {value}", EXAMPLE), file="p.yaml")

    parse(high)
    parse(low + 0.001 if above else low)
    for value in (high + 1, low if above else low - 1):
        with pytest.raises(SpecError, match=rf"{key}: must be"):
            parse(value)


def test_the_example_is_complete_and_right():
    """It parses, and shows every key of ours."""
    spec = pool_file.parse(EXAMPLE, file="pool.yaml")
    assert spec.name == "perception"
    for key in (*FOGFT_KEYS, *SERVICE_KEYS, *HEALTH_KEYS):
        assert re.search(rf"\b{key}:", EXAMPLE), key


def test_the_mistake_is_told_as_printed():
    with pytest.raises(SpecError) as caught:
        pool_file.parse(EXAMPLE.replace("replicas:", "replcas:"), file="pool.yaml")
    printed = section("Mistakes")
    assert re.sub(r":\d+:", ":14:", caught.value.message) in printed
    assert f"hint: {caught.value.hint}\n" in printed
