"""Credentials and servers that age: an AWS login that ends, an API server that is old or unwell.

Runs inside a world (`world.sh`). Whoever launches has no keys but a login by `aws sso login`, and
with OLD_SKY, a folder with another SkyPilot, that one's API server runs when `up` begins. Then the
installed one's answers 500 for three minutes, hangs for as long as fogft waits for an answer and
longer, and the login ends: no replica may be lost, and no request fail. Prints a table of steps;
ends with status 1 at the first thing wrong.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime, timezone
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from tests.e2e.pool import Client
from tests.sky.emulated_aws.emulation import Steps, control, running, until
from tests.sky.emulated_aws.http_answers import Answers
from tests.sky.emulated_aws.pool import HOME, Pool, servers_of_sky

UNWELL_S, HANGS_S = 180.0, 100.0
PORTAL, BROKEN = 5570, 46581
AGED = """\
name: aged
resources: {cpus: 2, use_spot: true, infra: aws/us-east-1}
workdir: .
run: exec python3 plan_service.py
fogft:
  replicas: 1
  services:
    - {name: /plan, type: nav_msgs/srv/GetPlan, timeout_s: 10}
"""
CONFIG = """\
[default]
sso_session = lab
sso_account_id = 123456789012
sso_role_name = fogft
region = us-east-1
[sso-session lab]
sso_start_url = https://lab.example.com/start
sso_region = us-east-1
sso_registration_scopes = sso:account:access
"""
# Who asks the API server asks the broken one instead; connections that there are end.
REDIRECTED = f"""\
table ip broken {{
  chain to_the_broken {{
    type nat hook output priority -100
    tcp dport 46580 redirect to :{BROKEN}
  }}
  chain of_before {{
    type filter hook output priority 0
    tcp dport 46580 reject with tcp reset
  }}
}}
"""
step = Steps()


class Login:
    """A login by `aws sso login`: the token that it left here, and who takes it."""

    def __init__(self) -> None:
        home = Path.home() / ".aws"
        (home / "credentials").unlink()
        (home / "config").write_text(CONFIG)
        self._token = home / "sso/cache" / f"{hashlib.sha1(b'lab').hexdigest()}.json"
        self._token.parent.mkdir(parents=True)
        self.is_over = False

    def lasts(self, seconds: float) -> None:
        self.is_over = seconds <= 0
        end = datetime.fromtimestamp(time.time() + seconds, timezone.utc)
        told = {"startUrl": "https://lab.example.com/start", "region": "us-east-1",
                "accessToken": "t0ken", "expiresAt": f"{end:%Y-%m-%dT%H:%M:%SZ}"}  # fmt: skip
        self._token.write_text(json.dumps(told))


LOGIN = Login()


class Portal(Answers, BaseHTTPRequestHandler):
    """AWS's: keys for a token, so short-lived that they are asked for each time."""

    def do_GET(self) -> None:
        if LOGIN.is_over:
            told = {"__type": "UnauthorizedException", "message": "Session token not found"}
            return self.answer(told, 401)
        keys = {"accessKeyId": "test", "secretAccessKey": "test", "sessionToken": "test",
                "expiration": int((time.time() + 300) * 1000)}  # fmt: skip
        return self.answer({"roleCredentials": keys})


class Broken(Answers, BaseHTTPRequestHandler):
    """An API server that is unwell."""

    asked = 0

    def do_GET(self) -> None:
        Broken.asked += 1
        self.answer("Internal Server Error", 500)

    def do_POST(self) -> None:
        self.do_GET()


@contextmanager
def answers_500() -> Iterator[None]:
    subprocess.run(["nft", "-f", "-"], input=REDIRECTED, text=True, check=True)
    try:
        yield
    finally:
        subprocess.run(["nft", "delete", "table", "ip", "broken"], check=True)


@contextmanager
def hangs() -> Iterator[None]:
    stopped = servers_of_sky()
    for process in stopped:
        process.send_signal(signal.SIGSTOP)
    try:
        yield
    finally:
        for process in stopped:
            process.send_signal(signal.SIGCONT)


