"""The launch actions `fog_pool` and `cloud_node`, for ROS 2's launch files in any format.

``cloud:=false`` on the command line of ``ros2 launch`` runs everything on this machine;
``cloud:=NAME`` selects a cloud.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from launch import Action, LaunchContext
from launch.actions import (
    EmitEvent,
    ExecuteProcess,
    OpaqueFunction,
    PopLaunchConfigurations,
    PushLaunchConfigurations,
    RegisterEventHandler,
)
from launch.event_handlers import OnProcessExit, OnProcessIO
from launch.events import Shutdown
from launch.frontend import Entity, Parser, expose_action
from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions
from launch_ros.actions import Node

from fogft.child import python
from fogft.disk import make_folder, write_whole
from fogft.errors import FogftError
from fogft.launch.pool_file import NodeCommand, pool_tree, run_text
from fogft.launch.run_pool import READY
from fogft.pool.folder.paths import home
from fogft.pool.manager.configuration import absolute

_END_LIMIT_S = 900  # how long launch waits for `fogft down` before it kills it
# Arguments that do not work for a node on another machine, and what to do instead.
_NOT_CARRIED = {
    "prefix": "a debugger or wrapper runs on the replica; put it into the pool file's `run`",
    "env": "a replica has its own environment; use `additional_env` to add to it",
    "cwd": "a replica works in the pool file's `workdir`",
    "on_exit": "a replica restarts its own nodes",
    "shell": "write the pool file's `run` instead",
    "log_cmd": "`fogft logs` shows the commands of replicas",
}
_TEXTS = ("name", "file", "setup", "workdir", "cloud", "on_exit")
_POOL_KEYS = (*_TEXTS, "replicas", "resources", "services", "fogft", "timeout")


@expose_action("cloud_node")
class CloudNode(Node):  # type: ignore[misc]
    """A node that runs on every replica of the fog pool that contains it.

    Takes the arguments of `launch_ros.actions.Node`, and raises FogftError for those that do not
    work on another machine. `output` and `respawn` have no effect: replicas' logs are always shown
    and their nodes always restarted.
    """

    def __init__(self, **arguments: Any) -> None:
        for key, instead in _NOT_CARRIED.items():
            if arguments.get(key):
                what = arguments.get("executable", "?")
                raise FogftError(f"cloud node `{what}`: `{key}` is not supported", instead)
        self._is_path = not arguments.get("package")
        super().__init__(**arguments)

    def command(self, context: LaunchContext) -> NodeCommand:
        """Return the command that starts the node, with all substitutions performed."""
        self._perform_substitutions(context)
        name, namespace = self.node_name.rpartition("/")[2], self.expanded_node_namespace
        specific = {"name": f"__node:={name}"} if "unspecified" not in name else {}
        if namespace and "unspecified" not in namespace:
            specific["ns"] = f"__ns:={namespace}"
        context.extend_locals({"ros_specific_arguments": specific})
        words = [_text(context, word) for word in self.cmd[1:]]
        environ = {
            _text(context, key): _text(context, value) for key, value in self.additional_env or ()
        }
        files = {
            path: _text_of(path)
            for option, path in itertools.pairwise(words)
            if option == "--params-file"
        }
        first = self.cmd[0] if self._is_path else self.node_executable
        return NodeCommand(
            "" if self._is_path else _text(context, self.node_package),
            _text(context, first),
            tuple(words),
            environ,
            files,
        )

    def execute(self, context: LaunchContext) -> Any:
        """Run the node on this machine, if its pool does not go to the cloud (``cloud:=false``)."""
        if _cloud(context) != "false":
            raise FogftError(
                "a cloud node is outside any fog pool", "put it into a `FogPool` (`fog_pool`)"
            )
        return super().execute(context)


@expose_action("fog_pool")
class FogPool(Action):  # type: ignore[misc]
    """A pool whose replicas run its cloud nodes; its other actions start once these answer.

    Strings may be substitutions; lists and mappings may be given as YAML text.

    Args:
        actions: Cloud nodes, and actions that start on this machine once their services answer.
        file: A pool file without `run` that supplies the rest.
        services: As in a pool file; default: those that the nodes offer.
        setup: Shell commands that prepare a replica.
        workdir: A folder that is copied to the replicas.
        fogft: More keys of the pool file's `fogft` section.
        cloud: The cloud to use; default: the one that `resources` names, else this machine.
        on_exit: ``leave`` the pool running when the launch ends, or take it ``down``.
        timeout: Seconds to wait for the services.
    """

    def __init__(self, actions: Iterable[Action] = (), **arguments: Any) -> None:
        self._actions = list(actions)
        self._given = {key: arguments.pop(key, "") for key in _POOL_KEYS}
        super().__init__(**arguments)

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> tuple[type[FogPool], dict[str, Any]]:
        """Parse the action from an XML or YAML launch file."""
        _, arguments = super().parse(entity, parser)
        for key in _POOL_KEYS:
            value = entity.get_attr(key, optional=True)
            if value is not None:
                arguments[key] = parser.parse_substitution(value)
        arguments["actions"] = [parser.parse_action(child) for child in entity.children]
        return cls, arguments

    def execute(self, context: LaunchContext) -> list[Action]:
        """Write the pool file, run the pool, and start the local actions when it answers."""
        cloud = _cloud(context)
        if cloud == "false":
            return self._actions
        asked = {
            key: (_text if key in _TEXTS else _evaluated)(context, value)
            for key, value in self._given.items()
        }
        if asked["on_exit"] not in ("", "leave", "down"):
            raise FogftError(
                f"fog pool: `on_exit` is `{asked['on_exit']}`", "write `leave` or `down`"
            )
        nodes = [action for action in self._actions if isinstance(action, CloudNode)]
        local = [action for action in self._actions if not isinstance(action, CloudNode)]
        chosen = [n for n in nodes if n.condition is None or n.condition.evaluate(context)]
        tree = _tree(asked, [node.command(context) for node in chosen])
        cloud = asked["cloud"] if cloud in ("", "true") else cloud
        scope = dict(context.launch_configurations)  # of enclosing groups, which end earlier
        enter = OpaqueFunction(function=lambda later: later.launch_configurations.update(scope))
        local = [PushLaunchConfigurations(), enter, *local, PopLaunchConfigurations()]
        return _running(_written(tree), tree["name"], asked, cloud, local)


def _tree(asked: Mapping[str, Any], nodes: Sequence[NodeCommand]) -> dict[str, Any]:
    base: Any = {}
    if asked["file"]:
        file = Path(asked["file"]).resolve()
        base = yaml.safe_load(_text_of(str(file)))
        if not isinstance(base, dict):
            raise FogftError(f"`{file}` is not a pool file", "see `fogft init`")
        base = absolute(base, file.parent)
    given = {key: asked[key] for key in ("resources", "setup", "workdir") if asked[key]}
    task = absolute(given, Path())
    ours = dict(asked["fogft"] or {})
    ours |= {key: asked[key] for key in ("replicas", "services") if asked[key]}
    return pool_tree(base, name=asked["name"], run=run_text(nodes), task=task, fogft=ours)


def _written(tree: Mapping[str, Any]) -> Path:
    folder = home() / "launch"
    make_folder(folder)
    path = folder / f"{tree['name']}.yaml"
    write_whole(path, yaml.dump(dict(tree), Dumper=_Blocks, sort_keys=False))
    return path


class _Blocks(yaml.SafeDumper):
    """A separate dumper, because PyYAML's is shared with the rest of the launch."""

    def represent_str(self, text: str) -> yaml.ScalarNode:
        style = "|" if "\n" in text else None
        return self.represent_scalar("tag:yaml.org,2002:str", text, style=style)


