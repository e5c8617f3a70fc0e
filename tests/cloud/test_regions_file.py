"""`regions.yaml`: another local cloud than the built-in one."""

from __future__ import annotations

from pathlib import Path

import pytest

from fogft.cloud.local.catalogue import BUILT_IN, Instance, Zone, read
from fogft.errors import SpecError


@pytest.fixture
def write(tmp_path):
    def to(text: str):
        path = tmp_path / "regions.yaml"
        path.write_bytes(text.encode("utf-8", "surrogateescape"))
        return path

    return to


def test_without_a_file_or_with_an_empty_one_there_is_what_is_built_in(tmp_path, write):
    assert read(tmp_path / "none.yaml") == BUILT_IN
    assert read(write("# nothing yet\n")) == BUILT_IN


def test_regions_replace_the_built_in_ones_and_inherit_from_above(write):
    catalogue = read(
        write(
            "boot_s: 2\nrelay: false\n"
            "regions:\n"
            "  us-west-1: {zones: [a, b], notice_s: 9}\n"
            "  moon-1: {zones: {dark: {capacity: 1}, bright: {boot_s: 1}}, price_factor: 9}\n"
            "  plain: {}\n"
        )
    )
    base = {"boot_s": 2.0, "relay": False}
    assert catalogue.zones == (
        Zone("us-west-1", "a", notice_s=9.0, **base),
        Zone("us-west-1", "b", notice_s=9.0, **base),
        Zone("moon-1", "dark", capacity=1, price_factor=9.0, **base),
        Zone("moon-1", "bright", price_factor=9.0, **{**base, "boot_s": 1.0}),
        Zone("plain", "a", **base),
    )
    assert catalogue.instances == BUILT_IN.instances


def test_settings_alone_apply_to_the_built_in_regions(write):
    catalogue = read(write("boot_s: 9\n"))
    assert {zone.boot_s for zone in catalogue.zones} == {9.0}
    assert [zone.location for zone in catalogue.zones] == [z.location for z in BUILT_IN.zones]


def test_instances_replace_the_built_in_ones(write):
    text = "instances:\n  gpu: {cpus: 8, memory_gb: 32, usd_per_hour: 0.9, accelerators: {L4: 2}}\n"
    assert read(write(text)).instances == (
        Instance("gpu", 8, 32, 0.9, pytest.approx(0.3), {"L4": 2.0}),
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("region: {}", "1: region: unknown key"),
        ("boot_s: soon", "1: boot_s: must be a number, not the text `soon`"),
        ("relay: maybe", "1: relay: must be true or false, not the text `maybe`"),
        ("\ncapacity: -1", "2: capacity: must be from 0 to 10000, not `-1`"),
        ("regions: {}", "1: regions: is empty"),
        ("regions:\n  Moon: {}", "2: regions.Moon: `Moon` is not the name of a region"),
        ("regions:\n  moon: {zones: [A]}", "2: regions.moon.zones: `A` is not the name of a zone"),
        ("regions:\n  moon: {zones: [1]}", "2: regions.moon.zones: `1` is not the name of a zone"),
        ("regions:\n  moon:\n    zone: [a]", "3: regions.moon.zone: unknown key"),
        ("instances:\n  x: {cpus: none}", "2: instances.x.cpus: must be a whole number"),
        ("instances:\n  x: {usd: 1}", "2: instances.x.usd: unknown key"),
        ("a: [", "1: not YAML"),
        ("a: &x [*x]", "1: "),
        ("just text", "1: "),
    ],
)
def test_a_mistake_is_told_with_file_line_and_key(write, text, message):
    path = write(text)
    with pytest.raises(SpecError) as error:
        read(path)
    assert error.value.message.startswith(f"{path}:{message}"), error.value.message


def test_the_example_of_the_documentation_is_right(write):
    page = (Path(__file__).parents[2] / "docs/design/local-cloud.md").read_text()
    catalogue = read(write(page.split("```yaml\n")[1].split("```")[0]))
    assert {zone.region for zone in catalogue.zones} == {"moon-1", "us-west-1"}
    assert [instance.name for instance in catalogue.instances] == ["cpu4", "gpu"]


def test_bytes_that_are_no_text_are_told(write):
    with pytest.raises(SpecError, match="cannot be read"):
        read(write("a: \udcff"))


def test_machines_are_listed_and_ended_though_the_file_is_broken(local):
    """A mistake in the catalogue hides nothing that runs."""
    id = local.running().id
    (local.root / "regions.yaml").write_text("{")
    assert [m.id for m in local.cloud.machines(local.uid)] == [id]
    local.cloud.terminate(id)
    assert local.machine(id) is None
