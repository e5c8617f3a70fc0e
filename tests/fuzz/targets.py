"""Every decoder of bytes that somebody else wrote, with what it may raise and what it takes.

A target takes any bytes. It returns, or raises what is listed; anything else is a finding.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import shutil
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

from fogft.errors import CredentialError, FrameError, StateError
from fogft.link import batch_frames, compression, frame, probe_frames
from fogft.link.frame import NO_LOAD, Greeting
from fogft.link.port import GatewayView, Probe, ProbeAnswer
from fogft.link.zenoh.replica.sessions import AuthenticatedSessions, NotAdmittedError
from fogft.model import credentials, membership, refusal
from fogft.model.replica import LinkState, Member, Membership, ReplicaId
from fogft.model.type_definition import Definition
from fogft.ordering import orders
from fogft.pool.commands import joining
from fogft.pool.credentials import authority, bundle
from fogft.records import frames, roster
from fogft.records import record as records
from fogft.records.record import RecordError, RecordKind, SignedRecord
from fogft.records.record_set import RecordSet
from fogft.records.signing import Signer, Verifier
from fogft.requests.load import Load
from fogft.rmw_zenoh import naming
from fogft.topics import frames as topic_frames

UID = "0123456789abcdef"
ROBOT = f"robot.ada.1.{UID}"
REPLICA = f"replica.0.1.{UID}"
MANAGER = f"manager.manager.1.{UID}"
ID, TOKEN, STAMP = bytes(range(16)), bytes(8), b"seen"
LOAD = frame.encode_load(Load(3, 1, 2, 0.5, 0.25))
ANSWERS = [(ID, NO_LOAD, b"x", ""), (ID, LOAD, b"", "lost")]


@dataclass(frozen=True)
class Target:
    """A decoder.

    Attributes:
        decode: Takes bytes.
        refusals: What it may raise.
        seeds: Inputs that it accepts, to begin from.
    """

    decode: Callable[[bytes], Any]
    refusals: tuple[type[Exception], ...]
    seeds: tuple[bytes, ...]

    def run(self, data: bytes) -> bool:
        """Decode; return whether it was accepted. Raises what is a finding."""
        try:
            self.decode(data)
        except self.refusals:
            return False
        return True


@lru_cache(maxsize=1)
def _signers() -> tuple[Path, Callable[[str], Signer]]:
    folder = Path(tempfile.mkdtemp(prefix="fogft-fuzz-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    authority.create_authority(folder, UID)

    @cache
    def signer(common_name: str) -> Signer:
        role = credentials.holder_of(common_name).role
        issued = authority.issue(folder, common_name, role=role)
        authority.write(issued, folder, common_name)
        return Signer(folder / f"{common_name}.crt", folder / f"{common_name}.key")

    return folder / "ca.crt", signer


def _record(kind: RecordKind, subject: str, writer: str, content: dict[str, Any]) -> SignedRecord:
    record = records.Record(UID, kind, subject, 1, 1, content)
    return records.sign_record(record, _signers()[1](writer))


def signed_records() -> list[SignedRecord]:
    """Return one record of each kind that is read from others."""
    slot = {
        "endpoint": "10.0.0.1:7447",
        "observed_endpoint": "",
        "dials_out": False,
        "services": ["/s"],
        "draining": False,
        "in_flight": 0,
    }
    member = {"id": {"pool_uid": UID, "slot": 0, "generation": 1}, "endpoint": "h:1"}
    return [
        _record(RecordKind.SLOT, "0", REPLICA, slot),
        _record(RecordKind.ADMISSION, "", MANAGER, {"pool": "p", "members": [member]}),
        _record(RecordKind.REVOCATION, "", MANAGER, {"names": [f"robot.eve.1.{UID}"]}),
    ]


def _offer(data: bytes) -> None:
    """Offer a signed record, as JSON, to a set; it judges without raising."""
    records_ = RecordSet(UID, _verifier())
    records_.offer(records.from_plain(_json(data)))
    assert len(records_) == sum(records_.counts[v] for v in ("accepted",))


@lru_cache(maxsize=1)
def _verifier() -> Verifier:
    return Verifier(_signers()[0])


@lru_cache(maxsize=1)
def _sessions() -> AuthenticatedSessions:
    return AuthenticatedSessions(UID, REPLICA, _verifier())


def _stream(data: bytes) -> None:
    """Read a rendezvous's stream, cut in two, and each message as every kind."""
    unframer = frames.Unframer()
    half = len(data) // 2
    for part in (data[:half], data[half:]):
        for message in unframer.feed(part):
            for read in (
                frames.read_challenge,
                frames.read_greeting,
                frames.read_have,
                frames.read_records,
            ):
                with contextlib.suppress(RecordError):
                    read(message)


