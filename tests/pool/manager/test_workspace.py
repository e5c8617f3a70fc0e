"""A workspace is built where nothing else is said; anything else is left as it is."""

from __future__ import annotations

import pytest

from fogft import template_files
from fogft.pool.manager import configuration


@pytest.fixture
def folder(tmp_path):
    package = tmp_path / "src" / "group" / "my_interfaces"
    package.mkdir(parents=True)
    (package / "package.xml").write_text("<package/>")
    return tmp_path


def test_a_workspace_without_setup_is_built(folder):
    task = {"workdir": str(folder), "run": "x"}
    script = (template_files.folder() / "workspace.sh").read_text()
    assert configuration.with_build(task) == {**task, "setup": script}


@pytest.mark.parametrize("more", [{"setup": "mine"}, {"workdir": "git://a/b"}, {"workdir": None}])
def test_what_the_file_says_is_left_alone(folder, more):
    task = {"workdir": str(folder), **more}
    assert configuration.with_build(task) == task


def test_a_folder_without_packages_needs_no_build(tmp_path):
    (tmp_path / "src").mkdir()
    task = {"workdir": str(tmp_path)}
    assert configuration.with_build(task) == task
