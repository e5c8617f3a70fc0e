"""Load the detector's weights with npm, once: SSD-MobileNetV2, trained on Open Images V4.

They lie in the package `@mediapipe/objectron` (Apache-2.0), packed with other files. What comes
out is compared with known checksums, so that it is the same everywhere. Writes into `weights/`
beside this file unless told another folder; does nothing when they are there.
"""

from __future__ import annotations

import hashlib
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

from ssd import LABELS, MODEL

PACKAGE = "@mediapipe/objectron@0.4.1675468480"
PACKED = "objectron_solution_packed_assets"
# Name within the package: name here, and its SHA-256.
WANTED = {
    "object_detection_ssd_mobilenetv2_oidv4_fp16.tflite": (
        MODEL,
        "d0a5255bf8c4f5a0bc4240741a76c41d5e939f7655078f945f50ab53a9375da6",
    ),
    "object_detection_oidv4_labelmap.txt": (
        LABELS,
        "c148336a65f673013609a923fdcbdeec0f49df935045029c3746a3828a0e80e0",
    ),
}


def present(folder: Path) -> bool:
    """Whether a folder has the right files."""
    return all(
        (folder / name).is_file() and _digest((folder / name).read_bytes()) == digest
        for name, digest in WANTED.values()
    )


def fetch(folder: Path) -> None:
    """Load the package and write the files into a folder.

    Raises:
        RuntimeError: npm is missing or fails, or the package holds something else.
    """
    npm = shutil.which("npm")
    if npm is None:
        raise RuntimeError("npm is missing: install it (Debian: apt install npm)")
    with tempfile.TemporaryDirectory() as scratch:
        command = [npm, "pack", "--silent", PACKAGE]
        done = subprocess.run(command, cwd=scratch, capture_output=True, text=True, check=False)
        archives = list(Path(scratch).glob("*.tgz"))
        if done.returncode or len(archives) != 1:
            raise RuntimeError(f"`{' '.join(command[1:])}` failed: {done.stderr.strip()[-300:]}")
        with tarfile.open(archives[0]) as archive:
            index = _member(archive, f"package/{PACKED}_loader.js").decode()
            data = _member(archive, f"package/{PACKED}.data")
    folder.mkdir(parents=True, exist_ok=True)
    for name, part in unpacked(index, data).items():
        target, digest = WANTED[name]
        if _digest(part) != digest:
            raise RuntimeError(f"{name} in {PACKAGE} is not what was expected")
        whole = folder / f".{target}.part"
        whole.write_bytes(part)
        whole.replace(folder / target)
    if not present(folder):
        raise RuntimeError(f"{PACKAGE} lacks what was expected in it")


def unpacked(index: str, data: bytes) -> dict[str, bytes]:
    """Cut the wanted files out of the packed ones; the index says where each begins and ends."""
    entry = r'"filename":\s*"([^"]+)",\s*"start":\s*(\d+),\s*"end":\s*(\d+)'
    found = {}
    for each in re.finditer(entry, index):
        found[each[1].rpartition("/")[2]] = data[int(each[2]) : int(each[3])]
    return {name: part for name, part in found.items() if name in WANTED}


def _member(archive: tarfile.TarFile, name: str) -> bytes:
    file = archive.extractfile(name)
    if file is None:
        raise RuntimeError(f"{PACKAGE} lacks {name}")
    return file.read()


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def main() -> int:
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "weights"
    if present(folder):
        return 0
    try:
        fetch(folder)
    except (RuntimeError, OSError, KeyError, tarfile.TarError) as error:
        print(f"the weights could not be loaded: {error}", file=sys.stderr)
        return 1
    print(f"the weights are in {folder}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
