"""``scripts/record``: run a first pool as a person would, and draw what the terminal showed.

    python scripts/record_session.py FOLDER

It writes `terminal.svg`, and what `fogft plan`, `top` and `report` show of the same pool to
`screens`. Rich draws (`Console.export_svg`). Each command runs in a terminal of its own, so that it
prints as it does for a person: in colour, within the width. The report is opened in chromium.
"""

from __future__ import annotations

import os
import pty
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from rich.console import Console
from rich.text import Text

COLUMNS, LINES = 88, 30
TOP_S = 20.0  # until there are trends to be seen
SESSION = (
    "fogft init planner --into my_pool",
    "fogft up my_pool/pool.yaml",
    "fogft status",
    "fogft chaos kill 0",
    "fogft events -n 6",
    "fogft down",
)
PAUSES_S = {"fogft up": 8.0, "fogft chaos": 16.0}  # until the pool is whole again


def shown(command: str, folder: Path, ends_after_s: float = 0.0) -> str:
    """Run a command in a terminal; return what is left on the screen at its end.

    Args:
        ends_after_s: When it is told to end, if it does not by itself.
    """
    master, slave = pty.openpty()
    environ = {
        **os.environ,
        "FOGFT_HOME": str(folder / "home"),
        "COLUMNS": str(COLUMNS),
        "LINES": str(LINES),
        "TERM": "xterm-256color",
    }
    words = [sys.executable, "-m", *command.split()]
    with subprocess.Popen(words, cwd=folder, env=environ, stdout=slave, stderr=slave) as process:
        os.close(slave)
        if ends_after_s:
            threading.Timer(ends_after_s, process.send_signal, [signal.SIGINT]).start()
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
    said = said.rpartition("\x1b[?1049l")[0].rpartition("\x1b[H")[2] or said  # a full screen's last
    for line in said.replace("\r\n", "\n").split("\n"):
        del lines[len(lines) - min(len(lines), line.count("\x1b[1A")) :]
        left = line.rpartition("\x1b[2K")[2]  # what stood there before was cleared
        lines.append(re.sub(r"\x1b\[(?:1A|\?25[lh])|\r", "", left))
    return "\n".join(lines).rstrip()


def picture() -> Console:
    """Return a console that remembers what is printed."""
    return Console(record=True, width=COLUMNS, file=open(os.devnull, "w"), color_system="256")


def draw(console: Console, file: Path) -> None:
    """Write what was printed as a picture."""
    file.parent.mkdir(exist_ok=True)
    file.write_text(console.export_svg(title="fogft", unique_id=file.stem))


def screens(folder: Path, into: Path) -> None:
    """Write what `plan`, `top` and `report` show of the pool in a folder."""
    client = [sys.executable, "my_pool/planner_client.py", "--count", "100000"]
    with subprocess.Popen(client, cwd=folder, stdout=subprocess.DEVNULL) as asking:
        for name, command, ends_after_s in (
            ("plan", "fogft plan my_pool/pool.yaml", 0.0),
            ("top", "fogft top", TOP_S),
        ):
            console = picture()
            console.print(Text.assemble(("$ ", "bold green"), command))
            console.print(Text.from_ansi(shown(command, folder, ends_after_s)))
            draw(console, into / f"{name}.svg")
        asking.send_signal(signal.SIGINT)
    shown("fogft report planner --into report.html", folder)
    subprocess.run(
        [
            *(
                "chromium",
                "--headless",
                "--no-sandbox",
                "--disable-gpu",
                "--hide-scrollbars",
                "--window-size=800,1080",
            ),
            *(f"--screenshot={into / 'report.png'}", f"--user-data-dir={folder / 'browser'}"),
            (folder / "report.html").as_uri(),
        ],
        check=True,
        stderr=subprocess.DEVNULL,
    )


def main(docs: Path) -> None:
    """Run the session and write the pictures."""
    console = picture()
    with tempfile.TemporaryDirectory() as folder:
        for command in SESSION:
            if command == "fogft down":
                screens(Path(folder), docs / "screens")
            console.print(Text.assemble(("$ ", "bold green"), command))
            console.print(Text.from_ansi(shown(command, Path(folder))))
            console.print()
            for start, pause_s in PAUSES_S.items():
                if command.startswith(start):
                    time.sleep(pause_s)
    draw(console, docs / "terminal.svg")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
