"""A topic's configuration."""

from __future__ import annotations

import pytest

from fogft.model.plain import from_plain, to_plain
from fogft.model.topic import Origin, Select, TopicSpec


@pytest.mark.parametrize("select", Select)
def test_a_configuration_says_all_of_a_topic(select):
    topic = TopicSpec("/a", "p/msg/T", Origin.REPLICAS, select, 3, reliable=False, latched=True)
    assert from_plain(TopicSpec, to_plain(topic)) == topic
    assert to_plain(TopicSpec("/a", "p/msg/T", Origin.ROBOT), omit_defaults=True) == {
        "name": "/a", "type": "p/msg/T", "from": "robot",
    }  # fmt: skip
    with pytest.raises(ValueError, match=r"depth: 0\.5 is not of type `int`"):
        from_plain(TopicSpec, {**to_plain(topic), "depth": 0.5})
