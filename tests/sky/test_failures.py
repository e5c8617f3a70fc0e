"""The clouds' own codes decide what a failed launch means."""

from __future__ import annotations

import pytest

from fogft.cloud.sky.failures import classify, tail, told_last
from fogft.model.reason import Cause

UNAVAILABLE = "ResourcesUnavailableError"


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("(InsufficientInstanceCapacity) when calling the RunInstances", Cause.CAPACITY),
        ("There is no Spot capacity available that matches your request.", Cause.CAPACITY),
        ("ZONE_RESOURCE_POOL_EXHAUSTED_WITH_DETAILS", Cause.CAPACITY),
        ("The zone 'z' does not have enough resources available", Cause.CAPACITY),
        ("(SkuNotAvailable) The requested VM size", Cause.CAPACITY),
        ("(RequestLimitExceeded) when calling RunInstances: slow down", Cause.CAPACITY),
        ("(MaxSpotInstanceCountExceeded) Max spot instance count exceeded", Cause.QUOTA),
        ("You have requested more vCPU capacity (VcpuLimitExceeded)", Cause.QUOTA),
        ("Quota 'CPUS' exceeded: quotaExceeded", Cause.QUOTA),
        ("Operation results in exceeding approved Total Regional Cores quota", Cause.QUOTA),
        ("An error occurred (RequestExpired): Request has expired.", Cause.CREDENTIALS),
        ("(UnauthorizedOperation) You are not authorized", Cause.CREDENTIALS),
        ("google.auth.exceptions.RefreshError: ('invalid_grant'", Cause.CREDENTIALS),
        ("Error when retrieving token from sso: Token has expired", Cause.CREDENTIALS),
        ("The SSO session associated with this profile has expired", Cause.CREDENTIALS),
        ("Error loading SSO Token: Token for lab does not exist", Cause.CREDENTIALS),
    ],
)
def test_the_codes_of_the_clouds(text: str, cause: Cause):
    failure = classify(UNAVAILABLE, ["Failed to acquire resources in all zones.", text])
    assert failure.cause is cause


def test_quota_outweighs_capacity_whatever_the_order():
    """Waiting helps against the one and not against the other."""
    texts = ["InsufficientInstanceCapacity", "VcpuLimitExceeded"]
    assert classify(UNAVAILABLE, texts).cause is Cause.QUOTA
    assert classify(UNAVAILABLE, texts[::-1]).cause is Cause.QUOTA


def test_without_a_code_the_exceptions_kind_decides():
    assert classify(UNAVAILABLE, ["?"]).cause is Cause.CAPACITY
    assert classify("NoCloudAccessError", ["?"]).cause is Cause.CREDENTIALS
    assert classify("RuntimeError", []).cause is Cause.ERROR


def test_words_are_one_short_line_without_colours():
    failure = classify("X", ["\x1b[31m" + "a " * 500 + "\nQuotaExceeded \x1b[0m" + "b " * 500])
    assert "\n" not in failure.words
    assert "\x1b" not in failure.words
    assert len(failure.words) < 330
    assert "QuotaExceeded" in failure.words
    line = "D 11-26 01:06:41.088 PID=286 provisioner.py:361] no spot capacity"
    assert classify("X", [line]).words == "no spot capacity"


def test_a_permission_that_is_missing_is_named_however_long_the_caller_is_called():
    who = "arn:aws:sts::123456789012:assumed-role/AWSReservedSSO_" + "x" * 200
    text = (
        "(UnauthorizedOperation) when calling the RunInstances operation: You may not "
        f"perform this operation. User: {who} is not authorized to perform: iam:PassRole on "
        "resource: arn:aws:iam::123456789012:role/skypilot-v1 because no identity-based policy "
        "allows it. Encoded authorization failure message: " + "Zm9nZnQ" * 120
    )
    failure = classify(UNAVAILABLE, [text])
    assert failure.cause is Cause.CREDENTIALS
    assert "iam:PassRole on resource: arn:aws:iam::123456789012:role/skypilot-v1" in failure.words
    assert failure.words.startswith("... is not authorized to perform: ")
    assert failure.words.endswith("allows it.")


def test_the_tail_of_a_log_is_its_last_lines_that_say_something():
    log = "\n".join(f"\x1b[36mline {n}\x1b[0m\n" for n in range(50))
    assert tail(log, lines=3) == "\nline 47\nline 48\nline 49"
    assert tail("x" * 900, width=10) == "\n" + "x" * 10
    assert tail("") == ""


def test_the_tail_leaves_out_who_spoke_and_what_skypilot_says_of_itself():
    log = (
        "\x1b[2m├── \x1b[0mWaiting for task resources on 1 node.\n"
        "\x1b[36m(setup pid=477)\x1b[0m no such package: yolo\n"
        "(perception, pid=12) (not a speaker) stays\n"
        "\x1b[32m✓ Job finished (status: FAILED_SETUP).\x1b[0m\n"
    )
    assert tail(log) == "\nno such package: yolo\n(not a speaker) stays"


def test_of_a_launchs_log_the_last_try_counts():
    log = (
        "D create_instances: (InsufficientInstanceCapacity) when calling the RunInstances\n"
        "D create_instances: (VcpuLimitExceeded) You have requested more vCPU\n"
        "I Terminating the failed cluster.\n"
    )
    failure = told_last(log)
    assert failure is not None
    assert failure.cause is Cause.QUOTA
    assert told_last("I Launching on AWS\n") is None


def test_of_a_launchs_log_a_code_of_awss_that_is_unknown_counts_too():
    """Else a blocked account would look like a lack of capacity."""
    said = "D An error occurred (%s) when calling the RunInstances operation: account is blocked\n"
    log = said % "Blocked" + "D An error occurred (InvalidGroup.NotFound) when calling Describe\n"
    failure = told_last(log)
    assert failure is not None
    assert failure.cause is Cause.ERROR
    assert "(Blocked)" in failure.words
    full = told_last(said % "InsufficientInstanceCapacity" + log)
    assert full is not None
    assert full.cause is Cause.CAPACITY
