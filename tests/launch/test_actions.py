"""`fog_pool` and `cloud_node` in real launch files of every format."""

from __future__ import annotations

import os
import textwrap
from pathlib import Path
from typing import Any

import pytest
import yaml

from fogft.errors import FogftError
from tests.needs import need

need("launch")

import launch  # noqa: E402
from launch.launch_description_sources import (  # noqa: E402
    get_launch_description_from_any_launch_file,
)

from fogft.launch.actions import CloudNode, FogPool  # noqa: E402
from fogft.launch.run_pool import READY  # noqa: E402

PYTHON = """
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, LogInfo
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from fogft.launch import CloudNode, FogPool

def generate_launch_description():
    return LaunchDescription([
        DeclareLaunchArgument("word", default_value="ahoy"),
        FogPool(
            [
                CloudNode(
                    package="demo", executable="setter", name="setta", namespace="/arm",
                    parameters=[{"greeting": LaunchConfiguration("word")}, {"deep": {"er": 7}}],
                    remappings=[("set", "flip")], arguments=["first"],
                    additional_env={"FLAVOUR": "sour"},
                ),
                LogInfo(msg="local"),
            ],
            name="lt", replicas=3, resources={"cpus": "4+"},
            services=[{"name": "/arm/flip", "type": "std_srvs/srv/SetBool"}],
        ),
    ])
"""
XML = """
<launch>
  <arg name="word" default="ahoy"/>
  <fog_pool name="lt" replicas="3" resources="{cpus: 4+}"
            services="[{name: /arm/flip, type: std_srvs/srv/SetBool}]">
    <cloud_node pkg="demo" exec="setter" name="setta" namespace="/arm" args="first">
      <param name="greeting" value="$(var word)"/>
      <param name="deep"><param name="er" value="7"/></param>
      <remap from="set" to="flip"/>
      <env name="FLAVOUR" value="sour"/>
    </cloud_node>
    <log message="local"/>
  </fog_pool>
</launch>
"""
YAML = """
launch:
- arg: {name: word, default: ahoy}
- fog_pool:
    name: lt
    replicas: "3"
    resources: "{cpus: 4+}"
    services: "[{name: /arm/flip, type: std_srvs/srv/SetBool}]"
    children:
    - cloud_node:
        pkg: demo
        exec: setter
        name: setta
        namespace: /arm
        args: first
        param:
        - {name: greeting, value: $(var word)}
        - {name: deep, param: [{name: er, value: 7}]}
        remap: [{from: set, to: flip}]
        env: [{name: FLAVOUR, value: sour}]
    - log: {message: local}
"""


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("FOGFT_HOME", str(tmp_path / "home"))
    return tmp_path / "home"


def visited(file: Path, **configurations: str) -> list[Any]:
    """Execute a launch file's actions as launch does; return what each yields."""
    context = launch.LaunchContext()
    context.launch_configurations.update(configurations)
    found = []
    for entity in get_launch_description_from_any_launch_file(str(file)).entities:
        found += entity.visit(context) or []
    return found


@pytest.mark.parametrize(("name", "text"), [("x.py", PYTHON), ("x.xml", XML), ("x.yaml", YAML)])
def test_every_format_makes_the_same_pool_file(
    tmp_path: Path, home: Path, name: str, text: str
) -> None:
    file = tmp_path / name
    file.write_text(text)
    actions = visited(file, word="hello")
    tree = yaml.safe_load((home / "launch" / "lt.yaml").read_text())
    run = tree.pop("run")
    assert tree == {
        "name": "lt",
        "resources": {"cpus": "4+"},
        "fogft": {
            "replicas": 3,
            "services": [{"name": "/arm/flip", "type": "std_srvs/srv/SetBool"}],
        },
    }
    command = run.splitlines()[-1]
    assert command.startswith('exec env FLAVOUR=sour "$node_0" first --ros-args ')
    for words in ("__node:=setta", "__ns:=/arm", "set:=flip", "--params-file parameters-0.yaml"):
        assert words in command
    assert "greeting: hello" in run
    assert "deep.er: 7" in run
    assert [type(action).__name__ for action in actions][-1] == "ExecuteProcess"


