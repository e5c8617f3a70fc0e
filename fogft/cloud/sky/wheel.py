"""Pack the fogft that runs here into a wheel, so that a VM gets the very same one.

No build tool and no index is needed: the wheel is made of the imported package's own files
and of what pip recorded of it, the same bytes each time.
"""

from __future__ import annotations

import base64
import hashlib
import importlib.metadata
import io
import zipfile
from pathlib import Path

from fogft.disk import make_folder, write_whole
from fogft.errors import CloudError

_PACKAGE = Path(__file__).resolve().parents[2]
_EPOCH = (2020, 1, 1, 0, 0, 0)
_KEPT = ("METADATA", "WHEEL", "entry_points.txt")


def make(folder: Path, package: Path = _PACKAGE) -> Path:
    """Write the wheel into a folder below `folder` that is named after its content; return that."""
    name, content = pack(package)
    target = folder / hashlib.sha256(content).hexdigest()[:16]
    if not (target / name).is_file():
        make_folder(target)
        write_whole(target / name, content)
    return target


def pack(package: Path = _PACKAGE) -> tuple[str, bytes]:
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
    files = {f"fogft/{name}": content for name, content in _sources(package).items()}
    for name in _KEPT:
        text = installed.read_text(name)
        if text is not None:
            files[f"{info}/{name}"] = _wheel_tag(text) if name == "WHEEL" else text.encode()
    record = "".join(
        f"{name},sha256={_digest(content)},{len(content)}\n" for name, content in files.items()
    )
    files[f"{info}/RECORD"] = (record + f"{info}/RECORD,,\n").encode()
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name, _EPOCH)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, content)
    return f"{stem}-py3-none-any.whl", out.getvalue()


def _sources(package: Path) -> dict[str, bytes]:
    found = dict(_files_below(package))
    beside = package.parent / "templates"
    if not (package / "templates").is_dir() and beside.is_dir():  # a checkout, not an installation
        found |= {f"templates/{name}": content for name, content in _files_below(beside)}
    return dict(sorted(found.items()))


def _files_below(folder: Path) -> list[tuple[str, bytes]]:
    return [
        (str(path.relative_to(folder)), path.read_bytes())
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and path.suffix != ".pyc"
    ]


def _wheel_tag(text: str) -> bytes:
    kept = [line for line in text.splitlines() if line and not line.startswith(("Tag:", "Build:"))]
    return ("\n".join([*kept, "Tag: py3-none-any"]) + "\n").encode()


def _digest(content: bytes) -> str:
    return base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
