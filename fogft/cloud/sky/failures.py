"""Classify a failed launch: capacity, quota, credentials, setup, timeout or error. Pure.

The clouds' own error codes decide, not the exception class, which is the same for no capacity, no
quota and no permission. The codes are in the messages or, for AWS, only in the launch's log.
"""

import re
from collections.abc import Iterable

from fogft.model.reason import Cause, Reason

# In order: the first that matches decides. Quota before capacity, since some quota messages
# also speak of capacity; credentials first, since without them nothing else is known.
_CODES: tuple[tuple[Cause, str], ...] = (
    (
        Cause.CREDENTIALS,
        r"ExpiredToken|RequestExpired|InvalidClientTokenId|AuthFailure|UnauthorizedOperation"
        r"|AccessDenied|SignatureDoesNotMatch|OptInRequired|NoCredentialsError"
        r"|Unable to locate credentials|invalid_grant|RefreshError|PERMISSION_DENIED"
        r"|does not have .{0,60}permission|AuthorizationFailed|InvalidAuthenticationToken"
        r"|NoCloudAccess|InvalidCloudCredentials|CloudUserIdentityError"
        r"|SSO session associated|loading SSO Token|retrieving (?:token|credentials) from sso",
    ),
    (
        Cause.QUOTA,
        r"VcpuLimitExceeded|MaxSpotInstanceCountExceeded|InstanceLimitExceeded"
        r"|SpotInstanceCountExceeded|quotaExceeded|QUOTA_EXCEEDED|QuotaExceeded|quota limit"
        r"|exceeding approved .{0,60}quota|AddressLimitExceeded|(?i:insufficient quota)",
    ),
    (
        Cause.CAPACITY,
        r"InsufficientInstanceCapacity|InsufficientHostCapacity|InsufficientReservedInstance"
        r"|SpotMaxPriceTooLow|Unsupported.{0,80}Availability Zone|ZONE_RESOURCE_POOL_EXHAUSTED"
        r"|resourceExhausted|does not have enough resources|SkuNotAvailable|AllocationFailed"
        r"|OverconstrainedAllocationRequest|OverconstrainedZonalAllocation"
        r"|(?i:no (spot )?capacity)|(?i:insufficient capacity)|(?i:out of capacity)"
        r"|no longer any instances available|RequestLimitExceeded",
    ),
)
_KINDS = {
    "ResourcesUnavailableError": Cause.CAPACITY,
    "NoCloudAccessError": Cause.CREDENTIALS,
    "InvalidCloudCredentials": Cause.CREDENTIALS,
    "CloudUserIdentityError": Cause.CREDENTIALS,
    "PermissionDeniedError": Cause.CREDENTIALS,
}


def classify(kind: str, texts: Iterable[str]) -> Reason:
    """Return why a launch failed; `kind`: the exception's class, `texts`: its messages."""
    told = [text for text in (plain(text) for text in texts) if text]
    for cause, pattern in _CODES:
        for text in told:
            if re.search(pattern, text):
                return Reason(cause, words=_short(text, pattern))
    words = _short(told[-1] if told else kind, "")
    return Reason(_KINDS.get(kind, Cause.ERROR), words=words)


def told_last(log: str) -> Reason | None:
    """Return the last failure in a launch's log that has a known code, or AWS's; else None."""
    lines = log.splitlines()[::-1]
    found = (classify("", [line]) for line in lines)
    refused = (classify("", [line]) for line in lines if "calling the RunInstances op" in line)
    return next((one for one in found if one.cause is not Cause.ERROR), next(refused, None))


_NOT_ALLOWED = re.compile(r"is not authorized to perform: ")  # after the caller's long name
_FOR_AWS = "Encoded authorization failure message"  # a thousand characters
_SPEAKER = re.compile(r"^\([^()]{1,60} pid=\d+[^()]{0,60}\) ")
_DECORATION = ("├──", "└──", "✓ ", "⚙︎ ")  # SkyPilot's own progress lines
_LOGGED = re.compile(r"^[A-Z] [\d-]+ [\d:.]+ (?:PID=\d+ )?\S+:\d+\] ")
_COLOUR = re.compile(r"\x1b\[[0-9;]*[A-Za-z]")


def plain(text: str) -> str:
    """Return SkyPilot's text as one line, without colours, times and encoded AWS messages."""
    line = " ".join(_COLOUR.sub("", text).partition(_FOR_AWS)[0].split())
    return _LOGGED.sub("", line)


def tail(log: str, lines: int = 20, width: int = 200) -> str:
    """Return the last non-empty lines of a log, each after a line break and cut to `width`."""
    lines_of_log = (_SPEAKER.sub("", line.rstrip()) for line in _COLOUR.sub("", log).splitlines())
    told = [line for line in lines_of_log if line.strip() and not line.startswith(_DECORATION)]
    return "".join(f"\n{line[:width]}" for line in told[-lines:])


def _short(text: str, pattern: str, room: int = 300) -> str:
    """Return the text around the match or, for an AWS refusal, around the denied action."""
    found = _NOT_ALLOWED.search(text) or re.search(pattern, text) if pattern else None
    start = max(0, found.start() - 80) if found and len(text) > room else 0
    if start and found:  # not in the middle of a word
        start = text.find(" ", start, found.start()) + 1 or start
    return ("... " if start else "") + text[start : start + room]
