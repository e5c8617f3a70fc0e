"""What some tests need that not every machine has.

`@needs("moto")` marks a test; `need("launch")` stands at the top of a file that cannot be
imported without. Where the thing is missing, the test is not run and the closing summary says
so; where `FOGFT_MUST_RUN` names it (names joined by commas), the test fails instead.
"""

from __future__ import annotations

import ctypes.util
import importlib.util
import os
import shutil
import socket
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.boot.machine import can_boot
from tests.link.namespaces import can_make_namespaces
from tests.nightly import NIGHTLY

WEIGHTS = Path(__file__).parents[1] / "templates" / "detect" / "weights"
FAST_DDS = "rmw_fastrtps_cpp"
SKYPILOT_QUEUE_PORT = 50011  # of every API server: it cannot be chosen


class Need(NamedTuple):
    """Whether a thing is here, and how to get it."""

    is_here: Callable[[], bool]
    hint: str


def _installed(*modules: str) -> Callable[[], bool]:
    """Look without importing: some of these are slow to import, or look at the environment."""
    return lambda: all(map(importlib.util.find_spec, modules))


def _can_build() -> bool:
    path = f"{Path(sys.prefix, 'bin')}:{os.environ.get('PATH', '')}"
    programs = ("gcc", "g++", "cmake", "ninja", "colcon")
    return all(shutil.which(name, path=path) for name in programs) and bool(
        importlib.util.find_spec("rosidl_generator_py")
    )


def _queue_port_is_free() -> bool:
    with socket.socket() as one:
        return one.connect_ex(("127.0.0.1", SKYPILOT_QUEUE_PORT)) != 0


def _commit_of(version: str) -> str:
    """Return the commit that set a version; empty where the history does not have it."""
    wanted = ["log", "--format=%H", "--reverse", f'-S__version__ = "{version}"', "--"]
    try:
        found = subprocess.run(
            ["git", *wanted, "fogft/__init__.py"],
            cwd=Path(__file__).parents[1], capture_output=True, text=True, check=False,
        )  # fmt: skip
    except FileNotFoundError:
        return ""
    return found.stdout.partition("\n")[0]


