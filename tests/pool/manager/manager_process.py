"""Run a manager over the folder cloud: ``python -m <this module> HOME NAME``."""

from __future__ import annotations

import sys
from pathlib import Path

from fogft.errors import FogftError
from fogft.pool.manager import manager
from tests.pool.scene import cloud_of, store_of


def main() -> None:
    """Run it for the home and the name that are given; see `tests.link.forked`."""
    home, name = sys.argv[1:]
    store = store_of(Path(home), name)
    proxy = [sys.executable, "-m", "tests.pool.fake_proxy", str(store.paths.folder)]
    try:
        manager.run(store, lambda _: cloud_of(Path(home)), proxy_command=proxy)
    except FogftError as error:
        sys.exit(f"error: {error.message}")


if __name__ == "__main__":
    main()
