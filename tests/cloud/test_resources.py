"""Offers of the local cloud: what a task's `resources` may say, and what is told of mistakes."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.cloud.local.catalogue import BUILT_IN, Catalogue, Instance, Zone
from fogft.cloud.local.resources import offers_for
from fogft.errors import SpecError
from fogft.poolfile.task import check_resources
from fogft.poolfile.tree import Section, tree

SMALL = Instance("small", 2, 8, 0.2, 0.1)
LARGE = Instance("large", 8, 64, 0.8, 0.3)
GPU = Instance("gpu", 8, 32, 2.0, 0.9, {"L4": 1})
CATALOGUE = Catalogue(
    zones=(
        Zone("us-west-1", "a"),
        Zone("us-west-1", "b", price_factor=2.0),
        Zone("us-west-2", "a", price_factor=1.5),
    ),
    instances=(SMALL, LARGE, GPU),
)


def found(resources: dict) -> list[tuple[str, str, bool, float]]:
    return [
        (
            o.placement.location.removeprefix("local/"),
            o.placement.instance,
            o.placement.spot,
            o.usd_per_hour,
        )
        for o in offers_for(CATALOGUE, resources)
    ]


def places(resources: dict) -> list[str]:
    return sorted(place for place, *_ in found(resources))


def test_without_resources_every_zone_offers_its_cheapest_machine_on_demand():
    assert found({}) == [
        ("us-west-1/a", "small", False, 0.2),
        ("us-west-2/a", "small", False, 0.3),
        ("us-west-1/b", "small", False, 0.4),
    ]


def test_spot_has_its_own_price():
    assert found({"use_spot": True})[0] == ("us-west-1/a", "small", True, 0.1)


@pytest.mark.parametrize(
    "resources",
    [
        {"infra": "local/us-west-1"},
        {"infra": "aws/us-west-1"},
        {"infra": "AWS/us-west-1"},
        {"infra": "*/us-west-1"},
        {"infra": "aws/us-west-1/*"},
        {"cloud": "aws", "region": "us-west-1"},
        {"region": "us-west-1"},
    ],
)
def test_a_region_can_be_named_in_every_way_that_skypilot_knows(resources):
    """A pool that was written for another cloud runs here as it is."""
    assert places(resources) == ["us-west-1/a", "us-west-1/b"]


@pytest.mark.parametrize(
    "infra", ["local/us-west-1/b", "aws/us-west-1/us-west-1b", "gcp/us-west-1/us-west-1-b"]
)
def test_a_zone_can_be_named_as_other_clouds_do(infra):
    assert places({"infra": infra}) == ["us-west-1/b"]


@pytest.mark.parametrize("infra", ["local", "aws", "*", "*/*/a"])
def test_a_cloud_alone_means_all_of_it(infra):
    assert set(places({"infra": infra})) >= {"us-west-1/a", "us-west-2/a"}


@pytest.mark.parametrize("key", ["any_of", "ordered"])
def test_alternatives_add_up_on_what_they_share(key):
    resources = {
        "use_spot": True,
        key: [{"infra": "local/us-west-2"}, {"infra": "local/us-west-1/a", "use_spot": False}],
    }
    assert found(resources) == [
        ("us-west-2/a", "small", True, 0.15),
        ("us-west-1/a", "small", False, 0.2),
    ]


@pytest.mark.parametrize(
    ("resources", "instance"),
    [
        ({"cpus": "4+"}, "large"),
        ({"cpus": 2}, "small"),
        ({"cpus": "2"}, "small"),
        ({"cpus": 1.0, "any_of": [{"cpus": 8}]}, "large"),
        ({"memory": "16+"}, "large"),
        ({"memory": 32}, "gpu"),
        ({"memory": "8x"}, "large"),
        ({"memory": "16GB+"}, "large"),
        ({"memory": "32Gi"}, "gpu"),
        ({"instance_type": "gpu"}, "gpu"),
        ({"accelerators": "L4"}, "gpu"),
        ({"accelerators": "L4:1"}, "gpu"),
        ({"accelerators": {"L4": 1}}, "gpu"),
        ({"accelerators": ["A100:8", "L4:1"]}, "gpu"),
    ],
)
def test_the_cheapest_machine_that_suffices_is_offered(resources, instance):
    assert {name for _, name, *_ in found(resources)} == {instance}


def test_what_is_nothing_to_this_cloud_is_accepted():
    assert found({"disk_size": 100, "labels": {"a": "b"}, "ports": 80, "_internal": 1}) == found({})


@pytest.mark.parametrize(
    ("resources", "message", "hint"),
    [
        (
            {"infra": "local/us-wst-1"},
            "resources.infra: the local cloud has no region `us-wst-1`",
            "us-west-1",
        ),
        ({"infra": "lcoal/us-west-1"}, "resources.infra: there is no cloud `lcoal`", "local"),
        (
            {"infra": "local/us-west-1/c"},
            "resources.infra: region `us-west-1` has no zone `c`",
            "",
        ),
        ({"infra": "local//a"}, "resources.infra: `local//a` is not `cloud/region/zone`", "local"),
        (
            {"any_of": [{"region": "us-west-1"}, {"region": "us-east-9"}]},
            "resources.any_of[1].region: the local cloud has no region `us-east-9`",
            "us-west",
        ),
        (
            {"cpus": "64+"},
            "resources.cpus: the local cloud has no machine with `64+`",
            "`small (2)`, `large (8)`, `gpu (8)`",
        ),
        ({"cpus": "many"}, "resources.cpus: `many` is not an amount", "`cpus: 8+`"),
        ({"cpus": True}, "resources.cpus: `True` is not an amount", "`cpus: 8+`"),
        ({"cpus": -1}, "resources.cpus: `-1` is not an amount", "`cpus: 8+`"),
        (
            {"accelerators": "H100:8"},
            "resources.accelerators: the local cloud has no machine with `H100:8`",
            "gpu (L4:1)",
        ),
        (
            {"instance_type": "c5.large"},
            "resources.instance_type: the local cloud has no `c5.large`",
            "cpus: 4+",
        ),
    ],
)
def test_what_can_never_be_met_is_told_with_its_key(resources, message, hint):
    with pytest.raises(SpecError) as error:
        offers_for(CATALOGUE, resources)
    assert error.value.message == message
    assert hint in error.value.hint


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=6,
)
KEYS = (
    *("infra", "cloud", "region", "zone", "cpus", "memory", "accelerators"),
    *("instance_type", "use_spot", "any_of", "ordered", "odd"),
)


@given(st.dictionaries(st.sampled_from(KEYS), json_values, max_size=4))
def test_whatever_a_file_says_there_are_offers_or_one_error(resources):
    """No input makes the cloud break: it is met, or it is the file's mistake."""
    try:
        check_resources(Section("p.yaml", "resources", tree(resources)))
        found = offers_for(BUILT_IN, resources)
    except SpecError as error:
        message = error.message.removeprefix("p.yaml:1: ")
    else:
        assert found
        assert found == sorted(found, key=lambda o: (o.usd_per_hour, o.placement))
        return
    assert message.startswith("resources")
    assert "\n" not in message


def test_the_built_in_regions_are_those_of_the_documentation():
    assert {zone.region for zone in BUILT_IN.zones} >= {
        *("us-west-1", "us-west-2", "us-east-1", "eu-central-1", "ap-northeast-1")
    }
    spot = {o.placement.location: o.usd_per_hour for o in offers_for(BUILT_IN, {"use_spot": True})}
    on_demand = {o.placement.location: o.usd_per_hour for o in offers_for(BUILT_IN, {})}
    assert len(spot) == 10
    assert all(spot[place] < price for place, price in on_demand.items())
