"""The entry points, without ROS 2's launch and ros2cli: each names something that is there."""

from __future__ import annotations

import ast
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.needs import need, needs

ROOT = Path(__file__).parents[2]
AMENT = ROOT / "fogft" / "launch" / "ament"
GROUPS = ("ros2cli.command", "ros2cli.extension_point", "launch.frontend.launch_extension")


def project() -> dict:
    need("tomllib", whole_file=False)
    import tomllib

    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.mark.parametrize("group", GROUPS)
def test_each_names_a_module_and_a_class_that_exist(group: str) -> None:
    for target in project()["entry-points"][group].values():
        module, _, name = target.partition(":")
        tree = ast.parse((ROOT / f"{module.replace('.', '/')}.py").read_text())
        classes = {node.name for node in tree.body if isinstance(node, ast.ClassDef)}
        assert not name or name in classes


def test_every_verb_is_a_command_of_fogft() -> None:
    import typer

    from fogft.cli import main

    commands = typer.main.get_command(main.app).commands
    verbs = project()["entry-points"]["fogft.ros2_verb"]
    assert set(verbs) <= set(commands)
    for verb, target in verbs.items():
        assert target == f"fogft.cli.ros2:{verb.capitalize()}"


def test_both_packages_have_one_version() -> None:
    assert f"<version>{project()['version']}</version>" in (AMENT / "package.xml").read_text()


def test_loading_fogft_launch_needs_no_ros() -> None:
    words = "import sys, fogft.launch; print('launch' in sys.modules, 'yaml' in sys.modules)"
    shown = subprocess.run(
        [sys.executable, "-c", words], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert shown.stdout == "False False\n"


@needs("colcon")
def test_colcon_builds_what_pip_installs(tmp_path: Path) -> None:
    """The workspace's package has the entry points, the templates and every module."""
    wanted = project()
    source = tmp_path / "src" / "fogft"
    source.mkdir(parents=True)
    for name in ("fogft", "templates"):
        ignored = shutil.ignore_patterns("__pycache__", "build", "install", "log")
        shutil.copytree(ROOT / name, source / name, ignore=ignored)
    shutil.copy(ROOT / "pyproject.toml", source)
    colcon = Path(sys.executable).with_name("colcon")
    built = subprocess.run(
        [str(colcon), "--log-base", "log", "build", "--packages-select", "fogft"],
        cwd=tmp_path, capture_output=True, text=True, check=False, timeout=100,
    )  # fmt: skip
    assert built.returncode == 0, built.stdout + built.stderr
    installed = tmp_path / "install" / "fogft"
    assert (installed / "share/ament_index/resource_index/packages/fogft").exists()
    assert (installed / "bin" / "fogft").exists()
    site = next(installed.glob("lib/python*/site-packages"))
    for name, root in (("*.py", ROOT / "fogft"), ("*.yaml", ROOT / "templates")):
        where = site / "fogft" / ("templates" if name == "*.yaml" else "")
        there = {path.relative_to(where) for path in where.rglob(name)}
        here = {p.relative_to(root) for p in root.rglob(name) if "ament" not in p.parts}
        assert here <= there
    text = next(site.glob("*/entry_points.txt")).read_text()
    for group, entries in {"console_scripts": wanted["scripts"], **wanted["entry-points"]}.items():
        assert f"[{group}]" in text
        assert all(f"{name} = {target}" in text for name, target in entries.items())
