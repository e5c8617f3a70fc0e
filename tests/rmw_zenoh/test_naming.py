"""What is read of `rmw_zenoh`'s names is what was written into them, and noise is nothing."""

from __future__ import annotations

import struct

from hypothesis import example, given
from hypothesis import strategies as st

from fogft.rmw_zenoh import naming
from fogft.rmw_zenoh.naming import CLIENT, NO_HASH, NODE, SERVER, Token, read_token

words = st.from_regex(r"[a-z][a-z0-9_]{0,8}", fullmatch=True)
names = st.lists(words, min_size=1, max_size=3).map(lambda parts: "/" + "/".join(parts))
hashes = st.one_of(st.just(NO_HASH), st.from_regex(r"RIHS01_[0-9a-f]{64}", fullmatch=True))
gids = st.binary(min_size=16, max_size=16)
services = st.builds(
    Token,
    domain=st.integers(0, 232),
    session=st.from_regex(r"[0-9a-f]{32}", fullmatch=True),
    node_id=st.just("0"),
    id=st.integers(1, 99).map(str),
    kind=st.sampled_from([SERVER, CLIENT]),
    node=words,
    namespace=st.one_of(st.just("/"), names),
    service=names,
    type=st.builds("{}/srv/{}".format, words, words.map(str.title)),
    hash=hashes,
)


@given(services)
def test_a_token_says_what_was_written_into_it(token: Token) -> None:
    assert read_token(str(token)) == token


def test_a_node_has_a_token_too() -> None:
    node = Token(7, "ab", "0", "0", NODE, "fogft_p")
    assert str(node) == "@ros2_lv/7/ab/0/0/NN/%/%/fogft_p"
    assert read_token(str(node)) == node


def test_a_token_looks_as_the_middleware_s_own_do() -> None:
    """The form that the design document of rmw_zenoh gives as an example, for a service."""
    token = Token(2, "ab", "0", "10", SERVER, "node", "/", "/add", "pkg/srv/Add", "RIHS01_0")
    assert str(token) == (
        "@ros2_lv/2/ab/0/10/SS/%/%/node/%add/pkg::srv::dds_::Add_/RIHS01_0/::2,:,:,:,,"
    )


@example("@ros2_lv/²/session/0/0/NN/%/%/node")  # a digit, and no number
@given(st.one_of(st.text(), st.lists(st.text(max_size=5), max_size=15).map("/".join)))
def test_no_text_breaks_the_reader(text: str) -> None:
    """What is no token is None, whatever it is; a prefix that fits changes nothing."""
    for candidate in (text, f"{naming.ROOT}/{text}", f"{naming.ROOT}/1/a/0/0/SS/{text}"):
        token = read_token(candidate)
        assert token is None or token.kind in (NODE, SERVER, CLIENT)


@given(services)
def test_two_entities_have_two_identifiers(token: Token) -> None:
    assert len(token.gid) == 16
    assert token.gid != token._replace(domain=token.domain + 1).gid


def test_a_service_has_one_key() -> None:
    key = naming.service_key(3, "/arm/grasp", "my_msgs/srv/Grasp", "RIHS01_ab")
    assert key == "3/arm/grasp/my_msgs::srv::dds_::Grasp_/RIHS01_ab"


@given(st.integers(0, 2**63 - 1), st.integers(0, 2**63 - 1), gids, st.booleans())
def test_a_response_carries_the_request_s_number_and_client(
    number: int, now: int, gid: bytes, prefixed: bool
) -> None:
    """In both forms there are: with the length of the GID before it, and without."""
    request = naming.request_attachment(number, 1, gid)
    if not prefixed:
        request = request[:16] + request[17:]
    response = naming.response_attachment(request, now)
    assert len(response) == len(request)
    assert struct.unpack_from("<qq", response) == (number, now)
    assert response[16:] == request[16:]
    assert response.endswith(gid)


@given(st.binary(max_size=80).filter(lambda raw: len(raw) not in (32, 33)))
def test_an_attachment_of_another_form_goes_back_as_it_came(raw: bytes) -> None:
    assert naming.response_attachment(raw, 5) == raw


def test_hashes_of_one_kind_are_compared_and_others_are_not() -> None:
    assert naming.may_be_same("RIHS01_a", "RIHS01_a")
    assert not naming.may_be_same("RIHS01_a", "RIHS01_b")
    assert naming.may_be_same("RIHS01_a", NO_HASH)
    assert naming.may_be_same("RIHS01_a", "RIHS02_b")