_Blocks.add_representer(str, _Blocks.represent_str)


def _running(
    file: Path, name: str, asked: Mapping[str, Any], cloud: str, local: Sequence[Action]
) -> list[Action]:
    words = python("-m", "fogft.launch.run_pool", str(file), "--pool", name)
    words += ["--cloud", cloud] if cloud else []
    words += ["--timeout", str(asked["timeout"])] if asked["timeout"] else []
    words += ["--down"] if asked["on_exit"] == "down" else []
    process = ExecuteProcess(
        cmd=words,
        name=f"fog_{name}",
        output="screen",
        sigterm_timeout=str(_END_LIMIT_S),
        sigkill_timeout=str(_END_LIMIT_S),
    )
    waiting = list(local)

    def heard(event: Any) -> list[Action]:
        if READY.encode() not in event.text:
            return []
        begun, waiting[:] = list(waiting), []
        return begun

    def ended(event: Any, _context: LaunchContext) -> list[Action]:
        if event.returncode == 0:
            return []
        return [EmitEvent(event=Shutdown(reason=f"the fog pool `{name}` did not start"))]

    return [
        RegisterEventHandler(OnProcessIO(target_action=process, on_stdout=heard)),
        RegisterEventHandler(OnProcessExit(target_action=process, on_exit=ended)),
        process,
    ]


def _cloud(context: LaunchContext) -> str:
    return str(context.launch_configurations.get("cloud", "")).lower()


def _evaluated(context: LaunchContext, value: Any) -> Any:
    """Perform a value's substitutions, and parse YAML text."""
    if isinstance(value, (int, float, Mapping)):
        return value
    if isinstance(value, (list, tuple)) and any(isinstance(item, Mapping) for item in value):
        return list(value)
    text = _text(context, value)
    if "\n" not in text and text[:1] not in ("{", "["):
        return int(text) if text.isdecimal() else text
    try:
        found = yaml.safe_load(text)
    except yaml.YAMLError:
        return text
    return found if isinstance(found, (dict, list)) else text


def _text(context: LaunchContext, value: Any) -> str:
    return str(perform_substitutions(context, normalize_to_list_of_substitutions(value)))


def _text_of(path: str) -> str:
    try:
        return Path(path).read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise FogftError(f"`{path}` cannot be read: {error}") from error
