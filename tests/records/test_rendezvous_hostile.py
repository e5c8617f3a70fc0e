"""Whatever is sent to a rendezvous by whomever: it lives, nothing changes, it is counted."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import socket
import ssl
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.model import plain
from fogft.model.credentials import CredentialPaths
from fogft.model.replica import Membership
from fogft.pool.credentials.authority import Role
from fogft.records import frames
from fogft.records.dialling import connect
from fogft.records.record import (
    Record,
    RecordError,
    RecordKind,
    SignedRecord,
    sign_record,
    to_plain,
)
from fogft.records.roster import SlotState, admission_content
from fogft.records.server import PURPOSE, binding_of
from fogft.records.signing import Signer
from tests.link.wire_pool import POOL_UID, Authority, wait_for
from tests.records import certificate_names, fuzz_records
from tests.records.rendezvous_pool import Party, Rendezvous, manager_files


class Scene:
    """A rendezvous that knows one admission, and somebody hostile."""

    def __init__(self, authority: Authority) -> None:
        self.authority = authority
        self.place = Rendezvous(authority, "a")
        self.manager = Party(manager_files(authority), self.place.endpoint)
        self.manager.admit(5, (0, 2))
        wait_for(lambda: self.place.count("offered", "accepted") == 1)
        self.host, port = self.place.endpoint.split(":")
        self.port = int(port)

    def raw(self) -> socket.socket:
        return socket.create_connection((self.host, self.port), 10.0)

    def tls(self) -> ssl.SSLSocket:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname = False
        context.load_verify_locations(self.authority.folder / "ca.crt")
        link = context.wrap_socket(self.raw())
        link.settimeout(10.0)
        return link

    def greeted(self, files: CredentialPaths, *, purpose: str = PURPOSE) -> ssl.SSLSocket:
        """Return a connection on which this one has said who it is."""
        link, greeting = self.greeting(files, purpose)
        link.sendall(greeting)
        return link

    def greeting(
        self, files: CredentialPaths, purpose: str = PURPOSE
    ) -> tuple[ssl.SSLSocket, bytes]:
        """Return a connection, and what is to be said there first."""
        link = self.tls()
        nonce, _ = frames.read_challenge(next(iter(frames.Unframer().feed(link.recv(4096)))))
        binding = binding_of(link.getpeercert(binary_form=True))
        proof = Signer(files.certificate, files.key)(frames.proof_bytes(purpose, nonce, binding))
        return link, frames.greeting(*proof)

    def unchanged(self) -> bool:
        """Whether it lives, knows what it knew, and still serves newcomers."""
        newcomer = Party(self.authority.robot("newcomer"), self.place.endpoint)
        try:
            wait_for(newcomer.membership)
            only = newcomer.orders() == {("admission", ""): (1, 5)}
            return only and self.place.alive() and self.place.status()["records"] == 1
        finally:
            newcomer.client.close()

    @contextlib.contextmanager
    def counts(self, section: str, event: str, times: int = 1) -> Iterator[None]:
        """See that what is done here is counted so often more."""
        wanted = self.place.count(section, event) + times
        yield
        wait_for(lambda: self.place.count(section, event) >= wanted)

    def close(self) -> None:
        self.manager.client.close()
        self.place.kill()


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    """Shared: no test may change what the rendezvous knows, and each says so."""
    made = Scene(Authority(tmp_path_factory.mktemp("pki")))
    yield made
    made.close()


def closed(link: socket.socket) -> bool:
    """Whether the other end hangs up; what it says before is read away."""
    try:
        while link.recv(65536):
            pass
    except ConnectionError:
        pass
    except ssl.SSLError:
        pass
    return True


def test_random_bytes_before_and_after_tls(scene):
    """Noise of many lengths, half-open connections, and noise where a greeting is awaited."""
    noise = random.Random(1)
    with scene.counts("port", "tls_failed", 5):
        for length in [0, 1, 5, 100, 5000, 100_000]:
            with scene.raw() as link, contextlib.suppress(OSError):
                link.sendall(noise.randbytes(length))
                link.shutdown(socket.SHUT_WR)
                assert closed(link)
    silent = [scene.raw() for _ in range(10)]
    with scene.counts("port", "greeting_malformed", 3):
        for length in [4, 50, 3000]:
            with scene.tls() as link:
                link.sendall(struct.pack(">I", length) + noise.randbytes(length))
                assert closed(link)
    assert scene.unchanged()
    for link in silent:
        link.close()


@pytest.mark.parametrize(
    ("message", "event"),
    [
        (struct.pack(">I", 2**32 - 1), "greeting_malformed"),
        (frames.frame({"type": "greeting", "v": 3}), "greeting_version"),
        (frames.frame({"type": "greeting", "v": 2, "certificate": "zz", "signature": "00"}),
         "greeting_malformed"),
        (frames.frame({"type": "records", "records": []}), "greeting_malformed"),
        (frames.frame({"type": "greeting", "v": 2, "certificate": "00", "signature": "00"}) * 2,
         "greeting_malformed"),
    ],
)  # fmt: skip
def test_oversized_and_other_versions_of_a_greeting(scene, message, event):
    with scene.counts("port", event), scene.tls() as link:
        link.sendall(message)
        assert closed(link)
    assert scene.unchanged()


def test_a_greeting_that_is_cut_short(scene):
    with scene.counts("port", "tls_failed"), scene.tls() as link:
        link.sendall(struct.pack(">I", 100) + b"{")
    assert scene.unchanged()


def _stranger(authority: Authority, folder: Path) -> CredentialPaths:
    return Authority(folder / "stranger").robot()


def _expired(authority: Authority, folder: Path) -> CredentialPaths:
    name = certificate_names.robot(POOL_UID, "old")
    return authority.issue(name, Role.ROBOT, days=-0.5)


def _rendezvous(authority: Authority, folder: Path) -> CredentialPaths:
    return authority.issue(certificate_names.rendezvous(POOL_UID, "x"), Role.RENDEZVOUS)


def _of_another_pool(authority: Authority, folder: Path) -> CredentialPaths:
    return authority.issue(certificate_names.robot("f" * 16, "r"), Role.ROBOT)


@pytest.mark.parametrize(
    ("make", "event"),
    [
        (_stranger, "greeting_authority"),
        (_expired, "greeting_expired"),
        (_rendezvous, "greeting_role"),
        (_of_another_pool, "greeting_role"),
    ],
)
def test_certificates_of_another_pool_time_or_role_are_not_let_in(scene, tmp_path, make, event):
    files = make(scene.authority, tmp_path)
    with scene.counts("port", event), scene.greeted(files) as link:
        assert closed(link)
    assert scene.unchanged()


def test_a_proof_cannot_be_forged_replayed_or_meant_for_something_else(scene):
    robot = scene.authority.robot("r")
    with scene.counts("port", "greeting_forged"):
        with scene.greeted(robot, purpose="other") as link:
            assert closed(link)
    with scene.counts("port", "greeting_forged"), scene.tls() as first, scene.tls() as second:
        nonce, _ = frames.read_challenge(next(iter(frames.Unframer().feed(first.recv(4096)))))
        binding = binding_of(first.getpeercert(binary_form=True))
        signer = Signer(robot.certificate, robot.key)
        proof = frames.greeting(*signer(frames.proof_bytes(PURPOSE, nonce, binding)))
        second.sendall(proof)  # overheard on the first connection, sent on the second
        assert closed(second)
    assert scene.unchanged()


def _signed(files: CredentialPaths, record: Record) -> SignedRecord:
    return sign_record(record, Signer(files.certificate, files.key))


def _records(one: SignedRecord) -> bytes:
    return frames.frame({"type": "records", "records": [to_plain(one)]})


def test_a_member_may_write_nothing_but_its_own(scene):
    """A stolen replica's key: it tries another slot, another generation, the manager's records."""
    thief = scene.authority.replica(0, 1)
    admission = admission_content(Membership("p", POOL_UID, 9, 9, ()))
    slot = plain.to_plain(SlotState(endpoint="6.6.6.6:6"))
    forged = [
        Record(POOL_UID, RecordKind.SLOT, "1", 1, 9, slot),
        Record(POOL_UID, RecordKind.SLOT, "0", 2, 9, slot),
        Record(POOL_UID, RecordKind.ADMISSION, "", 9, 9, admission),
        Record(POOL_UID, RecordKind.REVOCATION, "", 9, 9, {"names": []}),
        Record(POOL_UID, RecordKind.ROBOT, "r", 1, 9, {"dial_in": "6.6.6.6:6"}),
    ]
    with scene.greeted(thief) as link, scene.counts("offered", "refused_writer", len(forged)):
        for record in forged:
            link.sendall(_records(_signed(thief, record)))
    assert scene.unchanged()


def test_replayed_and_damaged_records_change_nothing(scene):
    """From a member in good standing: old ones of the manager's, cut ones, changed ones."""
    manager = manager_files(scene.authority)
    old = Record(POOL_UID, RecordKind.ADMISSION, "", 1, 4,
                 admission_content(Membership("p", POOL_UID, 1, 4, ())))  # fmt: skip
    newer = _signed(manager, replace(old, generation=9))
    stranger = Record("f" * 16, RecordKind.ADMISSION, "", 9, 9, dict(old.content))
    with scene.greeted(scene.authority.robot("eve")) as link:
        for one, event in [
            (_signed(manager, old), "older"),
            (replace(newer, body=newer.body.replace(b'"sequence":4', b'"sequence":9')),
             "refused_forged"),
            (replace(newer, body=newer.body[:-5]), "refused_malformed"),
            (replace(newer, body=newer.body.replace(b'"v":2', b'"v":3')), "refused_version"),
            (replace(newer, signature=bytes(70)), "refused_forged"),
            (replace(newer, certificate=os.urandom(700)), "refused_malformed"),
            (_signed(manager, stranger), "refused_pool"),
        ]:  # fmt: skip
            with scene.counts("offered", event):
                link.sendall(_records(one))
    assert scene.unchanged()