def test_all_runs_here_when_told_so(tmp_path: Path, home: Path) -> None:
    """With `cloud:=false` the pool yields its nodes, and writes nothing."""
    file = tmp_path / "x.xml"
    file.write_text(XML)
    actions = visited(file, cloud="false")
    assert [type(action).__name__ for action in actions] == ["CloudNode", "LogInfo"]
    assert not home.exists()


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("prefix", "gdb"),
        ("env", {"A": "b"}),
        ("cwd", "/tmp"),
        ("on_exit", [launch.actions.LogInfo(msg="x")]),
    ],
)
def test_what_cannot_be_carried_is_refused_when_loaded(key: str, value: Any) -> None:
    with pytest.raises(FogftError, match=f"`{key}` is not supported"):
        CloudNode(package="demo", executable="setter", **{key: value})


def test_a_cloud_node_alone_is_refused() -> None:
    node = CloudNode(package="demo", executable="setter")
    with pytest.raises(FogftError, match="outside any fog pool"):
        node.execute(launch.LaunchContext())


def test_a_wrong_word_for_the_end_is_refused(home: Path) -> None:
    pool = FogPool([CloudNode(package="a", executable="b")], name="lt", on_exit="explode")
    with pytest.raises(FogftError, match="`on_exit` is `explode`"):
        pool.execute(launch.LaunchContext())


@pytest.mark.parametrize("setup", ["[ -d /opt/demo ]", "echo 'network: none' > /etc/x.yaml\n", "7"])
def test_commands_and_names_are_no_yaml(home: Path, setup: str) -> None:
    pool = FogPool([CloudNode(executable="/bin/true")], name="2024", setup=setup)
    pool.execute(launch.LaunchContext())
    tree = yaml.safe_load((home / "launch" / "2024.yaml").read_text())
    assert (tree["name"], tree["setup"]) == ("2024", setup)


