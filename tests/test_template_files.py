"""Templates are found; examples are copied whole or not at all."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest

from fogft import template_files
from fogft.cloud.local.catalogue import BUILT_IN
from fogft.cloud.local.resources import offers_for
from fogft.errors import FogftError
from fogft.pool.commands import init
from fogft.poolfile import file, named_clouds
from fogft.poolfile.schema import pool_schema

EXAMPLES = ["detect", "echo", "inspection", "motion", "pick", "planner", "segment", "words"]


class TestFolder:
    def test_of_this_checkout(self):
        assert template_files.folder() == Path(__file__).parents[1] / "templates"

    def test_of_an_installed_package(self, tmp_path, monkeypatch):
        """A wheel carries the templates inside the package."""
        shutil.copytree(template_files.folder(), tmp_path / "fogft" / "templates")
        monkeypatch.setattr(template_files, "__file__", str(tmp_path / "fogft" / "x.py"))
        assert template_files.folder() == tmp_path / "fogft" / "templates"

    def test_missing(self, tmp_path, monkeypatch):
        monkeypatch.setattr(template_files, "__file__", str(tmp_path / "fogft" / "x.py"))
        with pytest.raises(FogftError, match=r"^the templates are missing") as caught:
            template_files.folder()
        assert caught.value.hint == "reinstall fogft"


def contents(folder):
    """Return every path below, with the bytes of the files."""
    return {
        p.relative_to(folder): p.read_bytes() if p.is_file() else None for p in folder.rglob("*")
    }


class TestExamples:
    def test_each_is_named_and_described(self):
        """The description is the first line of the example's pool file."""
        found = init.examples()
        assert list(found) == EXAMPLES
        assert all(re.fullmatch(r"[A-Z].{20,100}\.", line) for line in found.values())
        assert init.DEFAULT_EXAMPLE in found

    @pytest.mark.parametrize("name", EXAMPLES)
    def test_its_pool_file_is_right(self, name):
        """Each example is a valid pool of its own name, on the local cloud, in three regions."""
        folder = template_files.folder() / name
        spec = file.read(folder / "pool.yaml")
        assert spec.name == name
        assert [each["infra"] for each in spec.task["resources"]["any_of"]] == [
            "local/us-west-1",
            "local/us-west-2",
            "local/eu-central-1",
        ]
        script = re.fullmatch(r"exec python3 (\w+\.py)", spec.task["run"])
        assert (folder / script[1]).is_file()

    def test_one_starts_on_aws_as_it_is(self):
        """Within a price and a time; otherwise it is the local one's."""
        folder = template_files.folder() / "echo"
        here, there = file.read(folder / "pool.yaml"), file.read(folder / "aws.yaml")
        assert named_clouds.clouds_named(there) == ["aws"]
        assert (there.services, there.task["run"]) == (here.services, here.task["run"])
        assert there.max_hours
        assert there.max_usd_per_hour
        assert offers_for(BUILT_IN, there.task["resources"])  # for `--cloud local`

    @pytest.mark.parametrize("name", EXAMPLES)
    def test_its_nodes_know_nothing_of_fogft(self, name):
        """The nodes are ordinary ROS 2 nodes: that is the point of the example."""
        sources = list((template_files.folder() / name).glob("*.py"))
        assert sources
        for source in sources:
            assert "fogft" not in source.read_text()

    @pytest.mark.parametrize("name", EXAMPLES)
    def test_all_its_files_are_copied(self, name, tmp_path):
        target = tmp_path / "new" / "folder"
        written = init.copy_example(name, target)
        assert written[0] == target / "pool.yaml"
        assert sorted(written) == sorted(p for p in target.rglob("*") if p.is_file())
        source = template_files.folder() / name
        *copied, made = written
        assert json.loads(made.read_text()) == pool_schema()
        for path in copied:
            assert path.read_bytes() == (source / path.relative_to(target)).read_bytes()
        assert not [path for path in written if "__pycache__" in path.parts]

    def test_beside_other_files(self, tmp_path):
        (tmp_path / "mine.py").write_text("x")
        init.copy_example("echo", tmp_path)
        assert (tmp_path / "mine.py").read_text() == "x"


class TestRefusals:
    """An error changes nothing."""

    def refuse(self, tmp_path, *args, **kwargs):
        before = contents(tmp_path)
        with pytest.raises(FogftError) as caught:
            init.copy_example(*args, **kwargs)
        assert contents(tmp_path) == before
        return caught.value.message, caught.value.hint

    def test_no_such_example(self, tmp_path):
        assert self.refuse(tmp_path, "planer", tmp_path / "a") == (
            "there is no example `planer`",
            "did you mean `planner`?",
        )
        assert self.refuse(tmp_path, "xyz", tmp_path / "a")[1] == (
            "known here: `detect`, `echo`, `inspection`, `motion`, `pick`, `planner`, `segment`, "
            "`words`"
        )

    def test_a_file_is_in_the_way(self, tmp_path):
        (tmp_path / "echo_client.py").write_text("mine")
        assert self.refuse(tmp_path, "echo", tmp_path) == (
            f"`{tmp_path}/echo_client.py` exists already",
            "choose another folder with `--into DIR`, or overwrite with `--force`",
        )

    def test_a_dangling_link_is_in_the_way(self, tmp_path):
        (tmp_path / "pool.yaml").symlink_to(tmp_path / "elsewhere")
        assert "pool.yaml` exists already" in self.refuse(tmp_path, "echo", tmp_path)[0]

    @pytest.mark.parametrize("force", [False, True])
    def test_a_folder_is_in_the_way(self, tmp_path, force):
        (tmp_path / "pool.yaml").mkdir()
        assert self.refuse(tmp_path, "echo", tmp_path, force=force) == (
            f"`{tmp_path}/pool.yaml` is a folder",
            "choose another folder with `--into DIR`",
        )

    def test_the_target_is_a_file(self, tmp_path):
        (tmp_path / "a").write_text("x")
        assert self.refuse(tmp_path, "echo", tmp_path / "a") == (
            f"`{tmp_path}/a` is not a folder",
            "choose another folder with `--into DIR`",
        )
        assert self.refuse(tmp_path, "echo", tmp_path / "a" / "b")[0].endswith(
            "cannot be written: Not a directory"
        )

    def test_the_disk_is_full(self, tmp_path, monkeypatch):
        def full(*_):
            raise OSError(28, "No space left on device")  # writing names no file

        monkeypatch.setattr(Path, "write_bytes", full)
        assert self.refuse(tmp_path, "echo", tmp_path) == (
            f"`{tmp_path}` cannot be written: No space left on device",
            "choose another folder with `--into DIR`",
        )


def test_force_overwrites_what_it_brings_and_nothing_else(tmp_path):
    (tmp_path / "pool.yaml").write_text("mine")
    (tmp_path / "other.yaml").write_text("mine")
    init.copy_example("echo", tmp_path, force=True)
    assert (tmp_path / "pool.yaml").read_bytes() == (
        template_files.folder() / "echo" / "pool.yaml"
    ).read_bytes()
    assert (tmp_path / "other.yaml").read_text() == "mine"
