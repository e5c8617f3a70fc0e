"""The first process inside a world: start the emulated AWS, run the command, end everything."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import urllib.request
from pathlib import Path

HERE = Path(__file__).resolve().parent
EMULATION = Path(os.environ["EMULATION"])
READY_WITHIN_S = 60


def main() -> int:
    environ = {
        **os.environ,
        "AWS_ENDPOINT_URL": "http://127.0.0.1:5566",
        # With another address than AWS's own a region has to be named, and without not.
        "AWS_DEFAULT_REGION": "us-east-1",
        "EMULATED_AWS": "http://127.0.0.1:5567",
        "RUNPOD_API_BASE_URL": "http://127.0.0.1:5568",
        "PYTHONPATH": str(HERE.parents[2]),
    }
    subprocess.run([sys.executable, HERE / "home.py", environ["HOME"]], env=environ, check=True)
    with (EMULATION / "aws.log").open("wb") as log:
        aws = subprocess.Popen(
            [sys.executable, HERE / "aws.py"], env=environ, stdout=log, stderr=log
        )
    servers = [aws, subprocess.Popen([sys.executable, HERE / "runpod_api.py"], env=environ)]
    try:
        wait_for(environ["EMULATED_AWS"] + "/instances", aws)
        if (EMULATION / "container").is_dir():
            servers.append(registry(environ))
        return subprocess.run(
            sys.argv[1:], env=environ, cwd=HERE.parents[2], check=False
        ).returncode
    finally:
        subprocess.run(["sky", "api", "stop"], env=environ, check=False, capture_output=True)
        for server in servers:
            server.send_signal(signal.SIGTERM)
            server.wait(30)


def registry(environ: dict[str, str]) -> subprocess.Popen[bytes]:
    """Start the registry that has the one image that was baked."""
    aws = "AWS_ENDPOINT_URL=http://10.66.0.1:5566"  # where a VM that ends itself finds AWS
    words = [
        sys.executable, HERE / "registry.py", EMULATION / "container", "10.66.0.1", "5000", aws
    ]  # fmt: skip
    started = subprocess.Popen(words, env=environ, stderr=subprocess.DEVNULL)
    wait_for("http://10.66.0.1:5000/v2/", started)
    return started


def wait_for(url: str, process: subprocess.Popen[bytes]) -> None:
    pause = threading.Event()
    for _ in range(READY_WITHIN_S * 10):
        try:
            urllib.request.urlopen(url, timeout=5).read()
        except OSError:
            if process.poll() is not None:
                break
            pause.wait(0.1)
        else:
            return
    sys.exit("the emulated AWS did not start:\n" + (EMULATION / "aws.log").read_text()[-3000:])


if __name__ == "__main__":
    sys.exit(main())