def test_local_nodes_have_the_configurations_of_the_groups_around_the_pool(
    tmp_path: Path, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They start when the pool is ready: those groups have ended then."""
    ready = tmp_path / "ready"
    ready.write_text(f"#!/bin/sh\necho '{READY}'\n")
    ready.chmod(0o755)
    monkeypatch.setattr("fogft.launch.actions.python", lambda *words: [str(ready), *words])
    seen: list[str] = []
    look = launch.actions.OpaqueFunction(
        function=lambda then: seen.append(then.launch_configurations.get("speed", "none"))
    )
    pool = FogPool([CloudNode(executable="/bin/true"), look], name="lt")
    set_here = launch.actions.SetLaunchConfiguration("speed", "fast")
    service = launch.LaunchService()
    group = launch.actions.GroupAction([set_here, pool])
    service.include_launch_description(launch.LaunchDescription([group]))
    assert service.run() == 0
    assert seen == ["fast"]


def test_a_pool_file_supplies_the_rest(tmp_path: Path, home: Path) -> None:
    base = tmp_path / "base.yaml"
    base.write_text("workdir: ws\nfogft: {max_surge: 2}\n")
    parameters = tmp_path / "p.yaml"
    parameters.write_text("/**: {ros__parameters: {a: 1}}\n")
    node = CloudNode(package="demo", executable="setter", parameters=[str(parameters)])
    pool = FogPool([node], name="lt", file=str(base))
    pool.execute(launch.LaunchContext())
    tree = yaml.safe_load((home / "launch" / "lt.yaml").read_text())
    assert tree["workdir"] == str(tmp_path / "ws")
    assert tree["fogft"] == {"max_surge": 2}
    assert "/**: {ros__parameters: {a: 1}}" in tree["run"]


def test_conditions_and_namespaces_around_a_node_hold(tmp_path: Path, home: Path) -> None:
    file = tmp_path / "x.xml"
    file.write_text(
        textwrap.dedent("""
        <launch>
          <group>
            <push-ros-namespace namespace="robot1"/>
            <fog_pool name="lt">
              <cloud_node pkg="demo" exec="setter"/>
              <cloud_node pkg="demo" exec="never" if="false"/>
            </fog_pool>
          </group>
        </launch>""")
    )
    service = launch.LaunchService(noninteractive=True)
    description = get_launch_description_from_any_launch_file(str(file))
    context = service.context
    pending = list(description.entities)
    while pending:  # breadth of a group is enough here: no events are waited for
        entity = pending.pop(0)
        if type(entity).__name__ == "ExecuteProcess":
            continue
        pending = [*(entity.visit(context) or []), *pending]
    run = yaml.safe_load((home / "launch" / "lt.yaml").read_text())["run"]
    assert "__ns:=/robot1" in run
    assert "never" not in run


def test_the_real_launch_runs_a_pool_from_begin_to_end(tmp_path: Path) -> None:
    """`ros2 launch`'s own service: the pool comes up, a local node is answered, all ends."""
    import subprocess
    import sys

    package = tmp_path / "prefix"
    for name, text in (("setter", SETTER), ("caller", CALLER)):
        file = package / "lib" / "demo" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f"#!{sys.executable}\n{text}")
        file.chmod(0o755)
    marker = package / "share" / "ament_index" / "resource_index" / "packages" / "demo"
    marker.parent.mkdir(parents=True)
    marker.touch()
    file = tmp_path / "x.xml"
    local = '<node pkg="demo" exec="caller" output="screen" on_exit="shutdown"/>'
    file.write_text(
        XML.replace('<log message="local"/>', local)
        .replace('replicas="3"', 'replicas="1" on_exit="down"')
        .replace('resources="{cpus: 4+}"', "")
    )
    environ = {
        **os.environ,
        "FOGFT_HOME": str(tmp_path / "home"),
        "AMENT_PREFIX_PATH": f"{package}:{os.environ.get('AMENT_PREFIX_PATH', '')}",
        "ROS_LOG_DIR": str(tmp_path / "log"),
    }
    program = (
        "import sys, fogft.launch.actions, launch\n"
        "from launch.launch_description_sources import "
        "get_launch_description_from_any_launch_file as load\n"
        "service = launch.LaunchService(argv=[])\n"
        "service.include_launch_description(load(sys.argv[1]))\n"
        "sys.exit(service.run())\n"
    )
    shown = subprocess.run(
        [sys.executable, "-c", program, str(file)],
        env=environ, capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip
    said = shown.stdout + shown.stderr
    assert "ANSWER ahoy 7 sour /arm/setta" in said
    assert "done: `lt` is shut down; nothing is left" in said
    assert said.index(READY) < said.index("ANSWER")
    assert not (tmp_path / "home" / "pools" / "lt").exists()


SETTER = """
import os, sys, rclpy
from std_srvs.srv import SetBool
rclpy.init(args=sys.argv)
node = rclpy.create_node("setter")
node.declare_parameter("greeting", "hi")
node.declare_parameter("deep.er", 0)
def answer(_, response):
    values = [node.get_parameter(name).value for name in ("greeting", "deep.er")]
    words = [*values, os.environ.get("FLAVOUR"), node.get_fully_qualified_name()]
    response.message = " ".join(map(str, words))
    return response
node.create_service(SetBool, "set", answer)
rclpy.spin(node)
"""
CALLER = """
import sys, rclpy
from std_srvs.srv import SetBool
rclpy.init(args=sys.argv)
node = rclpy.create_node("caller")
client = node.create_client(SetBool, "/arm/flip")
assert client.wait_for_service(30)
future = client.call_async(SetBool.Request(data=True))
rclpy.spin_until_future_complete(node, future, timeout_sec=20)
print("ANSWER", future.result().message, flush=True)
"""
