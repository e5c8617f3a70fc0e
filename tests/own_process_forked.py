"""A test by a pytest that need not be imported: see `tests.own_process`, `tests.link.forked`."""

from __future__ import annotations

import json
import os
import sys

import hypothesis  # noqa: F401 - imported for those who are forked, as what follows
import pytest
import zenoh  # noqa: F401

import fogft.link.zenoh.replica.listener
import fogft.link.zenoh.robot.dialer  # noqa: F401
import tests.conftest  # noqa: F401


def main() -> None:
    """Run pytest with the words and in the environment that are given; all it says is an error."""
    words, environ = json.loads(sys.argv[1])
    os.environ.clear()
    os.environ.update(environ)
    os.dup2(2, 1)
    sys.exit(pytest.main(words))
