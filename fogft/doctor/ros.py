"""Checks of ROS 2: installed, its middleware, its domain, its profile, and that it works.

rclpy is imported only in separate processes: a broken installation can end the process.
"""

import json
import os
import secrets
import subprocess
from collections.abc import Iterator, Mapping
from typing import Any
from xml.etree import ElementTree

from fogft.child import how_it_ended, python
from fogft.doctor.finding import Finding, Situation, fail, ok, warn
from fogft.errors import RosError
from fogft.ros import environment
from fogft.ros.reservations import DOMAINS, own_domain

_LIMIT_S = 30.0
_RMW_WITH_PROFILE = "rmw_fastrtps_cpp"
_KNOWN = {
    "rmw_cyclonedds_cpp": "works, but service calls between it and Fast DDS on one machine fail",
    "rmw_zenoh_cpp": "works, and with `rmw: zenoh` in the pool file fogft needs no ROS 2 for it",
}
_RANGES = ("SUBNET", "LOCALHOST", "OFF", "SYSTEM_DEFAULT")
_DISCOVERY_ADVICE = (
    "if this machine has no multicast (many containers and networks have none), set "
    "ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST, or list peers in ROS_STATIC_PEERS; "
    "also check the firewall for UDP"
)


def rclpy(_: Situation) -> Iterator[Finding]:
    """ROS 2 can be imported, with a middleware that is known to work."""
    described = _self_test("describe")
    if problem := described.get("error"):
        yield fail(
            "rclpy",
            f"ROS 2 cannot be used from this Python: {problem}",
            "source your installation (`. /opt/ros/DISTRO/setup.bash`), or run "
            "`pip install 'fogft[ros]'` in a virtual environment (its wheels need one)",
        )
        return
    name = described["distribution"].capitalize()
    yield ok("rclpy", f"ROS 2 {name}, rclpy {described['rclpy']}")
    yield judge_middleware(described["rmw"])


def judge_middleware(rmw: str) -> Finding:
    """Report which middleware is in use, and how well it is tested with fogft."""
    if rmw == _RMW_WITH_PROFILE:
        return ok("middleware", f"{rmw}: the one that fogft is measured with")
    return warn(
        "middleware",
        f"{rmw}: {_KNOWN.get(rmw, 'not tested with fogft')}",
        f"set the same RMW_IMPLEMENTATION for your nodes, or {_RMW_WITH_PROFILE} for all",
    )


def domain(_: Situation, environ: Mapping[str, str] = os.environ) -> Iterator[Finding]:
    """The ROS domain and the discovery range are valid."""
    try:
        number = own_domain(environ, of_dds=True)
        if number <= DOMAINS[-1]:
            yield ok("ROS domain", f"{number}; your nodes must use the same")
        else:
            yield warn(
                "ROS domain",
                f"ROS_DOMAIN_ID is {number}; its ports may be taken by outgoing connections",
                f"use a number from 0 to {DOMAINS[-1]}",
            )
    except RosError as error:
        yield fail("ROS domain", error.message, error.hint)
    reach = environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "")
    if environ.get("ROS_LOCALHOST_ONLY") == "1":
        yield warn(
            "discovery range",
            "ROS_LOCALHOST_ONLY is set, so ROS ignores the range and ROS_STATIC_PEERS",
            "unset it; ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST does the same",
        )
    elif reach and reach not in _RANGES:
        yield fail(
            "discovery range",
            f"ROS_AUTOMATIC_DISCOVERY_RANGE is `{reach}`",
            f"set it to one of {', '.join(_RANGES[:3])}",
        )
    elif reach == "OFF":
        yield fail(
            "discovery range",
            "ROS_AUTOMATIC_DISCOVERY_RANGE is `OFF`: nodes cannot discover each other",
            "set it to LOCALHOST",
        )
    else:
        yield ok("discovery range", reach or "SUBNET (the default)")


