"""What `scripts/release` needs of the folder that it stands in."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_outside_a_clone_files_are_as_old_as_its_own(tmp_path: Path):
    """An unpacked archive has no history, and its machine perhaps no git."""
    (tmp_path / "scripts").mkdir()
    shutil.copy(ROOT / "scripts" / "release", tmp_path / "scripts")
    setup = tmp_path / "scripts" / "setup"
    setup.write_text("#!/bin/sh\necho $SOURCE_DATE_EPOCH\nexit 1\n")
    setup.chmod(0o755)
    (tmp_path / "pyproject.toml").touch()
    os.utime(tmp_path / "pyproject.toml", (1.7e9, 1.7e9))
    environ = {k: v for k, v in os.environ.items() if k != "SOURCE_DATE_EPOCH"}
    environ["GIT_CEILING_DIRECTORIES"] = str(tmp_path.parent)
    done = subprocess.run(
        [tmp_path / "scripts" / "release", "--quick"],
        env=environ, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.stdout == "1700000000\n", done.stderr
