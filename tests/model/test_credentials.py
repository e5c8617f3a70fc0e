"""The holder that a certificate names."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.model.credentials import NAME_PATTERN, Holder, Role, holder_of
from fogft.model.replica import ReplicaId
from tests.records import certificate_names

UID, OTHER = "0123456789abcdef", "f" * 16
uids = st.sampled_from([UID, OTHER])
generations = st.integers(1, 999_999)
holders = st.one_of(
    st.builds(
        Holder,
        st.sampled_from(sorted(set(Role) - {Role.REPLICA})),
        st.from_regex(NAME_PATTERN, fullmatch=True),
        generations,
        uids,
    ),
    st.builds(Holder, st.just(Role.REPLICA), st.integers(0, 99).map(str), st.integers(1, 5), uids),
)


@given(holders)
def test_a_name_is_read_back_and_fits_a_certificate(holder: Holder) -> None:
    """Reading a common name gives its holder, and X.520's 64 characters hold every one."""
    assert holder_of(holder.common_name) == holder
    assert len(holder.common_name) <= 64


@given(st.text(max_size=70) | st.from_regex(r"(robot|replica)\..*"))
def test_any_text_is_a_holder_or_a_value_error(text: str) -> None:
    """And what is read is written back as the same text: no two texts name one holder."""
    with contextlib.suppress(ValueError):
        assert holder_of(text).common_name == text


def test_the_names_that_both_ends_derive_are_holders() -> None:
    assert holder_of(ReplicaId(UID, 3, 7).certificate_name).short == "3.7"
    assert holder_of(certificate_names.robot(UID, "ada", 2)).short == "ada.2"
    assert holder_of(certificate_names.gateway(UID, "edge")).role is Role.GATEWAY
    assert holder_of(certificate_names.rendezvous(UID, "port")).role is Role.RENDEZVOUS
    assert holder_of(certificate_names.manager(UID)).role is Role.MANAGER


@pytest.mark.parametrize(
    "text",
    [
        "",
        "robot.ada.1",
        f"robot.ada.0.{UID}",
        f"robot.ada.01.{UID}",
        f"robot..1.{UID}",
        f"robot.a.b.1.{UID}",
        f"robot.ada.1.{UID.upper()}",
        f"replica.x.1.{UID}",
        f"replica.00.1.{UID}",
        f"root.ada.1.{UID}",
        f"robot.{'x' * 29}.1.{UID}",
        f"robot.ada.1.{UID}\n",
    ],
)
def test_what_is_no_name_of_ours_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="not the name of a holder"):
        holder_of(text)
