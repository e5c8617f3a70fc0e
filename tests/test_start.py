"""What a proxy does without while it starts."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys

from fogft.process import begin_start, end_start, load_numpy
from tests.needs import needs

_LOADED = """
import json, os, sys
from fogft.process import load_numpy
load_numpy()
import numpy

threads = len(os.listdir("/proc/self/task"))
print(json.dumps({"threads": threads, "said": os.environ.get("OPENBLAS_NUM_THREADS")}))
"""


def loaded(**environ: str) -> dict:
    said = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"} | environ
    ended = subprocess.run([sys.executable, "-c", _LOADED], env=said, stdout=-1, check=True)
    return json.loads(ended.stdout)


@needs("numpy")
def test_numpy_starts_no_thread_and_others_may_have_theirs():
    assert loaded() == {"threads": 1, "said": None}


@needs("numpy", "cores")
def test_what_the_user_says_stays():
    assert loaded(OPENBLAS_NUM_THREADS="2") == {"threads": 2, "said": "2"}


def test_no_numpy_is_no_error(monkeypatch):
    monkeypatch.setitem(sys.modules, "numpy", None)
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    load_numpy()
    assert "OPENBLAS_NUM_THREADS" not in os.environ


def test_what_a_start_made_is_not_looked_through_again():
    before = gc.get_freeze_count()
    try:
        begin_start()
        assert not gc.isenabled()
        made = [[] for _ in range(1000)]
        end_start()
        assert gc.isenabled()
        assert gc.get_freeze_count() >= before + len(made)
        assert not any(one is made[0] for one in gc.get_objects())
    finally:
        gc.unfreeze()
        gc.enable()
