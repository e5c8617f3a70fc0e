"""docs/reference/pool-file.md is what the code does: reference, examples, printed mistake."""

from __future__ import annotations

import re

import pytest

from fogft.errors import SpecError
from fogft.model.keys import keys_of
from fogft.model.spec import PoolSpec, ServiceSpec
from fogft.poolfile import file
from fogft.poolfile.task import REFUSED_TASK_KEYS, TASK_KEYS
from tests.docs.documents import ROOT

PAGE = (ROOT / "docs" / "reference" / "pool-file.md").read_text()
EXAMPLES = [part.split("```")[0] for part in PAGE.split("```yaml\n")[1:6]]


def section(title):
    return PAGE.split(f"## {title}\n")[1].split("\n#")[0]


def test_the_keys_that_people_need_are_keys():
    named = re.findall(r"`(?:services\[\]\.)?(\w+)`", section("The keys that most pools need"))
    keys = {entry.name for cls in (PoolSpec, ServiceSpec) for entry in keys_of(cls)}
    assert {"services", "replicas"} & keys
    assert set(named) - keys <= {"auto", "silent"}


def test_every_task_key_has_its_row():
    rows = [
        r for r in section("The rest of the file: the task").splitlines() if r.startswith("| `")
    ]
    named = re.findall(r"`(\w+)`", " ".join(row.split("|")[1] for row in rows))
    assert sorted(named) == sorted([*TASK_KEYS, *REFUSED_TASK_KEYS])


@pytest.mark.parametrize(
    ("number", "name"), enumerate(["perception", "picking", "watching", "arm", "natted"])
)
def test_the_examples_are_right(number, name):
    assert file.parse(EXAMPLES[number], file="pool.yaml").name == name


def test_the_examples_show_every_key():
    keys = [entry.name for cls in (PoolSpec, ServiceSpec) for entry in keys_of(cls)]
    shown = [key for key in keys if re.search(rf"\b{key}:", "".join(EXAMPLES))]
    assert shown == keys


def test_the_mistake_is_told_as_printed():
    with pytest.raises(SpecError) as caught:
        file.parse(EXAMPLES[0].replace("replicas:", "replcas:"), file="pool.yaml")
    printed = section("Mistakes")
    assert re.sub(r":\d+:", ":14:", caught.value.message) in printed
    assert f"hint: {caught.value.hint}\n" in printed
