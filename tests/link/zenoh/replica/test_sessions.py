"""Who may ask at a replica: those who greeted, while they are not revoked."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.link.frame import Greeting, greeted_bytes
from fogft.link.zenoh.replica.sessions import HOLDERS_LIMIT, TOKENS_LIMIT, Guests, NotAdmittedError
from fogft.model import names
from fogft.model.refusal import Refusal
from fogft.model.replica import ReplicaId
from tests.records.record_worlds import UID, signer, verify

SELF = ReplicaId(UID, 0, 1).certificate_name
ADA = names.robot_certificate_name(UID, "ada")
EVE = names.robot_certificate_name(UID, "eve")


def token(number: int) -> bytes:
    return number.to_bytes(8, "big")


def greeting(number: int, name: str = ADA, role: str = "robot", to: str = SELF) -> Greeting:
    certificate, signature = signer(role, name)(greeted_bytes(token(number), to))
    return Greeting(token(number), certificate, signature)


@pytest.fixture
def guests() -> Guests:
    return Guests(UID, SELF, verify)


def refusal(guests: Guests, said: Greeting) -> str:
    with pytest.raises(NotAdmittedError) as caught:
        guests.greet(said)
    return caught.value.refusal


def test_who_greeted_is_let_in_and_nobody_else(guests: Guests) -> None:
    assert refusal(guests, Greeting(token(1))) == Refusal.NOT_ADMITTED
    guests.greet(greeting(1))
    guests.greet(Greeting(token(1)))  # further probes bring the token only
    assert guests.admits(token(1))
    assert not guests.admits(token(2))


def test_a_gateway_may_ask_too(guests: Guests) -> None:
    guests.greet(greeting(1, names.gateway_certificate_name(UID, "edge"), "gateway"))
    assert guests.admits(token(1))


@pytest.mark.parametrize(
    "said",
    [
        greeting(1, ReplicaId(UID, 1, 1).certificate_name, "replica"),
        greeting(1, names.manager_certificate_name(UID), "manager"),
        greeting(1, names.rendezvous_certificate_name(UID, "a"), "rendezvous"),
        greeting(1, ADA, "replica"),
        greeting(1, ReplicaId(UID, 1, 1).certificate_name, "robot"),
        greeting(1, names.robot_certificate_name("f" * 16, "ada")),
        greeting(1, "ada"),
        greeting(1, to=ReplicaId(UID, 1, 1).certificate_name),
        Greeting(token(1), greeting(2).certificate, greeting(2).signature),
        Greeting(token(1), b"junk", b"junk"),
    ],
    ids=[
        "a stolen replica's key",
        "a manager's key",
        "a rendezvous's key",
        "a robot's name in a replica's certificate",
        "a replica's name in a robot's certificate",
        "another pool's robot",
        "a name that is none",
        "made out to another replica",
        "made out for another connection",
        "garbage",
    ],
)
def test_who_may_not_ask_is_not_let_in(guests: Guests, said: Greeting) -> None:
    assert refusal(guests, said) == Refusal.NOT_ADMITTED
    assert not guests.admits(token(1))


def test_the_revoked_are_let_in_no_more(guests: Guests) -> None:
    """Their open connections end with the others' untouched, and they cannot come back."""
    for number, name in ((1, EVE), (2, EVE), (3, ADA)):
        guests.greet(greeting(number, name))
    guests.revoke([EVE])
    guests.revoke([])  # nothing is ever taken back
    assert [guests.admits(token(n)) for n in (1, 2, 3)] == [False, False, True]
    assert refusal(guests, greeting(4, EVE)) == Refusal.REVOKED
    guests.greet(greeting(5, names.robot_certificate_name(UID, "eve", 2)))


def test_a_token_cannot_be_taken_over(guests: Guests) -> None:
    guests.greet(greeting(1, ADA))
    assert refusal(guests, greeting(1, EVE)) == Refusal.NOT_ADMITTED
    guests.revoke([EVE])
    assert guests.admits(token(1))


@given(st.integers(1, 3 * TOKENS_LIMIT))
def test_one_holder_cannot_push_out_another(count: int) -> None:
    """However often somebody greets, only its own oldest connections are forgotten."""
    guests = Guests(UID, SELF, verify)
    guests.greet(greeting(10_000, ADA))
    for number in range(count):
        guests.greet(greeting(number, EVE))
    assert guests.admits(token(10_000))
    assert sum(guests.admits(token(n)) for n in range(count)) == min(count, TOKENS_LIMIT)
    assert guests.admits(token(count - 1))


def test_what_is_remembered_is_bounded(guests: Guests) -> None:
    for number in range(HOLDERS_LIMIT + 5):
        guests.greet(greeting(number, names.robot_certificate_name(UID, f"r{number}")))
    assert len(guests.names) == HOLDERS_LIMIT
    assert not guests.admits(token(0))
