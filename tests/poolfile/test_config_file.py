"""What is written as a process's configuration is what it reads back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fogft.errors import StateError
from fogft.model.credentials import CredentialPaths
from fogft.model.proxy_config import ServerProxyConfig
from fogft.model.spec import ServiceSpec
from fogft.poolfile import config_file

CONFIG = ServerProxyConfig(
    pool="p",
    pool_uid="0123456789012345",
    slot=0,
    generation=1,
    services=(ServiceSpec("/a", "std_srvs/srv/SetBool", 1e-07),),
    credentials=CredentialPaths(Path("ca.crt"), Path("a.crt"), Path("a.key")),
)
texts = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"))


def round_trip(config: ServerProxyConfig, folder: Path) -> ServerProxyConfig:
    path = folder / "replica.yaml"
    path.write_text(config_file.document(config, "A replica.\nOf a test."))
    return config_file.read(ServerProxyConfig, path)


@given(run=texts.filter(str.strip), envs=st.dictionaries(texts, texts, max_size=3))
@example(run="\x85\u2028\ufeff\x7f\U0001f916", envs={"on": "no", "1": "1e3", "~": "null"})
@example(run='"\n${key}: x', envs={})
def test_whatever_a_text_holds_it_stays_one_text(tmp_path_factory, run, envs) -> None:
    folder = tmp_path_factory.getbasetemp()
    read = round_trip(replace(CONFIG, run=run, envs=envs), folder)
    assert (read.run, read.envs) == (run, envs)
    assert read.services == CONFIG.services


def test_services_may_be_unknown_yet(tmp_path: Path) -> None:
    """A pool whose services are discovered starts with none."""
    assert round_trip(replace(CONFIG, services=()), tmp_path).services == ()


def test_paths_lead_from_the_files_own_folder(tmp_path: Path) -> None:
    read = round_trip(replace(CONFIG, records=Path("records.json")), tmp_path)
    assert read.credentials.key == tmp_path / "a.key"
    assert read.records == tmp_path / "records.json"
    assert read.workdir == tmp_path


def test_an_option_overrides_the_file_and_is_checked_like_it(tmp_path: Path) -> None:
    path = tmp_path / "replica.yaml"
    path.write_text(config_file.document(CONFIG, ""))
    given_slot = config_file.read(ServerProxyConfig, path, {"slot": 7, "listen": None})
    assert (given_slot.slot, given_slot.listen) == (7, CONFIG.listen)
    with pytest.raises(StateError, match="listen: `here` is not `host:port`"):
        config_file.read(ServerProxyConfig, path, {"listen": "here"})


def test_an_older_program_ignores_what_a_newer_one_has_written(tmp_path: Path) -> None:
    path = tmp_path / "replica.yaml"
    path.write_text(config_file.document(CONFIG, "") + "of_the_future: {a: 1}\n")
    assert config_file.read(ServerProxyConfig, path).pool == "p"