@pytest.mark.parametrize(
    "message",
    [
        {"type": "records", "records": 1},
        {"type": "records", "records": [{"body": 1}]},
        {"type": "have", "digest": [["a", "b", -1, 0]]},
        {"type": "have", "digest": {"a": 1}},
        {"type": "request", "payload": "application data"},
        {},
    ],
)
def test_a_member_that_says_odd_things_is_cut_off(scene, message):
    """It carries no application data: there is no message that could."""
    before = scene.place.count("messages", "message_malformed")

    def cut_off_for_it() -> bool:
        with scene.greeted(scene.authority.robot("odd")) as link:
            link.sendall(frames.frame(message))
            assert closed(link)  # for being slow to greet, too, where the machine is busy
        return scene.place.count("messages", "message_malformed") > before

    wait_for(cut_off_for_it)
    assert scene.unchanged()


def _ask_for_ever(link: ssl.SSLSocket) -> None:
    while True:
        link.sendall(frames.have({}) * 500)


@pytest.mark.parametrize("split", [0, 3, 30])
def test_what_comes_along_with_a_greeting_is_heard(scene, split):
    """Callers await no answer to their greeting: on a busy machine all is read at once.

    The second part comes a little later only so that there may be two reads; either will do.
    """
    link, greeting = scene.greeting(scene.authority.robot("hasty"))
    data = greeting + frames.have({}) * 2
    with link:
        link.sendall(data[: len(data) - split])
        link.sendall(data[len(data) - split :])
        unframer, found = frames.Unframer(), []
        while not found:
            data = link.recv(4096)
            assert data, "it hung up"
            found = [m for m in unframer.feed(data) if m["type"] == "records"]
    assert scene.unchanged()


