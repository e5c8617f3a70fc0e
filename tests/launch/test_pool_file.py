"""What a launch file says of its nodes, as a replica's shell reads it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from fogft.errors import FogftError
from fogft.launch.pool_file import FILE_LIMIT_BYTES, NodeCommand, pool_tree, run_text

SHOW = "import json, os, sys; print(json.dumps([sys.argv[1:], dict(os.environ)]))"
WORD = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=20)


def prefix_with(folder: Path, script: str = f"#!{sys.executable}\n{SHOW}\n") -> dict[str, str]:
    """Install an executable `show` of package `tools`; return the environment that finds it."""
    file = folder / "lib" / "tools" / "show"
    file.parent.mkdir(parents=True)
    file.write_text(script)
    file.chmod(0o755)
    return {"PATH": os.environ["PATH"], "AMENT_PREFIX_PATH": f"/nowhere:{folder}"}


def bash(text: str, folder: Path, environ: dict[str, str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["bash", "-c", text], cwd=folder, env=environ, capture_output=True, text=True, timeout=100,
        check=False,
    )  # fmt: skip


@given(st.lists(WORD, max_size=4), st.dictionaries(st.from_regex(r"\A[A-Z]{1,8}\Z"), WORD))
def test_every_word_arrives_as_it_was_written(words: list[str], environ: dict[str, str]) -> None:
    """Quotes, newlines, dollars and blanks mean nothing to the shell."""
    environ.pop("PATH", None)
    node = NodeCommand("", sys.executable, ("-c", SHOW, *words), environ)
    shown = subprocess.run(
        ["bash", "-c", run_text([node])], capture_output=True, check=True, timeout=100
    ).stdout
    arguments, seen = json.loads(shown)
    assert arguments == words
    assert environ.items() <= seen.items()


def test_an_executable_is_found_in_its_package(tmp_path: Path) -> None:
    environ = prefix_with(tmp_path)
    node = NodeCommand("tools", "show", ("a b", "--ros-args", "-r", "x:=y"), {"FLAVOUR": "sour"})
    shown = bash(run_text([node]), tmp_path, environ)
    arguments, seen = json.loads(shown.stdout)
    assert arguments == ["a b", "--ros-args", "-r", "x:=y"]
    assert seen["FLAVOUR"] == "sour"


def test_a_missing_executable_is_named_with_what_to_do(tmp_path: Path) -> None:
    environ = prefix_with(tmp_path)
    shown = bash(run_text([NodeCommand("tools", "gone")]), tmp_path, environ)
    assert shown.returncode == 127
    assert "package `tools` has no executable `gone` here" in shown.stderr
    assert "`setup`" in shown.stderr


def test_parameter_files_travel_whole(tmp_path: Path) -> None:
    """Also one that holds the mark that would end it, and one named twice."""
    content = "a: 1\nEND_OF_PARAMETERS\n$HOME `x`\n"
    arguments = ("--params-file", "/robot/p.yaml", "--params-file", "/robot/p.yaml")
    node = NodeCommand("", "cat", ("parameters-0.yaml",), files={"/robot/p.yaml": content})
    assert bash(run_text([node]), tmp_path, {"PATH": os.environ["PATH"]}).stdout == content
    named = run_text([NodeCommand("", "x", arguments, files={"/robot/p.yaml": content})])
    assert named.count("--params-file parameters-0.yaml") == 2
    assert "/robot/p.yaml" not in named


def test_a_file_too_large_is_refused() -> None:
    files = {"/robot/p.yaml": "x" * (FILE_LIMIT_BYTES + 1)}
    with pytest.raises(FogftError, match=r"/robot/p.yaml.*too large"):
        run_text([NodeCommand("", "x", files=files)])


def test_of_several_nodes_the_end_of_one_ends_all(tmp_path: Path) -> None:
    script = "#!/bin/bash\ntrap 'echo ended >>trace; exit' TERM\n"
    script += "if [ $1 = long ]; then touch begun; while :; do sleep 0.05; done; fi\n"
    script += "until [ -e begun ]; do sleep 0.05; done; exit 7\n"
    environ = prefix_with(tmp_path, script)
    nodes = [NodeCommand("tools", "show", ("long",)), NodeCommand("tools", "show", ("short",))]
    assert bash(run_text(nodes), tmp_path, environ).returncode == 7
    assert (tmp_path / "trace").read_text() == "ended\n"


def test_the_launch_file_is_laid_over_the_pool_file() -> None:
    base = yaml.safe_load("name: a\nsetup: make\nfogft: {replicas: 3, max_surge: 2}")
    tree = pool_tree(base, name="b", run="go", task={"setup": "cmake"}, fogft={"replicas": 4})
    assert tree == {
        "name": "b",
        "setup": "cmake",
        "run": "go",
        "fogft": {"replicas": 4, "max_surge": 2},
    }


@pytest.mark.parametrize(
    ("base", "name", "message"),
    [({"run": "x"}, "a", "its own `run`"), ({}, "", "needs a name")],
)
def test_what_makes_no_pool_is_refused(base: dict[str, str], name: str, message: str) -> None:
    with pytest.raises(FogftError, match=message):
        pool_tree(base, name=name, run="go", task={}, fogft={})


def test_a_pool_without_a_cloud_node_is_refused() -> None:
    with pytest.raises(FogftError, match="no cloud node"):
        run_text([])
