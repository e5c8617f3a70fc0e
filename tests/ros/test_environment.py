"""What is set for ROS processes, what is left alone, and what is reported."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import pytest

from fogft.ros import environment
from tests.needs import needs


def test_the_profile_is_chosen_where_nothing_is_set() -> None:
    environ = {"PATH": "/bin"}
    assert environment.prepare(environ)
    assert environ == {
        "PATH": "/bin",
        environment.profile_variable(): str(environment.profile_path()),
    }
    assert not environment.prepare(environ)


@pytest.mark.parametrize(
    "name",
    [
        "FASTDDS_DEFAULT_PROFILES_FILE",
        "FASTRTPS_DEFAULT_PROFILES_FILE",
        "FASTDDS_BUILTIN_TRANSPORTS",
    ],
)
def test_the_users_choice_stands(name: str) -> None:
    """Any variable that chooses transports keeps ours out."""
    environ = {name: "theirs"}
    assert not environment.prepare(environ)
    assert environ == {name: "theirs"}


@pytest.mark.parametrize(
    ("libraries", "variable"),
    [
        (["libfastdds.so", "libfastcdr.so"], "FASTDDS_DEFAULT_PROFILES_FILE"),
        (["libfastrtps.so", "libfastcdr.so"], "FASTRTPS_DEFAULT_PROFILES_FILE"),
        (["x86_64-linux-gnu/libfastrtps.so"], "FASTRTPS_DEFAULT_PROFILES_FILE"),
    ],
)
def test_the_profile_goes_to_the_variable_that_the_sourced_fast_dds_reads(
    tmp_path: Path, libraries: list[str], variable: str
) -> None:
    """Fast DDS 2 (Jazzy) and 3 (Kilted) read different ones, and each ignores the other's."""
    overlay, sourced = tmp_path / "overlay", tmp_path / "ros"
    for library in libraries:
        (sourced / "lib" / library).parent.mkdir(parents=True, exist_ok=True)
        (sourced / "lib" / library).touch()
    environ = {"AMENT_PREFIX_PATH": f"{overlay}:{sourced}"}
    assert environment.prepare(environ)
    assert environ[variable] == str(environment.profile_path())
    assert len(environ) == 2


@pytest.mark.ros
@needs("fastdds")
@pytest.mark.parametrize("prepared", [True, False])
def test_a_node_maps_a_segment_as_large_as_its_profile_says(
    prepared: bool, ros_domains: Callable[[], int]
) -> None:
    """What is in force is seen in the memory of a process, whatever its variables say."""
    program = (
        "import json, os; from fogft.ros import environment, self_test\n"
        f"{'environment.prepare(os.environ)' if prepared else ''}\n"
        "print(json.dumps(self_test.segment()))\n"
    )
    clean = {k: v for k, v in os.environ.items() if not k.endswith("_DEFAULT_PROFILES_FILE")}

    def mapped() -> int:
        clean["ROS_DOMAIN_ID"] = str(ros_domains())
        out = subprocess.run(
            [sys.executable, "-c", program], env=clean, capture_output=True, check=True, timeout=100
        )
        return int(json.loads(out.stdout.splitlines()[-1])["segment_bytes"])

    if prepared:
        assert mapped() >= environment.PROFILE_SEGMENT_BYTES
    else:  # it also maps those of whom it hears, and a process may just be leaving its domain
        assert any(0 < mapped() < environment.PROFILE_SEGMENT_BYTES for _ in range(3))


def test_a_profile_in_the_working_folder_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fast DDS reads such a file only where no variable names another: so none is set."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "DEFAULT_FASTDDS_PROFILES.xml").touch()
    environ: dict[str, str] = {}
    assert not environment.prepare(environ)
    assert environ == {}


def test_small_shared_memory_keeps_the_profile_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a container with 64 MB of /dev/shm, segments of 35 MB would only fail."""
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=64_000_000))
    assert not environment.prepare({})


def test_the_profile_has_both_transports() -> None:
    """Shared memory for speed, and UDP, without which no node without the profile is reached."""
    space = "{http://www.eprosima.com}"
    root = ElementTree.parse(environment.profile_path()).getroot()
    kinds = [each.text for each in root.iter(f"{space}type")]
    used = [each.text for each in root.find(f".//{space}userTransports") or ()]
    named = [each.text for each in root.iter(f"{space}transport_id")]
    assert sorted(kinds) == ["SHM", "UDPv4"]
    assert len(used) == 2
    assert set(used) <= set(named)
    assert int(root.findtext(f".//{space}port_queue_capacity", "512")) > 1000  # a burst


def test_a_child_gets_rid_of_the_wheels_hook() -> None:
    """The guard and the wheels' folders go; the user's own folders stay, in order."""
    ours = Path(sys.prefix, "lib")
    wheels = ours / "python3.11" / "site-packages" / "ros_rclpy.libs"
    environ = {
        "_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1",
        "LD_LIBRARY_PATH": os.pathsep.join(["/opt/a", str(ours), "/opt/b", str(wheels)]),
        "ROS_DOMAIN_ID": "7",
    }
    child = environment.child_environment(environ)
    assert child == {"LD_LIBRARY_PATH": "/opt/a:/opt/b", "ROS_DOMAIN_ID": "7"}
    assert "_ROS_WHEELS_BOOTSTRAP_COMPLETE" in environ


def test_a_child_without_the_wheels_keeps_all() -> None:
    """Of a sourced installation nothing is taken away."""
    environ = {"LD_LIBRARY_PATH": f"{sys.prefix}/lib:/opt/ros/kilted/lib", "A": "b"}
    assert environment.child_environment(environ) == environ
    only = {"_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1", "LD_LIBRARY_PATH": f"{sys.prefix}/lib"}
    assert environment.child_environment(only) == {}


@pytest.mark.ros
def test_a_child_in_this_environment_can_use_ros() -> None:
    """What was undone, the child's own start-up does again."""
    subprocess.run(
        [sys.executable, "-c", "import rclpy.impl.implementation_singleton"],
        env=environment.child_environment(),
        check=True,
        timeout=100,
    )


@pytest.mark.ros
def test_describe_tells_what_is_there() -> None:
    found = environment.describe({})
    assert found["rmw"].startswith("rmw_")
    assert found["distribution"] != "unknown"
    assert all(isinstance(value, str) and value for value in found.values())