def test_a_member_that_reads_nothing_is_let_go(scene):
    """It asks for everything over and over, and never takes an answer."""
    with scene.greeted(scene.authority.robot("glutton")) as link:
        link.settimeout(30.0)
        with pytest.raises(OSError):
            _ask_for_ever(link)
    assert scene.unchanged()


def test_nobody_but_a_rendezvous_is_greeted(authority):
    """A replica's certificate at the rendezvous's address: the caller says nothing to it."""
    impostor = Rendezvous(authority, "x", files=authority.replica(0))
    robot = Party(authority.robot(), impostor.endpoint)
    try:
        words = "not of a rendezvous"
        wait_for(lambda: words in robot.client.status()["rendezvous"][0]["detail"])
        assert impostor.status()["callers"] == 0
        assert impostor.count("port", "admitted") == 0
    finally:
        robot.client.close()
        impostor.kill()


def test_a_caller_survives_whatever_answers(authority):
    """Noise in place of a rendezvous, before and after TLS, is an error with words."""
    robot = authority.robot()

    async def serve() -> None:
        noise = random.Random(2)

        async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            writer.write(noise.randbytes(500))
            await writer.drain()
            writer.close()

        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        own = authority.issue(certificate_names.rendezvous(POOL_UID, "n"), Role.RENDEZVOUS)
        context.load_cert_chain(own.certificate, own.key)
        for tls in (None, context):
            server = await asyncio.start_server(talk, "127.0.0.1", 0, ssl=tls)
            port = server.sockets[0].getsockname()[1]
            signer = Signer(robot.certificate, robot.key)
            for _ in range(5):
                with pytest.raises((OSError, RecordError)):
                    await connect(f"127.0.0.1:{port}", robot, signer, POOL_UID)
            server.close()

    asyncio.run(serve())


