"""No test looks behind a public name: what a test must see or replace is worth a name."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
# Public, whatever their first letter says: of named tuples and of `os`; and SkyPilot's only way to
# be given a configuration.
PUBLIC = {"_replace", "_asdict", "_fields", "_exit", "_set_loaded_config"}


def is_private(name: object) -> bool:
    return (
        isinstance(name, str)
        and name.startswith("_")
        and not name.startswith("__")
        and name != "_"
        and name not in PUBLIC
    )


def is_own(value: ast.expr) -> bool:
    """Whether it is the object itself, its class, or what it inherits."""
    own_call = isinstance(value, ast.Call) and ast.unparse(value.func) in {"super", "type"}
    return own_call or (isinstance(value, ast.Name) and value.id in {"self", "cls"})


def private_names(source: str) -> Iterator[str]:
    """Find what a test takes from others although its name begins with an underscore."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Attribute) and is_private(node.attr) and not is_own(node.value):
            yield f"{node.lineno}: {ast.unparse(node)}"
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.lineno}: {a.name}" for a in node.names if is_private(a.name))
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("setattr", "getattr")):
            named = [a.value for a in node.args if isinstance(a, ast.Constant)]
            yield from (f"{node.lineno}: {name}" for name in named[:1] if is_private(name))


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("link._live", 1),
        ("self._scene._clock", 1),
        ("from fogft.disk import _write", 1),
        ("monkeypatch.setattr(disk, '_write', None)", 1),
        ("self._mine; type(self)._count; super()._of_base()", 0),
        ("row._replace(a=1); module.__name__; _local = 1", 0),
    ],
)
def test_what_counts_as_private(source: str, found: int) -> None:
    assert len(list(private_names(source))) == found


def test_no_test_takes_private_names() -> None:
    found = [
        f"{path.relative_to(TESTS)}:{name}"
        for path in sorted(TESTS.rglob("*.py"))
        for name in private_names(path.read_text())
    ]
    assert found == []
