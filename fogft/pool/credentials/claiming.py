"""Claim a join bundle at the rendezvous before it is used, so that it is used only once.

The claim is the holder's own record, signed with the key from the bundle. A second machine finds
the record of the first and does not join. If two machines join at the same moment, the earlier
claim wins, whichever rendezvous each has reached.
"""

import secrets
import time
from collections.abc import Sequence
from pathlib import Path

from fogft import disk
from fogft.errors import CredentialError
from fogft.model.credentials import CredentialPaths, Holder, Role
from fogft.model.plain import to_plain
from fogft.records.client import RendezvousClient
from fogft.records.record import Record, RecordKind
from fogft.records.roster import DialIn, SlotState

LIMIT_S = 15.0
SETTLE_S = 0.5
_POLL_S = 0.02
_KEY = "joined"
_LATEST_MS = 10**13
_KEPT = 1000  # claims that this machine remembers
_KINDS = {
    Role.ROBOT: RecordKind.ROBOT,
    Role.GATEWAY: RecordKind.GATEWAY,
    Role.REPLICA: RecordKind.SLOT,
}


def own_token(claims: Path, id: str, now: float) -> str:
    """Return this machine's token for a bundle; the same one after an interruption.

    The earlier one is the greater text, and the greater record wins.
    """
    known = disk.read_as(dict[str, str], claims) or {}
    if id not in known:
        token = f"{_LATEST_MS - int(now * 1000):013d}.{secrets.token_hex(8)}"
        latest = dict(list(known.items())[-_KEPT:])
        disk.write_json(claims, known := {**latest, id: token})
    return known[id]


def claim(
    holder: Holder, token: str, endpoints: Sequence[str], credentials: CredentialPaths
) -> None:
    """Claim a holder's certificate for this machine. Repeatable with the same token.

    A rendezvous's certificate is not claimed: it can send, answer and sign nothing. Raises
    `CredentialError`: another machine has joined with it, or no rendezvous can tell.
    """
    if holder.role not in _KINDS:
        return
    # Two clients: the second receives what the rendezvous holds, whatever the first has published.
    speaker, hearer = (RendezvousClient(endpoints, credentials, holder.pool_uid) for _ in range(2))
    until = time.monotonic() + LIMIT_S
    speaker.start()
    hearer.start()
    try:
        about = SlotState() if holder.role is Role.REPLICA else DialIn()
        said = {**to_plain(about), _KEY: token}
        # The second record ranks above any other claim that comes later.
        for sequence, pause_s in ((1, SETTLE_S), (2, 0.0)):
            kind, generation = _KINDS[holder.role], holder.generation
            speaker.publish(kind, holder.name, generation, said, sequence=sequence)
            while _standing(hearer, holder, sequence) is None:
                if time.monotonic() > until:
                    raise _nobody_tells(hearer)
                time.sleep(_POLL_S)
            time.sleep(pause_s)
            found = _standing(hearer, holder, sequence)
            if found is None or found.content.get(_KEY) != token:
                raise CredentialError(
                    f"this bundle for `{holder.short}` was used before, on another machine",
                    "a bundle can be used only once: request a new one. If you do not know who "
                    f"used it, run `fogft credentials revoke {holder.role.value} {holder.name}`",
                )
    finally:
        speaker.close()
        hearer.close()


def _standing(client: RendezvousClient, holder: Holder, sequence: int) -> Record | None:
    """Return a holder's record once its sequence reaches that of this claim; None before."""
    for record in client.known.of(_KINDS[holder.role]):
        if record.subject == holder.name and record.order >= (holder.generation, sequence):
            return record
    return None


def _nobody_tells(client: RendezvousClient) -> CredentialError:
    said = "; ".join(str(one["detail"]) for one in client.status()["rendezvous"])
    return CredentialError(
        "no rendezvous of the pool could confirm that this bundle is unused"
        + (f": {said}" if said.strip("; ") else ""),
        "join once one can be reached from here; the bundle stays valid",
    )
