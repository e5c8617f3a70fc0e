"""``scripts/record``: run a first pool as a person would, and draw what the terminal showed.

    python scripts/record_session.py PICTURE.svg

Rich draws it (`Console.export_svg`). Each command runs in a terminal of its own, so that it prints
as it does for a person: in colour, within the width.
"""

from __future__ import annotations

import os
import pty
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from rich.console import Console
from rich.text import Text

COLUMNS = 88
SESSION = (
    "fogft init planner --into my_pool",
    "fogft up my_pool/pool.yaml",
    "fogft status",
    "fogft chaos kill 0",
    "fogft events -n 6",
    "fogft down",
)
PAUSES_S = {"fogft up": 8.0, "fogft chaos": 16.0}  # until the pool is whole again


def shown(command: str, folder: Path) -> str:
    """Run a command in a terminal; return what is left on the screen at its end."""
    master, slave = pty.openpty()
    environ = {
        **os.environ,
        "FOGFT_HOME": str(folder / "home"),
        "COLUMNS": str(COLUMNS),
        "TERM": "xterm-256color",
    }
    words = [sys.executable, "-m", *command.split()]
    with subprocess.Popen(words, cwd=folder, env=environ, stdout=slave, stderr=slave) as process:
        os.close(slave)
        said = b""
        while True:
            try:
                chunk = os.read(master, 65536)
            except OSError:
                break
            if not chunk:
                break
            said += chunk
        if process.wait():
            raise SystemExit(f"error: `{command}` ended with {process.returncode}: {said.decode()}")
    os.close(master)
    return at_the_end(said.decode())


def at_the_end(said: str) -> str:
    """Return what a screen shows after redrawing: each rise of the cursor clears what it passes."""
    lines: list[str] = []
    for line in said.replace("\r\n", "\n").split("\n"):
        del lines[len(lines) - min(len(lines), line.count("\x1b[1A")) :]
        left = line.rpartition("\x1b[2K")[2]  # what stood there before was cleared
        lines.append(re.sub(r"\x1b\[(?:1A|\?25[lh])|\r", "", left))
    return "\n".join(lines).rstrip()


def main(picture: Path) -> None:
    """Run the session and write the picture."""
    console = Console(record=True, width=COLUMNS, file=open(os.devnull, "w"), color_system="256")  # noqa: SIM115
    with tempfile.TemporaryDirectory() as folder:
        for command in SESSION:
            console.print(Text.assemble(("$ ", "bold green"), command))
            console.print(Text.from_ansi(shown(command, Path(folder))))
            console.print()
            for start, pause_s in PAUSES_S.items():
                if command.startswith(start):
                    time.sleep(pause_s)
    picture.write_text(console.export_svg(title="fogft", unique_id="fogft"))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
