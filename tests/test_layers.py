"""The rooms of the product: no circles, none too full, each says what is in it.

Which room may import which is import-linter's to check (`pyproject.toml`, `scripts/check`).
"""

import ast
import re
from collections import Counter
from collections.abc import Container, Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

PRODUCT = Path(__file__).parent.parent / "fogft"
MOST_MODULES = 22
DECIDES = ("ordering", "planning", "poolfile", "requests", "topics")
PURE = ("model", "ordering", "planning", "poolfile", "requests", "topics")
OPENS_FILES = {"poolfile/config_file.py", "poolfile/file.py"}
LOADED_BY_NAME = {"sky": "cloud/sky", "boto3": "cloud/sky", "botocore": "cloud/sky"}


def files() -> list[Path]:
    """Return the product's modules, without what ROS 2's build runs outside of the package."""
    return [path for path in sorted(PRODUCT.rglob("*.py")) if "ament" not in path.parts]


def name_of(path: Path) -> str:
    parts = path.relative_to(PRODUCT.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported(source: str, known: Container[str]) -> Iterator[str]:
    """Yield what a module imports, wherever in the file; a module rather than its package."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                module = f"{node.module}.{alias.name}"
                yield module if module in known else node.module


def imports(sources: Mapping[str, str]) -> dict[str, set[str]]:
    """Return module -> the other modules of `sources` that it imports."""
    return {
        name: set(imported(source, sources)) & sources.keys() - {name}
        for name, source in sources.items()
    }


def circle(graph: Mapping[str, set[str]]) -> list[str]:
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def test_no_modules_import_each_other_in_a_circle() -> None:
    """Imports inside functions and under TYPE_CHECKING count too."""
    assert circle(imports({name_of(path): path.read_text() for path in files()})) == []


@pytest.mark.parametrize(
    "late", ["def f():\n    import p.b", "if TYPE_CHECKING:\n    from p.b import x"]
)
def test_a_circle_is_found(late: str) -> None:
    """Also where one of its imports is late."""
    found = circle(imports({"p": "", "p.a": late, "p.b": "from p import a"}))
    assert set(found) == {"p.a", "p.b"}


def test_no_room_holds_more_modules_than_one_can_look_through() -> None:
    """Nor do the tests'."""
    modules = [*files(), *(PRODUCT.parent / "tests").rglob("*.py")]
    rooms = Counter(path.parent for path in modules if path.name != "__init__.py")
    assert {room: count for room, count in rooms.items() if count > MOST_MODULES} == {}


@pytest.mark.parametrize("room", DECIDES)
def test_the_tests_of_what_decides_are_as_long_as_its_code(room: str) -> None:
    code, tests = (
        sum(len(path.read_text().splitlines()) for path in (root / room).rglob("*.py"))
        for root in (PRODUCT, PRODUCT.parent / "tests")
    )
    assert tests >= code


def test_every_class_variable_says_its_type() -> None:
    """Python 3.10 reads the hints of no class that has a bare one: no history could be read."""
    bare = re.compile(r": ClassVar\b(?!\[)")
    assert [name_of(path) for path in files() if bare.search(path.read_text())] == []


def test_every_room_says_what_is_in_it_and_what_is_not() -> None:
    silent = [
        name_of(path)
        for path in files()
        if path.name == "__init__.py"
        and path.parent != PRODUCT
        and "Not here:" not in (ast.get_docstring(ast.parse(path.read_text())) or "")
    ]
    assert silent == []


def test_what_decides_opens_no_file() -> None:
    """`open` needs no import, so import-linter does not see it."""
    opening = {
        path.relative_to(PRODUCT).as_posix()
        for path in files()
        if path.relative_to(PRODUCT).parts[0] in PURE
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call)
        and (
            getattr(node.func, "id", None) == "open"
            or getattr(node.func, "attr", None) in {"read_text", "read_bytes", "rglob"}
        )
    }
    assert opening - OPENS_FILES == set()


def test_skypilot_is_loaded_by_name_in_its_room_only() -> None:
    """An import by name is hidden from import-linter."""
    strays = [
        f"{path.relative_to(PRODUCT)}: {name}"
        for path in files()
        for name, room in LOADED_BY_NAME.items()
        if f'import_module("{name}' in path.read_text()
        and not path.relative_to(PRODUCT).as_posix().startswith(room)
    ]
    assert strays == []


def test_what_a_module_leaves_to_others_is_there() -> None:
    """A module that is named after "Not here:" exists: names change, and headers are forgotten."""
    parts = [name_of(path).split(".") for path in files()]
    known = {
        ".".join(p[i:j]) for p in parts for i in range(len(p)) for j in range(i + 1, len(p) + 1)
    }
    lost = []
    for path in files():
        header = ast.get_docstring(ast.parse(path.read_text())) or ""
        left_out = re.search(r"Not here:(.*?)(\n\n|\Z)", header, re.DOTALL)
        for named in re.findall(r"`([a-z_]+(?:\.[a-z_]+)*)`", left_out[1] if left_out else ""):
            if named not in known and named.rpartition(".")[0] not in known:
                lost.append(f"{name_of(path)}: {named}")
    assert lost == []