def profile(_: Situation) -> Iterator[Finding]:
    """Fast DDS maps a shared-memory segment large enough for images."""
    name = environment.profile_variable()
    theirs = os.environ.get(name)
    if theirs:
        try:
            ElementTree.parse(theirs)
        except (OSError, ElementTree.ParseError) as error:
            yield fail(
                "Fast DDS profile",
                f"{name} is `{theirs}`, which cannot be read: {error}",
                "correct the path or unset the variable: fogft then uses its own profile",
            )
            return
    prepared = dict(os.environ)
    is_ours = environment.prepare(prepared)
    measured = _self_test("segment")
    if "segment_bytes" not in measured:
        yield warn(
            "Fast DDS profile", f"could not be tested: {measured['error']}", "see `rclpy` above"
        )
        return
    yield judge_segment(measured["segment_bytes"], name, prepared[name] if is_ours else "")


def judge_segment(segment_bytes: int, variable: str, ours: str) -> Finding:
    """Judge the shared memory that a node maps; `ours` is the shipped profile, if fogft sets it."""
    if segment_bytes >= environment.PROFILE_SEGMENT_BYTES:
        if ours:
            return warn(
                "Fast DDS profile",
                "your nodes use none: messages over 0.5 MB take ten times as long",
                f"export {variable}={ours} where your nodes start, as fogft's processes do",
            )
        return ok("Fast DDS profile", f"yours maps a segment of {segment_bytes / 1e6:.0f} MB")
    if not segment_bytes:
        return ok("Fast DDS profile", "not used: your nodes map no Fast DDS shared memory")
    return warn(
        "Fast DDS profile",
        f"a node maps only {segment_bytes / 1e6:.1f} MB of shared memory: messages over 0.5 MB "
        "take ten times as long",
        f"let {variable} name a profile with a larger segment, such as "
        f"{environment.profile_path()}, and give /dev/shm at least 140 MB",
    )


def discovery(_: Situation) -> Iterator[Finding]:
    """Two processes find each other in this environment and one calls the other."""
    name = f"fogft_doctor_{secrets.token_hex(4)}"
    with subprocess.Popen(
        child_command("answer", name),
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as answering:
        try:
            result = _self_test("ask", name)
        finally:
            try:
                answering.communicate(timeout=5)  # closes its input
            except subprocess.TimeoutExpired:
                answering.kill()
    if "error" not in result:
        found, called = result["discovery_s"], result["call_s"]
        yield ok(
            "discovery",
            f"a node was discovered in {found:.1f} s and answered in {called * 1000:.1f} ms",
        )
    elif result.get("kind") == "TimeoutError" and result["error"] == "discovery":
        yield fail(
            "discovery", "two nodes on this machine do not discover each other", _DISCOVERY_ADVICE
        )
    elif result.get("kind") == "TimeoutError":
        yield fail(
            "discovery",
            "a node was discovered, but its service did not answer",
            "check /dev/shm (two users or containers may see different ones) and the firewall",
        )
    else:
        yield fail("discovery", f"could not be tested: {result['error']}", "see `rclpy` above")


def _self_test(*arguments: str) -> dict[str, Any]:
    """Run `fogft.ros.self_test`; return what it printed, or ``{"error": ...}``."""
    try:
        ended = subprocess.run(
            child_command(*arguments),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=_LIMIT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return {"error": f"no answer within {_LIMIT_S:.0f} s"}
    try:
        result = json.loads(ended.stdout.strip().splitlines()[-1])
    except (ValueError, IndexError):
        said = ended.stderr.strip().splitlines() or ["it printed nothing"]
        return {"error": f"it {how_it_ended(ended.returncode)}: {said[-1]}"}
    return result if isinstance(result, dict) else {"error": "no answer"}


def child_command(*arguments: str) -> list[str]:
    """Return the command that tests ROS in a separate process, which may crash."""
    return python("-m", "fogft.ros.self_test", *arguments)
