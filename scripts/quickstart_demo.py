"""The quick start: a pool of three replicas that are killed and frozen while a client asks.

Told through the same commands that a person would type. All state lies in `.quickstart`;
what children write to their home or to temporary folders lands there too.

Owns: the story and its report. Not here: what counts as left behind (`quickstart_leftovers`).
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from quickstart_leftovers import Before, free_ros_domain

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / ".quickstart"
REPLICAS = 3
PERIOD_S = 0.4  # each replica plans every request: some 0.1 s of a core, times three
FAULTS = ("kill", "kill", "freeze")
WHOLE_LIMIT_S = 120.0


class DemonstrationError(Exception):
    """The demonstration did not show what it should."""


@dataclass
class Story:
    """What happened so far."""

    whole_after_s: list[tuple[str, float]] = field(default_factory=list)
    won: dict[str, int] = field(default_factory=dict)
    summary: dict[str, Any] = field(default_factory=dict)


def say(text: str = "") -> None:
    print(text, flush=True)


def environment(domain: int) -> dict[str, str]:
    """Return the children's environment: everything they may write lies in `FOLDER`."""
    environ = {k: v for k, v in os.environ.items() if not k.startswith(("FOGFT_", "XDG_"))}
    environ.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)
    for name, folder in (("HOME", "user"), ("TMPDIR", "tmp"), ("ROS_LOG_DIR", "ros-log")):
        (FOLDER / folder).mkdir(parents=True, exist_ok=True)
        environ[name] = str(FOLDER / folder)
    environ.update(
        FOGFT_HOME=str(FOLDER / "home"),
        ROS_DOMAIN_ID=str(domain),
        ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST",
        PYTHONDONTWRITEBYTECODE="1",
    )
    return environ


class Commands:
    """Runs ``fogft`` and the client, out of reach of the terminal's Ctrl-C."""

    def __init__(self, environ: dict[str, str]) -> None:
        self._environ = environ

    def fogft(self, *arguments: str, shown: bool = True, check: bool = True) -> str:
        """Run one command; return what it wrote to stdout."""
        if shown:
            say(f"\n$ fogft {' '.join(arguments)}")
        process = self.start([sys.executable, "-m", "fogft", *arguments], stdout=subprocess.PIPE)
        try:
            output = process.communicate()[0].decode()
        except BaseException:
            process.terminate()
            process.wait()
            raise
        if shown and output:
            say(output.rstrip())
        if check and process.returncode:
            raise DemonstrationError(
                f"`fogft {' '.join(arguments)}` ended with {process.returncode}"
            )
        return output

    def start(self, command: list[str], **options: Any) -> subprocess.Popen[bytes]:
        """Start a process in a session of its own."""
        return subprocess.Popen(command, env=self._environ, start_new_session=True, **options)


def seen() -> dict[str, Any]:
    """Return what `fogft status --json` would print, without the cost of a process."""
    try:
        status: dict[str, Any] = json.loads(
            (FOLDER / "home" / "pools" / "planner" / "status.json").read_text()
        )
    except (OSError, ValueError):
        return {}
    return status


def ready(status: dict[str, Any]) -> dict[int, int]:
    """Return the slots that are ready and in good health, with their generations."""
    return {
        r["slot"]: r["generation"]
        for r in status.get("replicas", ())
        if (r["phase"], r["verdict"], r["link"]) == ("ready", "good", "up")
    }


def await_whole(story: Story, but_not: tuple[int, int] | None) -> dict[int, int]:
    """Wait until enough slots are ready, without the replica that met the fault; return them."""
    limit = time.monotonic() + WHOLE_LIMIT_S
    while time.monotonic() < limit:
        status = seen()
        note_winners(story, status)
        found = ready(status)
        if len(found) >= REPLICAS and (but_not is None or found.get(but_not[0]) != but_not[1]):
            return found
        time.sleep(0.1)
    raise DemonstrationError(f"the pool was not fully ready within {WHOLE_LIMIT_S:.0f} s")


def note_winners(story: Story, status: dict[str, Any]) -> None:
    """Remember who won how often: a replica that is gone is no longer in the status."""
    for replica in status.get("replicas", ()):
        name = f"{replica['slot']}.{replica['generation']}"
        story.won[name] = max(story.won.get(name, 0), replica.get("won") or 0)


def break_things(commands: Commands, story: Story, client: subprocess.Popen[bytes]) -> None:
    """Bring the faults, one after the other, each once the pool is whole."""
    for action in FAULTS:
        time.sleep(3.0)
        found = await_whole(story, None)
        # The replica that runs longest: another one each time.
        slot, generation = min(found.items(), key=lambda one: (one[1], one[0]))
        if client.poll() is not None:
            raise DemonstrationError("the client ended before the last fault: try more `--seconds`")
        commands.fogft("chaos", action, str(slot))
        since = time.monotonic()
        time.sleep(2.5 if action == "freeze" else 0.5)
        commands.fogft("status")
        await_whole(story, (slot, generation))
        story.whole_after_s.append((f"{action} {slot}", time.monotonic() - since))
        say(f"\nfully ready again {story.whole_after_s[-1][1]:.1f} s after the {action}")