BEFORE = _commit_of("0.2.0")  # what this version has to work with
NEEDS = {
    "apriltags": Need(_installed("pupil_apriltags"), "scripts/setup demo"),
    "arm64": Need(lambda: "FOGFT_ARM64" in os.environ, "scripts/test-arm64"),
    "build": Need(_can_build, "scripts/setup ros-test, apt install g++ cmake ninja-build"),
    "boot": Need(can_boot, "root, systemd, overlays, cgroup2 and namespaces, to boot a machine"),
    "browser": Need(
        lambda: bool(shutil.which("chromedriver") and importlib.util.find_spec("selenium")),
        "scripts/setup docs, apt install chromium-driver",
    ),
    "colcon": Need(_installed("colcon_core"), "scripts/setup ros-test"),
    "cores": Need(lambda: len(os.sched_getaffinity(0)) > 1, "a second processor"),
    "cyclonedds": Need(_installed("cyclonedds"), "pip install cyclonedds"),
    "egl": Need(
        lambda: bool(ctypes.util.find_library("EGL")), "apt install libegl1 libgl1-mesa-dri"
    ),
    "etcd": Need(lambda: bool(shutil.which("etcd")), "apt install etcd-server"),
    "fastdds": Need(
        lambda: os.environ.get("RMW_IMPLEMENTATION", FAST_DDS) == FAST_DDS,
        f"RMW_IMPLEMENTATION={FAST_DDS}: it looks at what Fast DDS alone does",
    ),
    "history": Need(lambda: bool(BEFORE), "a clone with the commit that set version 0.2.0"),
    "launch": Need(_installed("launch", "launch_ros"), "a ROS 2 installation with launch_ros"),
    "litert": Need(_installed("ai_edge_litert"), "scripts/setup vision"),
    "matplotlib": Need(_installed("matplotlib"), "scripts/setup plot"),
    "mkdocs": Need(_installed("mkdocs", "material"), "scripts/setup docs"),
    "uv": Need(_installed("uv"), "scripts/test-sky --quick"),
    "moto": Need(_installed("moto", "boto3", "flask"), "scripts/test-sky --quick"),
    "mujoco": Need(_installed("mujoco"), "scripts/setup vision"),
    "namespaces": Need(can_make_namespaces, "root and `ip`, for network namespaces"),
    "night": Need(lambda: NIGHTLY, "the time that .ci/nightly takes"),
    "not-root": Need(lambda: os.geteuid() != 0, "a user whom file permissions bind"),
    "numpy": Need(_installed("numpy"), "scripts/setup demo"),
    "ompl": Need(_installed("ompl"), "scripts/setup demo"),
    "pillow": Need(_installed("PIL"), "scripts/setup demo"),
    "prometheus": Need(lambda: bool(shutil.which("prometheus")), "apt install prometheus"),
    "promtool": Need(lambda: bool(shutil.which("promtool")), "apt install prometheus"),
    "pyzeros": Need(_installed("pyzeros"), "Python 3.11 and scripts/setup ros-test"),
    "rclpy": Need(_installed("rclpy"), "scripts/setup ros, or a sourced ROS 2 installation"),
    "ros2service": Need(_installed("ros2service"), "a ROS 2 installation with ros2service"),
    "skypilot": Need(_installed("sky"), "scripts/test-sky --quick"),
    "skypilot-port": Need(_queue_port_is_free, "no other API server of SkyPilot's here"),
    "systemd": Need(lambda: bool(shutil.which("systemd-analyze")), "apt install systemd"),
    "test_msgs": Need(_installed("test_msgs"), "scripts/setup ros-test"),
    "tomllib": Need(_installed("tomllib"), "Python 3.11"),
    "torch": Need(_installed("torch", "transformers"), "scripts/setup vision"),
    "tun": Need(lambda: os.path.exists("/dev/net/tun"), "/dev/net/tun"),
    "weights": Need(
        lambda: WEIGHTS.is_dir() and bool(list(WEIGHTS.glob("*.tflite"))),
        "templates/detect/fetch_weights.py",
    ),
}


def must_run() -> set[str]:
    """Return what `FOGFT_MUST_RUN` names.

    Raises:
        UsageError: It names what no test can need.
    """
    named = set(filter(None, os.environ.get("FOGFT_MUST_RUN", "").split(",")))
    if unknown := named - set(NEEDS):
        raise pytest.UsageError(f"FOGFT_MUST_RUN: unknown: {', '.join(sorted(unknown))}")
    return named


def need(*names: str, whole_file: bool = True) -> None:
    """Leave out this test file, or this test, where something that it needs is missing."""
    for name in names:
        if NEEDS[name].is_here():
            continue
        reason = f"needs {name}: {NEEDS[name].hint}"
        if name in must_run():
            pytest.fail(f"must run here (FOGFT_MUST_RUN), and {reason}", pytrace=False)
        pytest.skip(reason, allow_module_level=whole_file)


def not_run(reports: Sequence[pytest.TestReport | pytest.CollectReport]) -> list[str]:
    """Return a line for each reason for which tests were skipped."""
    tests: Counter[str] = Counter()
    files: Counter[str] = Counter()
    for report in reports:
        assert isinstance(report.longrepr, tuple)
        reason = report.longrepr[2].removeprefix("Skipped: ")
        (tests if "::" in report.nodeid else files)[reason] += 1
    return [
        f"not run: {_counted(tests[reason], files[reason])}: {reason}"
        for reason in sorted({*tests, *files})
    ]


def _counted(tests: int, files: int) -> str:
    counts = ((tests, "test"), (files, "whole file"))
    return " and ".join(f"{n} {what}{'s' * (n > 1)}" for n, what in counts if n)


def needs(*names: str) -> pytest.MarkDecorator:
    """Mark a test, or a parameter's value, with what it needs."""
    unknown = set(names) - set(NEEDS)
    assert not unknown, f"unknown needs: {unknown}"
    return pytest.mark.needs(*names)
