"""Nothing is decided from a sentence: a reason is compared by its cause, and is shown in words."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PRODUCT = Path(__file__).parent.parent / "fogft"
ROOMS = ("cli", "cloud", "doctor", "model", "planning", "pool", "simulation")
SENTENCES = {"detail", "details", "failure", "fault", "note", "notes", "reason", "reasons"} | {
    "message", "told", "trouble", "why", "why_not", "words",
}  # fmt: skip
READS = {"endswith", "find", "index", "partition", "removeprefix", "rpartition", "split"} | {
    "startswith"
}


def last_name(node: ast.expr) -> str:
    """Return the last name of ``a.b.c``, ``c`` or ``c(...)``; empty for anything else."""
    if isinstance(node, ast.Call):
        return last_name(node.func)
    if isinstance(node, ast.Attribute):
        return node.attr
    return node.id if isinstance(node, ast.Name) else ""


def is_cut(node: ast.AST) -> bool:
    """Whether this leaves out lines of a sentence: ``words.partition("\\n")``."""
    return (
        isinstance(node, ast.Call)
        and len(node.args) == 1
        and isinstance(node.args[0], ast.Constant)
        and node.args[0].value == "\n"
    )


def read_back(source: str) -> Iterator[str]:
    """Yield the expressions that look into a sentence."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            is_read = node.func.attr in READS and last_name(node.func.value) in SENTENCES
            if is_read and not is_cut(node):
                yield ast.unparse(node)
        elif isinstance(node, ast.Compare):
            sides = zip((node.left, *node.comparators), node.ops, node.comparators, strict=False)
            for left, operator, right in sides:
                texts = isinstance(left, ast.Constant) and isinstance(left.value, str)
                if isinstance(operator, ast.In | ast.NotIn) and texts:
                    if last_name(right) in SENTENCES:
                        yield ast.unparse(node)
                elif isinstance(operator, ast.Eq | ast.NotEq):
                    literal = isinstance(right, ast.Constant) and isinstance(right.value, str)
                    if literal and last_name(left) in SENTENCES:
                        yield ast.unparse(node)


@pytest.mark.parametrize("room", ROOMS)
def test_no_sentence_is_read_back(room: str) -> None:
    """Neither its beginning, nor a word in it, nor the whole of it."""
    found = {
        str(path.relative_to(PRODUCT)): list(read_back(path.read_text()))
        for path in (PRODUCT / room).rglob("*.py")
    }
    assert {name: told for name, told in found.items() if told} == {}


@pytest.mark.parametrize(
    ("source", "count"),
    [
        ("judged.why.split(' ')[0]", 1),
        ("standing.reason.startswith('outdated')", 1),
        ("'max_surge' in plan.notes", 1),
        ("link.detail == 'refused'", 1),
        ("reason.cause is Cause.OUTDATED", 0),
        ("words.partition('\\n')", 0),
        ("name.split('/')", 0),
    ],
)
def test_what_counts_as_reading_back(source: str, count: int) -> None:
    """The test itself finds what it is for, and leaves other texts alone."""
    assert len(list(read_back(source))) == count
