"""Import an example's modules as its nodes do: from its folder, by their bare names."""

from __future__ import annotations

import contextlib
import importlib
import sys
from collections.abc import Iterator
from types import ModuleType

from fogft import template_files


@contextlib.contextmanager
def modules(example: str, *names: str) -> Iterator[list[ModuleType]]:
    """Yield modules of an example; afterwards other examples may have others of these names."""
    folder = template_files.folder() / example
    own = {path.stem for path in folder.glob("*.py")}
    before = {name: sys.modules.pop(name) for name in own & sys.modules.keys()}
    sys.path.insert(0, str(folder))
    try:
        yield [importlib.import_module(name) for name in names]
    finally:
        sys.path.remove(str(folder))
        for name in own:
            sys.modules.pop(name, None)
        sys.modules.update(before)