def with_three(pool_file: str) -> str:
    """Return the example's file with three spot replicas, so that two serve beside a broken one."""
    lines = [line for line in pool_file.splitlines() if "on_demand:" not in line]
    return "\n".join(lines).replace("replicas: 2", f"replicas: {REPLICAS}") + "\n"


def demonstrate(commands: Commands, story: Story, seconds: float) -> None:
    """Run the story up to the end of the client."""
    example = FOLDER / "planner"
    commands.fogft("init", "planner", "--into", str(example))
    file = example / "pool.yaml"
    file.write_text(with_three(file.read_text()))
    commands.fogft("up", str(file))
    await_whole(story, None)
    commands.fogft("status")
    count = int(seconds / PERIOD_S)
    ask = [str(example / "planner_client.py"), "--count", str(count), "--period-s", str(PERIOD_S)]
    say(f"\n$ python {' '.join(ask)} &")
    with (FOLDER / "client.json").open("wb") as output:
        client = commands.start([sys.executable, *ask], stdout=output)
        try:
            break_things(commands, story, client)
            say("\nwaiting for the client's last answers")
            client.wait(timeout=seconds + WHOLE_LIMIT_S)
        finally:
            end(client)
    note_winners(story, seen())
    commands.fogft("status")
    try:
        story.summary = json.loads((FOLDER / "client.json").read_text())
    except ValueError:
        raise DemonstrationError("the client printed no summary") from None


def end(process: subprocess.Popen[bytes]) -> None:
    """End a process that still runs: kindly, then at once."""
    for ask in (process.terminate, process.kill):
        if process.poll() is None:
            ask()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout=5)


def report(story: Story) -> None:
    """Print what became of the requests and of the pool."""
    summary, total = story.summary, sum(story.won.values()) or 1
    winners = ", ".join(f"{n} {w * 100 / total:.0f} %" for n, w in sorted(story.won.items()) if w)

    def milliseconds(key: str) -> str:
        return "-" if summary.get(key) is None else f"{summary[key] * 1000:.0f} ms"

    say("\nreport")
    say(f"  requests        {summary['requests']}, one every {PERIOD_S:g} s")
    say(f"  failed          {summary['failed']}")
    say(f"  wrong           {summary['wrong']}")
    say(
        f"  time to answer  p50 {milliseconds('p50_s')}, p99 {milliseconds('p99_s')},"
        f" longest {milliseconds('max_s')}"
    )
    say(f"  longest gap     {milliseconds('longest_gap_s')} between two answers")
    say(f"  won by replica  {winners}")
    for fault, after_s in story.whole_after_s:
        say(f"  {fault:<14}  fully ready again after {after_s:.1f} s")
    if summary["failed"] or summary["wrong"]:
        raise DemonstrationError(
            f"{summary['failed']} requests failed, {summary['wrong']} answers were wrong"
        )


def clean_up(commands: Commands, before: Before) -> list[str]:
    """End the pool; return what is left of it nevertheless."""
    if any(FOLDER.glob("home/pools/*")):
        with contextlib.suppress(DemonstrationError):
            commands.fogft("down", "--yes", check=False)
    left = before.left_behind(FOLDER / "home")
    say("\nleft behind: " + (", ".join(left) if left else "nothing"))
    return left


def guarded(step: Callable[[], None], problems: list[str]) -> None:
    """Run a step; remember its failure instead of raising it."""
    try:
        step()
    except (DemonstrationError, subprocess.TimeoutExpired, OSError) as error:
        problems.append(str(error))
    except KeyboardInterrupt:
        problems.append("interrupted")


def interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def main() -> int:
    parser = argparse.ArgumentParser(prog="scripts/quickstart", description="See fogft work.")
    parser.add_argument("--seconds", type=float, default=75.0, help="how long the client asks")
    parser.add_argument("--keep", action="store_true", help="keep `.quickstart` afterwards")
    options = parser.parse_args()

    alone = os.open(ROOT, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(alone, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        print("error: the quick start is already running in this folder", file=sys.stderr)
        return 1
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, interrupt)
    problems: list[str] = []
    story = Story()
    before = Before.now()
    domain = free_ros_domain()
    if any(FOLDER.glob("home/pools/*")):
        say("an earlier run was interrupted: ending its pool first")
        Commands(environment(domain)).fogft("down", "--yes", check=False)
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir(mode=0o700)
    commands = Commands(environment(domain))
    guarded(lambda: demonstrate(commands, story, options.seconds), problems)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: say("cleaning up, one moment"))
    left = clean_up(commands, before)
    if left:
        problems.append(f"left behind: {', '.join(left)}")
    if not problems:
        guarded(lambda: report(story), problems)
    for problem in problems:
        print(f"error: {problem}", file=sys.stderr)
    if options.keep or (problems and problems != ["interrupted"]):
        say(f"all files are in {FOLDER}")
    else:
        shutil.rmtree(FOLDER, ignore_errors=True)
    return 130 if "interrupted" in problems else 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
