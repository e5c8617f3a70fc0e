"""The examples work as ordinary ROS 2 programs, with no fogft between client and service."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from contextlib import contextmanager

import pytest

from fogft import template_files
from tests.needs import needs

pytestmark = [pytest.mark.ros, needs("rclpy")]
LIMIT_S = 60


@contextmanager
def service(folder, domain, *arguments):
    """Run an example's service until the block ends; yields its environment."""
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain)}
    process = subprocess.Popen(
        [sys.executable, *arguments],
        cwd=folder,
        env=environment,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield environment, process
    finally:
        process.kill()
        process.communicate()


def call(folder, environment, *arguments):
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )


def test_echo(ros_domain):
    """The smallest example answers, and says so."""
    folder = template_files.folder() / "echo"
    with service(folder, ros_domain, "echo_service.py") as (environment, _):
        done = call(folder, environment, "echo_client.py", "--count", "2")
        if done.stderr.startswith("request 0: no answer"):
            # Nothing of fogft is between them: DDS drops what it sends before it knows the reader.
            done = call(folder, environment, "echo_client.py", "--count", "2")
    assert (done.returncode, done.stdout, done.stderr) == (0, "heard True\nheard False\n", "")


def test_echo_without_a_service(ros_domain):
    folder = template_files.folder() / "echo"
    environment = {**os.environ, "ROS_DOMAIN_ID": str(ros_domain)}
    done = call(folder, environment, "echo_client.py", "--timeout-s", "0.2")
    assert (done.returncode, done.stdout, done.stderr) == (1, "", "no service /echo\n")


@needs("ompl")
def test_planner(ros_domain):
    """Every plan is right, the score adds up, and OMPL keeps quiet to the end."""
    folder = template_files.folder() / "planner"
    with service(folder, ros_domain, "planner_service.py") as (environment, process):
        done = call(folder, environment, "planner_client.py", "--count", "8", "--period-s", "0.05")
        process.send_signal(signal.SIGINT)
        logged = process.communicate(timeout=LIMIT_S)[1]
    summary = json.loads(done.stdout)
    assert done.returncode == 0
    assert summary["requests"] == summary["answered"] == 8
    assert (summary["failed"], summary["wrong"], summary["faults"]) == (0, 0, [])
    assert 0 < summary["p50_s"] <= summary["p99_s"] <= summary["max_s"]
    assert [line.partition("]: ")[2] for line in logged.splitlines()] == ["ready to plan"]
    assert process.returncode == 0


@needs("ompl")
def test_the_planners_client_finds_wrong_answers(ros_domain):
    """A service that plans in another scene is caught: the check can fail."""
    folder = template_files.folder() / "planner"
    arguments = ("planner_service.py", "--scene", "8", "--limit-s", "0.2")
    with service(folder, ros_domain, *arguments) as (environment, _):
        done = call(folder, environment, "planner_client.py", "--count", "4", "--period-s", "0.05")
    summary = json.loads(done.stdout)
    assert done.returncode == 1
    assert summary["wrong"] == 4
    assert summary["answered"] == summary["failed"] == 0
    assert summary["faults"]


@needs("ompl")
def test_the_planners_client_counts_what_is_never_answered(ros_domain):
    """A frozen service fails every request, and the client still ends."""
    folder = template_files.folder() / "planner"
    with service(folder, ros_domain, "planner_service.py") as (environment, process):
        process.stderr.readline()  # "ready to plan"
        ready = call(folder, environment, "planner_client.py", "--count", "1")
        process.send_signal(signal.SIGSTOP)
        done = call(
            folder,
            environment,
            *("planner_client.py", "--count", "3", "--period-s", "0.05", "--timeout-s", "0.5"),
            *("--wait-s", "1"),
        )
    assert ready.returncode == 0
    assert done.returncode == 1
    if done.stdout:  # else its discovery did not find a frozen service, and it said so
        assert json.loads(done.stdout)["failed"] == 3
    else:
        assert done.stderr == "no service /plan within 1.0 s\n"