def _content(data: bytes) -> None:
    """Read a record's content as each kind's: whose key is stolen writes what he likes."""
    content = _object(data)
    for kind in RecordKind:
        with contextlib.suppress(RecordError):
            roster.READERS[kind](records.Record(UID, kind, "0", 1, 1, content))
    for read in (roster.slot_state, roster.dial_in, roster.admission, roster.revoked_names):
        with contextlib.suppress(RecordError):
            read(records.Record(UID, RecordKind.SLOT, "0", 1, 1, content))


def _order(data: bytes) -> None:
    """Read a sequencer's order, and each answer to one."""
    text = data.decode("latin-1")
    for read_refusal in (refusal.read, orders.read_index, orders.read_epoch):
        read_refusal(text)
    for read in (
        orders.decode_join,
        orders.decode_promise,
        orders.decode_index,
        orders.decode_snapshot,
    ):
        with contextlib.suppress(orders.OrderError):
            read(data)
    orders.decode(data)


def _judge_greeting(data: bytes) -> None:
    greeting = frame.decode_greeting(data)
    sessions = _sessions()
    sessions.greet(greeting)
    said = "somebody was let in who holds no certificate"
    holder = sessions.of(greeting.token)
    assert holder is not None, said
    assert holder.common_name == ROBOT, said


def _greeting() -> bytes:
    certificate, signature = _signers()[1](ROBOT)(frame.greeted_bytes(TOKEN, REPLICA))
    return frame.encode_greeting(Greeting(TOKEN, certificate, signature))


def _json(data: bytes) -> Any:
    try:
        return json.loads(data)
    except (ValueError, RecursionError):
        raise RecordError("malformed", "no JSON") from None


def _token(data: bytes) -> None:
    if naming.read_token(data.decode("latin-1")) is None:
        raise ValueError("no token")


def _bundle() -> bytes:
    label = bundle.Label("id", "pool", ROBOT, 1.0, 2.0)
    with patch.dict(bundle.SCRYPT, n=2):  # nobody guesses at it
        return bundle.seal(label, {"files": {"a/b": "c"}}, "a passphrase of mine")


