"""The wheel that travels to a VM is the fogft that runs here."""

from __future__ import annotations

import csv
import hashlib
import importlib.metadata
import subprocess
import sys
import zipfile
from base64 import urlsafe_b64encode
from pathlib import Path

import pytest

from fogft.cloud.sky import wheel
from fogft.errors import CloudError
from tests.needs import needs

METADATA = "Metadata-Version: 2.3\nName: fogft\nVersion: 0.1.0\n"
WHEEL = "Wheel-Version: 1.0\nGenerator: hatchling\nRoot-Is-Purelib: true\nTag: cp311-none-any\n"


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    info = tmp_path / "site" / "fogft-0.1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(METADATA)
    (info / "WHEEL").write_text(WHEEL)
    (info / "entry_points.txt").write_text("[console_scripts]\nfogft = fogft.cli.main:main\n")
    (info / "RECORD").write_text("")
    found = importlib.metadata.Distribution.at(info)
    monkeypatch.setattr(importlib.metadata, "distribution", lambda name: found)


def test_it_holds_the_package_the_templates_and_the_command(installed: None, tmp_path: Path):
    folder = wheel.make(tmp_path / "wheels")
    (path,) = folder.iterdir()
    names = zipfile.ZipFile(path).namelist()
    assert path.name == "fogft-0.1.0-py3-none-any.whl"
    assert "fogft/cloud/sky/wheel.py" in names
    assert "fogft/templates/sky_task.yaml" in names
    assert "fogft-0.1.0.dist-info/entry_points.txt" in names
    assert not [n for n in names if "__pycache__" in n]


def test_its_record_lists_every_file_with_its_digest(installed: None):
    name, content = wheel.pack()
    path = Path(name)
    assert path.name.endswith(".whl")
    import io

    archive = zipfile.ZipFile(io.BytesIO(content))
    rows = {
        row[0]: row[1]
        for row in csv.reader(archive.read("fogft-0.1.0.dist-info/RECORD").decode().splitlines())
    }
    assert set(rows) == set(archive.namelist())
    for name, digest in rows.items():
        if not name.endswith("/RECORD"):
            made = urlsafe_b64encode(hashlib.sha256(archive.read(name)).digest()).rstrip(b"=")
            assert digest == f"sha256={made.decode()}"


def test_it_is_the_same_each_time_and_made_once(installed: None, tmp_path: Path):
    """A launch that is repeated carries the same bytes, so SkyPilot uploads them once."""
    first = wheel.make(tmp_path)
    (path,) = first.iterdir()
    stamp = path.stat().st_mtime_ns
    assert wheel.make(tmp_path) == first
    assert path.stat().st_mtime_ns == stamp


def test_pip_installs_it_without_an_index(installed: None, tmp_path: Path):
    (path,) = wheel.make(tmp_path / "wheels").iterdir()
    target = tmp_path / "there"
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--no-compile"]
    subprocess.run([*pip, "--target", str(target), str(path)], check=True, timeout=100)
    done = subprocess.run(
        [sys.executable, "-I", "-c", f"import sys; sys.path.insert(0, {str(target)!r})\n"
         "from fogft.cloud.sky import task; print(task.read()['resources']['ports'])"],
        check=True, capture_output=True, text=True, cwd=tmp_path, timeout=100,
    )  # fmt: skip
    assert done.stdout.strip() == "['@PORT@']"


def test_without_an_installation_it_says_what_to_do(monkeypatch: pytest.MonkeyPatch):
    def missing(name: str) -> None:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "distribution", missing)
    with pytest.raises(CloudError, match="without being installed") as caught:
        wheel.pack()
    assert "pip install" in caught.value.hint


@needs("uv")
def test_without_an_index_it_tells_why_from_the_beginning(
    installed: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("UV_OFFLINE", "1")
    monkeypatch.setenv("UV_CACHE_DIR", str(tmp_path / "cache"))
    needing = METADATA + "".join(f"Requires-Dist: rich!={n}\n" for n in range(100))
    (tmp_path / "site/fogft-0.1.0.dist-info/METADATA").write_text(needing)
    with pytest.raises(CloudError, match=r"needs: No solution found .* \.\.\.$"):
        wheel.lock(wheel.make(tmp_path / "wheels"))
