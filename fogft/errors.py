"""All errors shown to users. Each has a message (what, where) and a hint (what to do)."""

from __future__ import annotations


class FogftError(Exception):
    """A failure that the user can understand and act on; `hint`, if any, says how."""

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint


class SpecError(FogftError):
    """A pool file is wrong. The message begins with ``file:line: key:``.

    `key`, such as ``fogft.replicas``, is empty and `line` is 0 if the error concerns none.
    """

    def __init__(
        self, message: str, hint: str = "", *, key: str = "", what: str = "", line: int = 0
    ) -> None:
        super().__init__(message, hint)
        self.key = key
        self.what = what
        self.line = line

    @classmethod
    def of_key(cls, key: str, what: str, hint: str = "") -> SpecError:
        """Return an error about a key; the caller that knows the file adds its name and line."""
        return cls(f"{key}: {what}", hint, key=key, what=what)


class StateError(FogftError):
    """A pool's files on disk cannot be used."""


class PoolNotFound(FogftError):
    """No pool of that name exists on this machine."""


class PoolBusy(FogftError):
    """Another process holds this pool (its lock or a newer lease)."""


class NoThread(FogftError, OSError):
    """The system allows no more threads."""


class RosError(FogftError):
    """ROS 2, or one of its types, is not usable here."""


class Unreadable(RosError):
    """Bytes are not a message of the expected type; a retry cannot help."""


class WireError(FogftError):
    """A link or a listener cannot be created."""


class CredentialError(FogftError):
    """A key or a certificate is missing, unreadable, expired or of the wrong role."""


class CloudError(FogftError):
    """A cloud refused a request."""


class CloudUnreachable(CloudError):
    """The cloud did not answer: nothing is known about its machines."""


class NoCapacity(CloudError):
    """This placement is full now; another one, or a later attempt, may succeed."""


class QuotaExceeded(CloudError):
    """The account's quota is used up here; waiting does not help."""


class FrameError(ValueError):
    """Bytes from a peer are not a frame of this version. Sent to the peer, not shown to users."""


class LinkVersionError(FrameError):
    """They are one of another version: says which side to upgrade."""


def told(error: FogftError) -> str:
    """Return an error and its hint in one sentence."""
    return f"{error.message}; {error.hint}" if error.hint else error.message
