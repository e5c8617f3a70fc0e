"""Fuzz every decoder of bytes that somebody else wrote, and what reads the state folder.

Each runs in a process of its own.

With atheris the cases follow what they reach in the code; without it they are damaged seeds.
A finding ends the run with status 1 and is printed as hexadecimal.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import os
import random
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tests.fuzz.targets import Target

STATE_FILES = "state files"
A_STATE_FILE = 50  # takes so many times as long as a frame, for whole commands read it
RAN = re.compile(r"executed_units: *(\d+)")  # libFuzzer's words
STATE_FILES_SHARE = 18  # of the time, where a decoder has one: there are so many


def main() -> None:
    parser = argparse.ArgumentParser(prog="scripts/fuzz", description=__doc__)
    parser.add_argument("--cases", type=int, default=1_000_000, help="of all decoders together")
    parser.add_argument("--minutes", type=float, help="for all together, in place of cases")
    parser.add_argument("--only", action="append", help="a decoder's name; all unless told")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--plain", action="store_true", help="damaged seeds, without atheris")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    parser.add_argument("--seconds", type=float, default=math.inf, help=argparse.SUPPRESS)
    given = parser.parse_args()
    guided = not given.plain and importlib.util.find_spec("atheris") is not None
    if given.one:
        follows = guided and given.one != STATE_FILES  # what reads them is all of fogft
        (_guided if follows else _plain)(given)
        return
    names = given.only or [*_targets(), STATE_FILES]
    shares = {name: STATE_FILES_SHARE if name == STATE_FILES else 1 for name in names}
    if given.minutes is None:
        limits = dict.fromkeys(names, f"--cases={-(-given.cases // len(names))}")
    else:
        unit_s = given.minutes * 60 / sum(shares.values())
        limits = {name: f"--seconds={unit_s * share:.0f}" for name, share in shares.items()}
    print(f"{len(names)} decoders, seed {given.seed}, "
          f"{'guided by coverage (atheris)' if guided else 'damaged seeds'}")  # fmt: skip
    options = [f"--seed={given.seed}", *(() if guided else ("--plain",))]
    cases = {name: _in_a_process(name, limits[name], options) for name in names}
    failed = [name for name, count in cases.items() if count is None]
    ran = sum(count or 0 for count in cases.values())
    print(f"{ran} cases, findings in: {', '.join(failed) or 'none'}")
    sys.exit(bool(failed))


def _targets() -> dict[str, Target]:
    from tests.fuzz.targets import targets

    return targets()


def _in_a_process(name: str, limit: str, options: Sequence[str]) -> int | None:
    """Return how many cases ran; None where there was a finding."""
    words = [sys.executable, "-m", "tests.fuzz", "--one", name, limit, *options]
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="fogft-fuzz-") as folder:  # libFuzzer leaves all of it
        environ = os.environ | {"TMPDIR": folder}
        done = subprocess.run(words, capture_output=True, text=True, check=False, env=environ)
    took_s, ran = time.monotonic() - began, re.search(RAN, done.stdout + done.stderr)
    found = done.returncode != 0 or ran is None
    cases = "?" if ran is None else ran[1]
    print(f"{name:20} {cases:>9} cases {took_s:7.1f} s  {'FINDING' if found else 'ok'}", flush=True)
    if ran is None or found:
        print(done.stdout[-4000:] + done.stderr[-4000:])
        return None
    return int(ran[1])


def _plain(given: argparse.Namespace) -> None:
    from tests.fuzz.mutation import damaged, damaged_text

    dice, end = random.Random(f"{given.one} {given.seed}"), time.monotonic() + given.seconds
    files, cases = given.one == STATE_FILES, given.cases
    if files:
        from tests.fuzz.state_files import state_files

        chosen = list(state_files().values())
        cases = -(-cases // A_STATE_FILE)
    else:
        chosen = [_targets()[given.one]]
    ran = 0
    while time.monotonic() < end if given.seconds < math.inf else ran < cases:
        target = chosen[ran % len(chosen)]
        data = damaged_text(target.seeds[0], dice) if files else damaged(target.seeds, dice)
        try:
            target.run(data)
        except BaseException:
            print(f"finding: {data.hex()}")
            raise
        ran += 1
    print(f"executed_units: {ran}")


def _guided(given: argparse.Namespace) -> None:
    import atheris

    with atheris.instrument_imports(include=["fogft"]):
        from tests.fuzz.targets import targets

        target = targets()[given.one]
    limit = f"-runs={given.cases}"
    if given.seconds < math.inf:
        limit = f"-max_total_time={given.seconds:.0f}"
    folder = Path(tempfile.mkdtemp())
    for number, content in enumerate(target.seeds):
        (folder / str(number)).write_bytes(content)
    options = ["-max_len=8192", "-verbosity=0", "-print_final_stats=1", f"-seed={given.seed}"]
    atheris.Setup(
        [sys.argv[0], limit, *options, f"-artifact_prefix={folder}/", str(folder)],
        lambda data: target.run(data),
    )
    atheris.Fuzz()


if __name__ == "__main__":
    main()
