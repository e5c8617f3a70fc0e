"""``fogft check``: each mistake, what to do about it, and an exit status."""

from __future__ import annotations

import json
from pathlib import Path

from fogft.cli import main

TEMPLATES = Path(__file__).parents[2] / "templates"
BAD = """\
name: planner
run: x
resources: {infra: lokal}
fogft:
  replcas: 2
  services: [{name: /a, type: std_srvs/srv/SetBool, timeout_s: 0}]
"""


def test_all_mistakes_are_shown_with_what_to_do(tmp_path, capsys):
    file = tmp_path / "pool.yaml"
    file.write_text(BAD)
    assert main.run(["check", str(file)]) == 1
    said = capsys.readouterr()
    first, hint, second, _ = said.out.splitlines()
    assert (first, hint) == (
        f"{file}:5: fogft.replcas: unknown key",
        "    did you mean `replicas`?",
    )
    assert second.startswith(f"{file}:6: fogft.services[0].timeout_s: must be above 0")
    assert said.err == f"\n2 mistakes in `{file}`\n"
    assert main.run(["check", str(file), "--json"]) == 1
    assert [one["line"] for one in json.loads(capsys.readouterr().out)] == [5, 6]


def test_a_cloud_that_there_is_not_is_a_mistake_too(tmp_path, capsys):
    file = tmp_path / "pool.yaml"
    file.write_text(BAD.replace("replcas", "replicas").replace("timeout_s: 0", "timeout_s: 1"))
    assert main.run(["check", str(file)]) == 1
    assert f"{file}:3: resources.infra: there is no cloud `lokal`" in capsys.readouterr().out


def test_an_example_is_right(capsys):
    assert main.run(["check", str(TEMPLATES / "echo" / "pool.yaml")]) == 0
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.endswith("is valid\n")


def test_what_is_no_yaml_is_one_mistake(tmp_path, capsys):
    file = tmp_path / "pool.yaml"
    file.write_text("a: [")
    assert main.run(["check", str(file)]) == 1
    assert "not YAML" in capsys.readouterr().out
    assert main.run(["check", str(tmp_path / "none.yaml")]) == 1
    assert "no such file" in capsys.readouterr().out
