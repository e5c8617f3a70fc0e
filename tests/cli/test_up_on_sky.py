"""``fogft up`` on real clouds: what is told, tested and asked before money is spent."""

from __future__ import annotations

import io
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from fogft.cli import main, progress
from fogft.cloud.sky import adapter as sky
from fogft.errors import CloudUnreachable
from fogft.pool.commands import startup
from fogft.pool.commands.status import Seen
from tests.cli.test_up import UP
from tests.fakes.pools import SPEC, lay_down
from tests.sky.scene import Scene

POOL = SPEC + "resources: {infra: aws, use_spot: true}\n"


class Terminal(io.StringIO):
    """Standard input with somebody at it."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A pool file for AWS."""
    path = tmp_path / "pool.yaml"
    path.write_text(POOL)
    return path


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Scene:
    """The scripted SkyPilot in place of the installed one."""
    scene = Scene(tmp_path / "sky")
    scene.now = time.time()
    scene.provider.prices = {("us-east-1a", "m6i.large"): 0.019}
    monkeypatch.setattr(sky, "make", lambda folder: scene.cloud)
    return scene


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """What `up` has started; the pool answers at once."""
    started: list[object] = []
    monkeypatch.setattr(startup, "start", lambda order: bool(started.append(order)) or True)
    seen = Seen(replace(UP, cloud="sky"), 0.1, True)
    monkeypatch.setattr("fogft.pool.commands.status.read", lambda *_: seen)
    monkeypatch.setattr(progress, "LOOK_EVERY_S", 0.0)
    return started