def serve(port: int, handler: type[BaseHTTPRequestHandler]) -> None:
    server = ThreadingHTTPServer(("127.0.0.1", port), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()


def start_old_server(pool: Pool) -> str:
    """Start the API server of another SkyPilot; return its version, empty where there is none."""
    folder = os.environ.get("OLD_SKY", "")
    if not folder:
        return ""
    environ = {**pool.environ, "PYTHONPATH": folder}
    subprocess.run(["sky", "api", "start"], env=environ, check=True)
    (found,) = Path(folder).glob("skypilot*.dist-info")
    return found.name.removesuffix(".dist-info").partition("-")[2]


class Proof:
    def __init__(self, pool: Pool) -> None:
        self.pool = pool
        self.replica = ""

    def through(self, trouble: Any, seconds: float) -> None:
        """Let a time pass; the one replica is there all the while, and no other is ordered."""
        pause = threading.Event()
        with trouble:
            end = time.monotonic() + seconds
            while time.monotonic() < end:
                assert self.pool.others("") == {self.replica}, self.pool.status()
                pause.wait(1.0)
            print(self.pool.status()["notes"], flush=True)

    def run(self) -> None:
        old = start_old_server(self.pool)
        with step("`up --yes` with a login that ends in an hour"):
            said = self.pool.fogft("up", str(self.pool.file), "--yes")
        print(said)
        assert re.search(r"the credentials of `aws` expire in (1\.0|0\.9) h", said)
        if old:
            told = f"API server is {old}, but "
            assert re.search(re.escape(told) + r"\S+ is installed here: it was idle and", said)
        (self.replica,) = self.pool.replicas()
        client = Client(self.pool.environ, 3600.0, 5.0, 15.0)
        with step("SkyPilot's API server answers 500"):
            self.through(answers_500(), UNWELL_S)
        print(f"          asked in vain {Broken.asked} times")
        assert Broken.asked > 5
        with step("... and is well again, until the pool says so"):
            until("it is whole, and no note is left", self.is_well)
        with step("SkyPilot's API server hangs"):
            self.through(hangs(), HANGS_S)
        with step("... and goes on, until the pool says so"):
            until("it is whole, and no note is left", self.is_well)
        LOGIN.lasts(-60)
        self.pool.fogft("scale", "up", "1")
        with step("the login has ended, and another replica is wanted"):
            self.through_refusals()
        assert len(running()) == 1
        LOGIN.lasts(8 * 3600)
        with step("... it is renewed, until the other replica is ready"):
            until("the pool is whole", lambda: self.pool.whole(2))
        assert self.replica in self.pool.replicas()
        result = client.finish()
        print(result)
        assert result["answered"] == result["requests"] > 100, result
        assert result["failed"] == result["wrong"] == result["twice"] == 0, result
        with step("`down`, verified with the cloud"):
            print(self.pool.fogft("down"))
        assert not running()
        assert not list((HOME / "pools").glob("*"))

    def is_well(self) -> bool:
        return self.pool.whole(1) and not self.pool.status()["notes"]

    def through_refusals(self) -> None:
        """The one replica serves on, and the pool says why there is no other."""

        def told() -> str:
            assert self.replica in self.pool.others(""), self.pool.status()
            events = self.pool.status()["events"]
            reasons = [(event["reason"] or {}).get("words", "") for event in events]
            notes = [str(note) for note in self.pool.status()["notes"]]
            wanted = ("SSO", "sso", "credentials")
            return next((t for t in notes + reasons if any(w in t for w in wanted)), "")

        print(until("it says so", told), flush=True)


def main() -> int:
    LOGIN.lasts(3600)
    serve(PORTAL, Portal)
    serve(BROKEN, Broken)
    pool = Pool(AGED)
    pool.environ["AWS_ENDPOINT_URL_SSO"] = f"http://127.0.0.1:{PORTAL}"
    try:
        Proof(pool).run()
    finally:
        pool.keep_log()
    told = [one["event"] for one in control("/log", post=False)]
    assert told.count("preempt") == 0, told
    pool.leave_nothing()
    step.write("aged")
    print("every step passed")
    return 0


if __name__ == "__main__":
    sys.exit(main())
