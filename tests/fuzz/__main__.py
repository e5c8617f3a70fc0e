"""Fuzz every decoder of bytes that somebody else wrote, and what reads the state folder.

Each runs in a process of its own.

With atheris the cases follow what they reach in the code; without it they are damaged seeds.
A finding ends the run with status 1 and is printed as hexadecimal.
"""

from __future__ import annotations

import argparse
import importlib.util
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tests.fuzz.targets import Target

STATE_FILES = "state files"
A_STATE_FILE = 50  # takes so many times as long as a frame, for whole commands read it


def main() -> None:
    parser = argparse.ArgumentParser(prog="scripts/fuzz", description=__doc__)
    parser.add_argument("--cases", type=int, default=1_000_000, help="of all decoders together")
    parser.add_argument("--only", action="append", help="a decoder's name; all unless told")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--plain", action="store_true", help="damaged seeds, without atheris")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    given = parser.parse_args()
    guided = not given.plain and importlib.util.find_spec("atheris") is not None
    if given.one:
        follows = guided and given.one != STATE_FILES  # what reads them is all of fogft
        (_guided if follows else _plain)(given.one, given.cases, given.seed)
        return
    names = given.only or [*_targets(), STATE_FILES]
    each = -(-given.cases // len(names))
    print(f"{each} cases for each of {len(names)} decoders, seed {given.seed}, "
          f"{'guided by coverage (atheris)' if guided else 'damaged seeds'}")  # fmt: skip
    failed = [name for name in names if not _in_a_process(name, each, given.seed, guided)]
    print(f"{each * len(names)} cases, findings in: {', '.join(failed) or 'none'}")
    sys.exit(bool(failed))


def _targets() -> dict[str, Target]:
    from tests.fuzz.targets import targets

    return targets()


def _in_a_process(name: str, cases: int, seed: int, guided: bool) -> bool:
    words = [
        sys.executable,
        "-m",
        "tests.fuzz",
        "--one",
        name,
        f"--cases={cases}",
        f"--seed={seed}",
    ]
    began = time.monotonic()
    done = subprocess.run(
        words + ([] if guided else ["--plain"]), capture_output=True, text=True, check=False
    )
    took_s = time.monotonic() - began
    print(
        f"{name:20} {cases:9} cases {took_s:7.1f} s  {'ok' if not done.returncode else 'FINDING'}"
    )
    if done.returncode:
        print(done.stdout[-4000:] + done.stderr[-4000:])
    return not done.returncode


def _plain(name: str, cases: int, seed: int) -> None:
    from tests.fuzz.mutation import damaged, damaged_text

    dice = random.Random(f"{name} {seed}")
    if name == STATE_FILES:
        from tests.fuzz.state_files import state_files

        chosen = list(state_files().values())
        cases = -(-cases // A_STATE_FILE)
    else:
        chosen = [_targets()[name]]
    for number in range(cases):
        target = chosen[number % len(chosen)]
        one = name == STATE_FILES
        data = damaged_text(target.seeds[0], dice) if one else damaged(target.seeds, dice)
        try:
            target.run(data)
        except BaseException:
            print(f"finding: {data.hex()}")
            raise


def _guided(name: str, cases: int, seed: int) -> None:
    import atheris

    with atheris.instrument_imports(include=["fogft"]):
        from tests.fuzz.targets import targets

        target = targets()[name]
    with tempfile.TemporaryDirectory(prefix="fogft-fuzz-") as folder:
        for number, content in enumerate(target.seeds):
            (Path(folder) / str(number)).write_bytes(content)
        options = [f"-runs={cases}", f"-seed={seed}", "-max_len=8192", "-verbosity=0"]
        atheris.Setup(
            [sys.argv[0], *options, f"-artifact_prefix={folder}/", folder],
            lambda data: target.run(data),
        )
        atheris.Fuzz()


if __name__ == "__main__":
    main()
