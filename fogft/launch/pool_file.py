"""Turn a launch file's nodes and pool into a pool file."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from fogft import template_files
from fogft.errors import FogftError

FILE_LIMIT_BYTES = 256 << 10


@dataclass(frozen=True)
class NodeCommand:
    """The command that starts a node, with all substitutions performed.

    `package` is empty when `executable` is a path or a program's name; `files` holds the contents
    of parameter files, by the argument that names each.
    """

    package: str
    executable: str
    arguments: Sequence[str] = ()
    environ: Mapping[str, str] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)


def run_text(nodes: Sequence[NodeCommand]) -> str:
    """Return the bash script that runs these nodes on a replica.

    A single node replaces the shell. With several nodes, the exit of one ends all, so that they
    are restarted together.
    """
    if not nodes:
        raise FogftError("a fog pool contains no cloud node", "move a node into it as a cloud node")
    lines: list[str] = []
    if any(node.package for node in nodes):
        lines.append(template_files.read_text("find_executable.sh"))
    names: dict[str, str] = {}
    for node in nodes:
        for path, content in node.files.items():
            if path not in names:
                names[path] = f"parameters-{len(names)}.yaml"
                lines.append(_file(names[path], path, content))
    commands = []
    for index, node in enumerate(nodes):
        if node.package:
            package, executable = shlex.quote(node.package), shlex.quote(node.executable)
            lines.append(f"node_{index}=$(find_executable {package} {executable}) || exit")
        commands.append(_command(node, index, names))
    if len(commands) == 1:
        return "\n".join([*lines, f"exec {commands[0]}"]) + "\n"
    lines += [f"{command} & nodes[{index}]=$!" for index, command in enumerate(commands)]
    return "\n".join([*lines, template_files.read_text("watch_nodes.sh")])


def _command(node: NodeCommand, index: int, names: Mapping[str, str]) -> str:
    words = [names.get(word, word) for word in node.arguments]
    first = f'"$node_{index}"' if node.package else shlex.quote(node.executable)
    environ = [shlex.quote(f"{key}={value}") for key, value in node.environ.items()]
    return " ".join([*(["env", *environ] if environ else []), first, *map(shlex.quote, words)])


def _file(name: str, path: str, content: str) -> str:
    if len(content.encode()) > FILE_LIMIT_BYTES:
        raise FogftError(
            f"the parameter file `{path}` is too large to travel with a launch file",
            "put it in the pool file's `workdir` or `file_mounts` and name it there",
        )
    end = "END_OF_PARAMETERS"
    while end in content:
        end += "_"
    newline = "" if content.endswith("\n") or not content else "\n"
    return f"cat >{name} <<'{end}'\n{content}{newline}{end}"


def pool_tree(
    base: Mapping[str, Any],
    *,
    name: str,
    run: str,
    task: Mapping[str, Any],
    fogft: Mapping[str, Any],
) -> dict[str, Any]:
    """Return a pool file's tree: a base file overridden by the launch file."""
    if base.get("run"):
        raise FogftError(
            "the pool file of a fog pool has its own `run`",
            "remove it: replicas run the cloud nodes of the launch file",
        )
    tree = {**base, **task, "run": run}
    ours = base.get("fogft")
    tree["fogft"] = {**(ours if isinstance(ours, Mapping) else {}), **fogft}
    if name:
        tree["name"] = name
    if not tree.get("name"):
        raise FogftError("a fog pool needs a name", "give it one, such as `name: perception`")
    return tree
