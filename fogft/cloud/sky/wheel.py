"""Build what a VM installs: the running fogft as a wheel, and a lock file of its dependencies.

The wheel is reproducible byte for byte. `up` makes the lock; a generation keeps its first lock.
"""

import base64
import contextlib
import hashlib
import importlib.metadata
import io
import subprocess
import sys
import textwrap
import zipfile
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from fogft import template_files
from fogft.disk import locked, make_folder, read_as, write_json, write_whole
from fogft.errors import CloudError
from fogft.model.plain import to_plain

_PACKAGE = Path(__file__).resolve().parents[2]
_EPOCH = (2020, 1, 1, 0, 0, 0)
_KEPT = ("METADATA", "WHEEL", "entry_points.txt")
_REPLACED = ("Tag:", "Build:")  # in the file `WHEEL`
FILES = {"requirements.txt": "fogft", "requirements-ros.txt": "fogft[ros]"}
_COMPILE = ("pip", "compile", "--quiet", "--generate-hashes", "--no-header", "--no-annotate")
_FOR_ALL = ("--universal", "--python-version", "3.10", "--no-emit-package", "fogft", "-")
_LIMIT_S = 120.0
_SHOWN = 400  # characters of `uv`'s output


def make(folder: Path) -> Path:
    """Write the wheel to a subfolder of `folder` named by its hash; return the subfolder."""
    name, content = pack()
    target = folder / hashlib.sha256(content).hexdigest()[:16]
    if not (target / name).is_file():
        make_folder(target)
        write_whole(target / name, content)
    return target


def pack() -> tuple[str, bytes]:
    """Return the wheel's file name and content. Raises CloudError: fogft is not installed here."""
    try:
        installed = importlib.metadata.distribution("fogft")
    except importlib.metadata.PackageNotFoundError as error:
        raise CloudError(
            "fogft cannot be packed for the VM: it runs here without being installed",
            "install it into a virtual environment: `pip install .`",
        ) from error
    stem = f"fogft-{installed.version}"
    info = f"{stem}.dist-info"
    files = {f"fogft/{name}": content for name, content in _sources().items()}
    for name in _KEPT:
        text = installed.read_text(name)
        if name == "WHEEL" and text is not None:
            kept = [line for line in text.splitlines() if not line.startswith(_REPLACED)]
            text = "\n".join([*filter(None, kept), "Tag: py3-none-any"]) + "\n"
        if text is not None:
            files[f"{info}/{name}"] = text.encode()
    record = ""
    for name, content in files.items():
        digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
        record += f"{name},sha256={digest},{len(content)}\n"
    files[f"{info}/RECORD"] = (record + f"{info}/RECORD,,\n").encode()
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name, _EPOCH)
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, content, zipfile.ZIP_DEFLATED)
    return f"{stem}-py3-none-any.whl", out.getvalue()


def _sources() -> dict[str, bytes]:
    paths = {str(path.relative_to(_PACKAGE)): path for path in _PACKAGE.rglob("*")}
    templates = template_files.folder()
    paths |= {str(path.relative_to(templates.parent)): path for path in templates.rglob("*")}
    return {
        name: path.read_bytes()
        for name, path in sorted(paths.items())
        if path.is_file() and "__pycache__" not in path.parts and path.suffix != ".pyc"
    }


@dataclass(frozen=True)
class Locks:
    """Lock files without and with ROS 2; none if they could not be created."""

    files: Mapping[str, str]


def lock(wheel: Path) -> Locks:
    """Return the locks for the wheel in a folder. CloudError: no package index, or no `uv`."""
    (file,) = wheel.glob("*.whl")
    wanted = [f"{name} @ {file.as_uri()}" for name in FILES.values()]
    with ThreadPoolExecutor(len(wanted)) as both:
        return Locks(dict(zip(FILES, both.map(_compiled, wanted), strict=True)))


def _compiled(wanted: str) -> str:
    command = [sys.executable, "-m", "uv", *_COMPILE, *_FOR_ALL]
    try:
        done = subprocess.run(
            command, input=wanted, capture_output=True, text=True, timeout=_LIMIT_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise CloudError(f"`uv` cannot resolve the packages that fogft needs: {error}") from error
    if done.returncode:
        said = textwrap.shorten(done.stderr.removeprefix("error: "), _SHOWN, placeholder=" ...")
        raise CloudError(f"`uv` cannot resolve the packages that fogft needs: {said}")
    return done.stdout


class LockFolder:
    """Lock files on disk: the newest one for each wheel, and each generation's own."""

    def __init__(self, folder: Path, resolve: Callable[[Path], Locks]) -> None:
        make_folder(folder)
        self._folder = folder
        self._resolve = resolve

    def renew(self, wheel: Path) -> Mapping[str, bytes]:
        """Update the lock for a wheel's next generations; return it. CloudError: there is none."""
        newest = self._newest(wheel)
        try:
            write_json(newest, to_plain(self._resolve(wheel)))
        except CloudError:
            if read_as(Locks, newest) is None:
                raise
        return _as_files(read_as(Locks, newest))

    def of(self, generation: str, wheel: Path) -> Mapping[str, bytes]:
        """Return a generation's lock as files; empty if none could be made at its first launch."""
        kept = self._folder / f"{generation}-{wheel.name}.json"
        with locked(self._folder / "locks.lock"):
            found = read_as(Locks, kept)
            if found is None:
                found = read_as(Locks, self._newest(wheel)) or Locks({})
                if not found.files:
                    with contextlib.suppress(CloudError):  # `up` has warned of it
                        found = self._resolve(wheel)
                write_json(kept, to_plain(found))
        return _as_files(found)

    def _newest(self, wheel: Path) -> Path:
        return self._folder / f"{wheel.name}.json"


def _as_files(locks: Locks | None) -> Mapping[str, bytes]:
    return {name: content.encode() for name, content in locks.files.items()} if locks else {}
