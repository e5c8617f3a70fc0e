"""Publishers and subscriptions of our node, with serialised messages."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fogft.errors import RosError, Unreadable
from fogft.model.topic import Origin, TopicSpec
from fogft.ros import topic_ends

from .conftest import wait_for

pytestmark = pytest.mark.ros
STRING = "std_msgs/msg/String"
SAID = TopicSpec("/said", STRING, Origin.ROBOT)
EASY = replace(SAID, reliable=False)
HELLO = b"\0\1\0\0\6\0\0\0hello\0"


def test_bytes_go_out_and_come_in(make_node, ros_domain):
    """Also to who subscribes later, where the topic is latched."""
    heard: list[bytes] = []
    latched = replace(SAID, depth=1, latched=True)
    publisher = make_node(ros_domain).publisher(latched)
    publisher.publish(HELLO)
    make_node(ros_domain).subscribe(latched, heard.append)
    wait_for(lambda: heard, "the message")
    assert heard[0][: len(HELLO)] == HELLO
    assert publisher.subscribers() == 1


def test_what_is_no_message_is_found_before_it_is_published(make_node, ros_domain):
    publisher = make_node(ros_domain).publisher(SAID)
    for noise in (b"", b"\0\1", b"\0\1\0\0\xff\xff\xff\xffx"):
        with pytest.raises(Unreadable):
            publisher.check(noise)


def test_a_publisher_that_offers_less_is_told_of_with_the_remedy(make_node, ros_domain):
    make_node(ros_domain).publisher(EASY)
    other = make_node(ros_domain)
    heard = other.subscribe(SAID, lambda _: None)
    wait_for(heard.mismatch, "the publisher")
    assert "`reliable: false`" in heard.mismatch()
    latched = other.subscribe(replace(EASY, latched=True), print)
    wait_for(latched.mismatch, "the publisher")
    assert "`latched: false`" in latched.mismatch()
    fine = other.subscribe(EASY, lambda _: None)
    assert fine.mismatch() == ""


def test_a_subscriber_that_asks_for_more_is_told_of_with_the_remedy(make_node, ros_domain):
    """As a node that wants a map, where the pool file does not say that it is latched."""
    node, other = make_node(ros_domain), make_node(ros_domain)
    plain, easy, fine = map(node.publisher, (SAID, EASY, replace(SAID, latched=True)))
    other.subscribe(replace(SAID, latched=True), print)
    wait_for(plain.mismatch, "the subscriber")
    assert "`latched: true`" in plain.mismatch()
    assert "`reliable: true`" in easy.mismatch()
    assert fine.mismatch() == ""
    other.subscribe(SAID, print)  # as beside a tool that asks for more than others
    wait_for(lambda: not plain.mismatch(), "a subscriber that receives messages")


@pytest.mark.parametrize("asks", ["deadline", "liveliness_lease_duration"])
def test_a_subscriber_that_asks_for_a_time_limit_is_told_of(
    make_node, ros_domain, monkeypatch, asks
):
    from rclpy.duration import Duration

    def strict(topic):
        quality = usual(topic)
        setattr(quality, asks, Duration(seconds=2))
        return quality

    publisher = make_node(ros_domain).publisher(SAID)
    usual = topic_ends.profile
    monkeypatch.setattr(topic_ends, "profile", strict)
    make_node(ros_domain).subscribe(SAID, print)
    wait_for(publisher.mismatch, "the subscriber")
    assert "asks for a deadline or liveliness" in publisher.mismatch()


def test_a_publisher_of_another_type_is_told_of(make_node, ros_domain):
    make_node(ros_domain).publisher(replace(SAID, type="std_msgs/msg/Int32"))
    heard = make_node(ros_domain).subscribe(SAID, lambda _: None)
    wait_for(heard.mismatch, "the publisher")
    assert heard.mismatch() == f"a publisher of `{SAID.name}` has type `std_msgs/msg/Int32`"


def test_withdrawn_ends_do_nothing_more(make_node, ros_domain):
    heard: list[bytes] = []
    node = make_node(ros_domain)
    publisher = node.publisher(SAID)
    subscription = make_node(ros_domain).subscribe(SAID, heard.append)
    wait_for(publisher.subscribers, "discovery")
    subscription.close()
    wait_for(lambda: not publisher.subscribers(), "its end")
    publisher.publish(HELLO)
    publisher.close()
    publisher.publish(HELLO)
    publisher.close()
    assert (publisher.subscribers(), subscription.mismatch(), heard) == (0, "", [])


def test_an_unknown_type_is_a_clear_error_and_the_node_lives_on(make_node, ros_domain):
    node = make_node(ros_domain)
    with pytest.raises(RosError, match="no package `nope_msgs` with messages"):
        node.publisher(replace(SAID, type="nope_msgs/msg/T"))
    with pytest.raises(RosError, match="not the name of a message type"):
        node.subscribe(replace(SAID, type="std_srvs/srv/SetBool"), print)
    assert node.alive