def targets() -> dict[str, Target]:
    """Return all decoders by name."""
    framed, recorded = (FrameError,), (RecordError,)
    types = {"a/srv/B": Definition("RIHS01_0", {"request": (("x", "a/C[2]"),), "a/C": ()})}
    offered = {"/s": "a/srv/B"}
    answer = ProbeAnswer(
        slot=0,
        generation=1,
        incarnation="x",
        ready=frozenset({"/s"}),
        detail="why",
        types=types,
        offered=offered,
    )
    behind = GatewayView(
        slot=1,
        generation=2,
        state=LinkState.UP,
        ready=frozenset({"/s"}),
        rtt_s=0.01,
        through="lab/edge",
    )
    gateway = replace(answer, types={}, behind=(behind, behind), accepts=compression.ACCEPTED)
    plain = [json.dumps(records.to_plain(one)).encode() for one in signed_records()]
    known = Membership("p", UID, 1, 2, (Member(ReplicaId(UID, 0, 1), "h:1"),), frozenset({ROBOT}))
    greeting = _greeting()
    origin = frame.origin("ada", TOKEN)
    stream = b"".join(
        [
            frames.ping(),
            frames.challenge(bytes(frames.NONCE_BYTES), "10.0.0.1"),
            frames.greeting(*_signers()[1](ROBOT)(b"proof")),
            frames.have({("slot", "0"): (1, 1)}),
            *frames.records(signed_records()),
        ]
    )
    return {
        "request": Target(
            frame.decode_request,
            framed,
            (
                frame.encode_request(ID, 1.5, origin),
                frame.encode_request(
                    ID,
                    1.5,
                    frame.origin("ada", TOKEN),
                    seen=STAMP,
                    packed=True,
                    may_pack=True,
                    reads_packed=True,
                ),
            ),
        ),
        "batch of requests": Target(
            lambda data: batch_frames.decode_requests(data[:16], data[16:]),
            framed,
            (
                b"".join(
                    batch_frames.encode_requests(
                        [(ID, 1.5, 0, b"x"), (ID, 2.0, 8, b"")], frame.origin("ada", TOKEN)
                    )
                ),
            ),
        ),
        "batch of answers": Target(
            lambda data: batch_frames.decode_answers(data[:5], data[5:]),
            framed,
            (
                b"".join(
                    batch_frames.encode_answers(
                        STAMP, [(ID, NO_LOAD, b"x", ""), (ID, LOAD, b"", "lost")]
                    )
                ),
            ),
        ),
        "answer": Target(frame.decode_answer, framed, (frame.encode_answer(STAMP, ID, load=LOAD),)),
        "refusal": Target(frame.decode_refusal, framed, (frame.encode_refusal(STAMP, ID, "lost"),)),
        "cancel": Target(frame.decode_cancel, framed, (frame.encode_cancel([ID, ID]),)),
        "probe": Target(
            probe_frames.decode_probe, framed, (probe_frames.encode_probe(Probe("ada")),)
        ),
        "probe answer": Target(
            probe_frames.decode_probe_answer,
            framed,
            (probe_frames.encode_probe_answer(answer), probe_frames.encode_probe_answer(gateway)),
        ),
        "compressed payload": Target(
            lambda data: compression.unpack(data, 1 << 16),
            (ValueError,),
            (zlib.compress(bytes(1000), 1), zlib.compress(bytes(range(256)) * 4, 1)),
        ),
        "order": Target(
            _order,
            (orders.OrderError,),
            (orders.encode(orders.Op.APPLY, 1 << 32, 7),),
        ),
        "content of a record": Target(
            _content,
            recorded,
            tuple(json.dumps(records.read_body(one).content).encode() for one in signed_records()),
        ),
        "greeting": Target(
            frame.decode_greeting, framed, (greeting, frame.encode_greeting(Greeting(TOKEN)))
        ),
        "greeting, judged": Target(_judge_greeting, (FrameError, NotAdmittedError), (greeting,)),
        "rmw_zenoh token": Target(
            _token,
            (ValueError,),
            (f"@ros2_lv/7/a/0/1/SS/%/%/n/%s/a::srv::dds_::B_/{naming.NO_HASH}/::2".encode(),),
        ),
        "common name": Target(
            lambda data: credentials.holder_of(data.decode("latin-1")),
            (ValueError,),
            (ROBOT.encode(), REPLICA.encode()),
        ),
        "membership": Target(
            lambda data: membership.from_dict(_json(data)),
            (StateError, RecordError),
            (json.dumps(membership.to_dict(known)).encode(),),
        ),
        "record": Target(
            lambda data: records.read_body(SignedRecord(data, b"", b"")),
            recorded,
            tuple(one.body for one in signed_records()),
        ),
        "record, judged": Target(_offer, recorded, tuple(plain)),
        "certificate": Target(
            lambda data: _verifier()(data, b"", b""), recorded, (signed_records()[0].certificate,)
        ),
        "record stream": Target(_stream, recorded, (stream,)),
        "records of a link": Target(frames.unpack, recorded, (frames.pack(signed_records()),)),
        "message of a topic": Target(
            topic_frames.decode_message, framed, (topic_frames.encode_message(TOKEN, 7, b"cdr"),)
        ),
        "pull": Target(topic_frames.decode_pull, framed, (topic_frames.encode_pull(TOKEN, 7),)),
        "batch": Target(
            topic_frames.decode_batch,
            framed,
            (topic_frames.encode_batch(b"sessions", 9, [(8, b"one"), (9, b"")]),),
        ),
        "bundle": Target(bundle.read_label, (CredentialError,), (_bundle(),)),
        "bundle's files": Target(
            lambda data: joining.read_content(_object(data)),
            (CredentialError, RecordError),
            (b'{"files": {"credentials/ca.crt": "c", "proxy.yaml": "{status: s}"}}',),
        ),
    }


def _object(data: bytes) -> dict[str, Any]:
    value = _json(data)
    return value if isinstance(value, dict) else {}
