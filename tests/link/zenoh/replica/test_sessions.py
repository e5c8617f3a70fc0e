"""Who may ask at a replica: those who greeted, while they are not revoked."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.link.frame import Greeting, greeted_bytes
from fogft.link.zenoh.replica.sessions import (
    HOLDERS_LIMIT,
    TOKENS_LIMIT,
    TOKENS_WITHIN_S,
    AuthenticatedSessions,
    NotAdmittedError,
)
from fogft.model.credentials import holder_of
from fogft.model.refusal import Refusal
from fogft.model.replica import ReplicaId
from tests.records import certificate_names
from tests.records.record_worlds import UID, signer, verify

SELF = ReplicaId(UID, 0, 1).certificate_name
ADA = certificate_names.robot(UID, "ada")
EVE = certificate_names.robot(UID, "eve")


def token(number: int) -> bytes:
    return number.to_bytes(8, "big")


def greeting(number: int, name: str = ADA, role: str = "robot", to: str = SELF) -> Greeting:
    certificate, signature = signer(role, name)(greeted_bytes(token(number), to))
    return Greeting(token(number), certificate, signature)


@pytest.fixture
def sessions() -> AuthenticatedSessions:
    return AuthenticatedSessions(UID, SELF, verify)


def refusal(sessions: AuthenticatedSessions, said: Greeting) -> str:
    with pytest.raises(NotAdmittedError) as caught:
        sessions.greet(said)
    return caught.value.refusal


def test_who_greeted_is_let_in_and_nobody_else(sessions: AuthenticatedSessions) -> None:
    assert refusal(sessions, Greeting(token(1))) == Refusal.NOT_ADMITTED
    sessions.greet(greeting(1))
    sessions.greet(Greeting(token(1)))  # further probes bring the token only
    assert sessions.of(token(1))
    assert not sessions.of(token(2))


def test_a_gateway_may_ask_too(sessions: AuthenticatedSessions) -> None:
    sessions.greet(greeting(1, certificate_names.gateway(UID, "edge"), "gateway"))
    assert sessions.of(token(1))


@pytest.mark.parametrize(
    "said",
    [
        greeting(1, ReplicaId(UID, 1, 1).certificate_name, "replica"),
        greeting(1, certificate_names.manager(UID), "manager"),
        greeting(1, certificate_names.rendezvous(UID, "a"), "rendezvous"),
        greeting(1, ADA, "replica"),
        greeting(1, ReplicaId(UID, 1, 1).certificate_name, "robot"),
        greeting(1, certificate_names.robot("f" * 16, "ada")),
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
def test_who_may_not_ask_is_not_let_in(sessions: AuthenticatedSessions, said: Greeting) -> None:
    assert refusal(sessions, said) == Refusal.NOT_ADMITTED
    assert not sessions.of(token(1))


def test_the_revoked_are_let_in_no_more(sessions: AuthenticatedSessions) -> None:
    """Their open connections end with the others' untouched, and they cannot come back."""
    for number, name in ((1, EVE), (2, EVE), (3, ADA)):
        sessions.greet(greeting(number, name))
    sessions.revoke([EVE])
    sessions.revoke([])  # nothing is ever taken back
    assert [bool(sessions.of(token(n))) for n in (1, 2, 3)] == [False, False, True]
    assert refusal(sessions, greeting(4, EVE)) == Refusal.REVOKED
    sessions.greet(greeting(5, certificate_names.robot(UID, "eve", 2)))


def test_a_token_cannot_be_taken_over(sessions: AuthenticatedSessions) -> None:
    sessions.greet(greeting(1, ADA))
    assert refusal(sessions, greeting(1, EVE)) == Refusal.NOT_ADMITTED
    sessions.revoke([EVE])
    assert sessions.of(token(1))


@given(st.integers(1, 3 * TOKENS_LIMIT))
def test_one_holder_cannot_push_out_another(count: int) -> None:
    """However often somebody greets, only its own oldest connections are forgotten."""
    times = itertools.count(0.0, TOKENS_WITHIN_S)
    sessions = AuthenticatedSessions(UID, SELF, verify, clock=lambda: next(times))
    sessions.greet(greeting(10_000, ADA))
    for number in range(count):
        sessions.greet(greeting(number, EVE))
    assert sessions.of(token(10_000))
    assert sum(bool(sessions.of(token(n))) for n in range(count)) == min(count, TOKENS_LIMIT)
    assert sessions.of(token(count - 1))


def test_who_greets_too_often_is_refused_and_keeps_what_he_has() -> None:
    now = 0.0
    sessions = AuthenticatedSessions(UID, SELF, verify, clock=lambda: now)
    for number in range(TOKENS_LIMIT):
        sessions.greet(greeting(number, EVE))
    assert refusal(sessions, greeting(TOKENS_LIMIT, EVE)) == Refusal.OVERLOADED
    assert all(sessions.of(token(number)) for number in range(TOKENS_LIMIT))
    sessions.greet(greeting(10_000, ADA))
    now = TOKENS_WITHIN_S
    sessions.greet(greeting(TOKENS_LIMIT, EVE))
    assert not sessions.of(token(0))


def test_a_robot_and_a_gateway_are_known_by_the_tokens_of_their_connections(
    sessions: AuthenticatedSessions,
) -> None:
    sessions.greet(greeting(1, ADA))
    sessions.greet(greeting(2, edge := certificate_names.gateway(UID, "edge"), "gateway"))
    assert [sessions.of(token(number)) for number in (1, 2, 3)] == [
        *map(holder_of, (ADA, edge)),
        None,
    ]


def test_what_is_remembered_is_bounded(sessions: AuthenticatedSessions) -> None:
    for number in range(HOLDERS_LIMIT + 5):
        sessions.greet(greeting(number, certificate_names.robot(UID, f"r{number}")))
    admitted = [sessions.of(token(number)) is not None for number in range(HOLDERS_LIMIT + 5)]
    assert sum(admitted) == HOLDERS_LIMIT
    assert not sessions.of(token(0))