def answer(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setattr("sys.stdin", Terminal(text))


def test_a_file_that_names_clouds_is_for_sky_and_its_prices_are_told(scene, file, started, capsys):
    assert main.run(["up", str(file), "--yes"]) == 0
    said = capsys.readouterr().err.splitlines()
    assert said.pop(1) == "measuring round trips to 2 regions"
    assert said[:3] == [
        "asking SkyPilot for usable clouds and prices",
        "`aws` can be used",
        "pool `planner`: 3 replicas on `sky`",
    ]
    assert said[3].startswith("  0  aws/us-east-1/us-east-1a  m6i.large  $0.0")
    assert "live, " in said[3]
    assert said[6].startswith("  total $0.1")
    assert len(started) == 1
    assert started[0].cloud == "sky"


def test_a_gateway_to_be_launched_is_shown_with_its_price(scene, file, started, capsys):
    """As SkyPilot sells it on demand, with the ports of a pool: no key that a file may not have."""
    file.write_text(SPEC + "  gateway: {launch: true}\nresources: {any_of: [{infra: aws}]}\n")
    assert main.run(["up", str(file), "--yes"]) == 0
    said = capsys.readouterr().err.splitlines()
    (row,) = [line for line in said if line.startswith("  gateway  ")]
    assert "aws/us-east-1/us-east-1a  m6i.large  $0.0" in row
    assert scene.sky.asked_for["use_spot"] is False
    assert scene.sky.asked_for["ports"] == [7448]


def test_a_plan_of_all_says_which_clouds_can_run_such_a_pool(scene, file, capsys):
    assert main.run(["plan", str(file), "--all"]) == 0
    shown = [line.split(maxsplit=2) for line in capsys.readouterr().out.splitlines()]
    assert shown.index(["CLOUD", "FITS", "WHY NOT"]) > 0
    assert ["aws", "yes"] in shown
    assert ["lambda", "no", "no spot machines"] in shown


def test_nothing_is_started_unasked(scene, file, started, monkeypatch, capsys):
    """No word from anybody is a no."""
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n"))
    assert main.run(["up", str(file)]) == 1
    assert capsys.readouterr().err.endswith(
        "error: cannot ask for confirmation: there is no terminal\n\nhint: add "
        "`--yes` to skip the confirmation\n"
    )
    assert started == []


@pytest.mark.parametrize(("text", "goes_on"), [("y\n", True), ("yes\n", True), ("", False),
                                               ("n\n", False), ("sure\n", False)])  # fmt: skip
def test_a_person_is_asked(scene, file, started, monkeypatch, capsys, text, goes_on):
    answer(monkeypatch, text)
    assert main.run(["up", str(file)]) == (0 if goes_on else 1)
    said = capsys.readouterr().err
    assert "launch 3 machines at these prices? [y/N] " in said
    assert ("aborted: nothing was changed" in said) is not goes_on
    assert bool(started) is goes_on


def test_a_pool_that_stays_as_it_is_asks_nothing(home, scene, file, started, monkeypatch):
    """`up` gives a pool its manager back: what runs was agreed to."""
    paths = lay_down(home, file=file, cloud="sky")
    paths.spec.write_text(POOL)
    monkeypatch.setattr("sys.stdin", io.StringIO())
    assert main.run(["up", str(file)]) == 0
    assert len(started) == 1
    file.write_text(POOL.replace("replicas: 3", "replicas: 4"))
    assert main.run(["up", str(file)]) == 1
    assert len(started) == 1


def test_clouds_that_do_not_work_are_told_with_what_to_do(scene, file, started, capsys):
    file.write_text(SPEC + "resources: {any_of: [{infra: aws}, {infra: gcp}]}\n")
    scene.sky.credentials = {"aws": "", "gcp": "no key. Run `gcloud auth login`"}
    assert main.run(["up", str(file), "--yes"]) == 0
    said = capsys.readouterr().err
    assert "`gcp` cannot be used: no key. Run `gcloud auth login`\n" in said
    assert len(started) == 1


def test_with_no_cloud_that_works_nothing_is_begun(home, scene, file, started, capsys):
    scene.sky.credentials = {"aws": "the key has expired"}
    assert main.run(["up", str(file), "--yes"]) == 1
    said = capsys.readouterr().err
    assert "error: no cloud can be used with the credentials on this machine\n" in said
    assert "  `aws`: the key has expired\n" in said
    assert started == []
    assert list(home.iterdir()) == []


def test_a_pool_gets_its_manager_back_though_credentials_have_expired(
    home, scene, file, started, capsys
):
    """Its replicas go on serving; only new ones cannot be had."""
    lay_down(home, file=file, cloud="sky").spec.write_text(POOL)
    scene.sky.credentials = {"aws": "the key has expired"}
    assert main.run(["up", str(file)]) == 0
    assert "`aws` cannot be used: the key has expired" in capsys.readouterr().err
    assert len(started) == 1


def test_without_skypilot_it_says_what_to_install(file, started, monkeypatch, capsys):
    """The real adapter, on a machine that has no SkyPilot."""
    monkeypatch.setitem(sys.modules, "sky", None)
    assert main.run(["up", str(file), "--yes"]) == 1
    said = capsys.readouterr().err
    assert "error: SkyPilot cannot be used here" in said
    assert "pip install 'fogft[cloud]'" in said
    assert started == []


def test_a_cloud_that_nobody_can_check_is_told(scene, file, started, monkeypatch, capsys):
    monkeypatch.setattr(scene.cloud, "unverified", lambda cloud: f"`{cloud}` is not asked")
    assert main.run(["up", str(file), "--yes"]) == 0
    assert "warning: `aws` is not asked\n" in capsys.readouterr().err


def test_files_that_every_vm_gets_are_told_before_anything_is_launched(
    scene, file, started, capsys
):
    scene.sky.uploaded = ["~/.runpod/config.toml"]
    assert main.run(["up", str(file)]) == 1
    said = capsys.readouterr().err
    assert "warning: SkyPilot copies these files of yours" in said
    assert "`~/.runpod/config.toml`" in said
    assert "port 7448" in said
    assert "are open to the world: on AWS, `fogft.allow_from` limits who may connect" in said
    assert started == []


def test_what_cannot_be_told_of_credentials_hinders_no_up(scene, file, started, capsys):
    scene.sky.fail_next("uploaded_credentials", CloudUnreachable("SkyPilot did not answer"))
    assert main.run(["up", str(file), "--yes"]) == 0
    assert (
        "cannot tell now which files a VM gets: SkyPilot did not answer" in capsys.readouterr().err
    )


def test_skypilot_that_does_not_answer_ends_a_first_up(home, scene, file, started, capsys):
    scene.sky.fail_next("check", CloudUnreachable("SkyPilot did not answer"))
    assert main.run(["up", str(file), "--yes"]) == 1
    assert "error: SkyPilot did not answer" in capsys.readouterr().err
    assert started == []


def test_real_clouds_and_the_local_one_do_not_mix(file, capsys):
    file.write_text(SPEC + "resources: {any_of: [{infra: aws}, {infra: local}]}\n")
    assert main.run(["up", str(file)]) == 1
    assert f"error: {file}:7: resources: `aws` and `local` cannot be combined in one pool" in (
        capsys.readouterr().err
    )


def test_a_section_that_a_pool_decides_itself_is_refused_before_anything_runs(
    home, scene, file, started, capsys
):
    file.write_text(POOL + "file_mounts: {~/.fogft/x: y}\n")
    assert main.run(["up", str(file), "--yes"]) == 1
    said = capsys.readouterr().err
    assert f"error: {file}:8: file_mounts.~/.fogft/x: " in said
    assert started == []


@pytest.mark.parametrize(("text", "ends"), [("y\n", True), ("n\n", False)])
def test_down_asks_a_person(home, scene, monkeypatch, capsys, text, ends):
    paths = lay_down(home, file=file, cloud="sky")
    paths.identity.write_text(paths.identity.read_text().replace('"local"', '"sky"'))
    answer(monkeypatch, text)
    assert main.run(["down"]) == (0 if ends else 1)
    assert "shut down `planner` and all its machines? [y/N] " in capsys.readouterr().err
    assert paths.folder.exists() is not ends


def test_down_without_a_terminal_does_as_it_is_told(home, scene, monkeypatch):
    """Ending costs nothing: a script that ends a pool need not say so twice."""
    paths = lay_down(home, file=file, cloud="sky")
    paths.identity.write_text(paths.identity.read_text().replace('"local"', '"sky"'))
    monkeypatch.setattr("sys.stdin", io.StringIO())
    assert main.run(["down"]) == 0
    assert not paths.folder.exists()