# -- the decoders alone -------------------------------------------------------------------------


@given(st.binary(max_size=200), st.integers(1, 50))
def test_any_bytes_cut_anywhere_give_messages_or_a_record_error(data, step):
    unframer = frames.Unframer(limit=1000)
    with contextlib.suppress(RecordError):
        for at in range(0, len(data), step):
            for message in unframer.feed(data[at : at + step]):
                assert isinstance(message, dict)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=6),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.sampled_from(["type", "v", "nonce", "seen", "digest", "records", "certificate"]),
            inner,
        )
    ),
    max_leaves=10,
)


@given(st.dictionaries(st.sampled_from(["type", "v", "nonce", "seen", "digest", "records"]), JSON))
def test_any_message_is_read_or_refused(message):
    for read in (
        frames.read_challenge, frames.read_greeting, frames.read_have, frames.read_records,
    ):  # fmt: skip
        with contextlib.suppress(RecordError):
            read(message)


@given(st.lists(st.binary(min_size=1, max_size=40), min_size=1, max_size=20))
def test_what_is_framed_is_read_however_it_is_cut(parts):
    messages = [{"n": n, "part": part.hex()} for n, part in enumerate(parts)]
    stream = b"".join(map(frames.frame, messages))
    unframer, found = frames.Unframer(), []
    for byte in range(0, len(stream), 7):
        found += unframer.feed(stream[byte : byte + 7])
    assert found == messages


def test_large_sets_travel_in_small_frames(authority):
    manager = manager_files(authority)
    all = [
        _signed(manager, Record(POOL_UID, RecordKind.ADMISSION, "", 1, n, {"x": "y" * 40_000}))
        for n in range(9)
    ]
    unframer, found = frames.Unframer(), []
    for data in frames.records(all):
        for message in unframer.feed(data):
            found += frames.read_records(message)
    assert found == all


@pytest.mark.parametrize("seed", range(3))
def test_damaged_bytes_break_no_reader(seed):
    """A short run of what `fuzz_records` does by the million; good inputs come through it too."""
    outcomes = fuzz_records.run(3000, seed)
    assert sum(outcomes.values()) == 3000
    assert {"plain read", "stream read", "plain malformed", "stream malformed"} <= set(outcomes)
