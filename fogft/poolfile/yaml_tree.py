"""Parse YAML into a tree with the line of every key and value.

PyYAML's own loader forgets lines, keeps the last of two equal keys, and expands aliases
without end. So its composer is used, and the nodes are converted here, with limits. What
comes out can be written as JSON: dates stay the text that was written, and there are no
other tags. Nothing is ever executed.
"""

from __future__ import annotations

import yaml

from fogft.errors import SpecError
from fogft.poolfile.tree import Node, shown

MAX_NODES = 20_000
MAX_DEPTH = 40
MAX_NUMBER = 60  # characters; a longer one is no setting, and costs time to convert
_TAG = "tag:yaml.org,2002:"
_AS_WRITTEN = {_TAG + "str", _TAG + "timestamp", _TAG + "value"}
_CONVERTED = {_TAG + "null", _TAG + "bool", _TAG + "int", _TAG + "float"}


class _RefusedError(Exception):
    def __init__(self, line: int, key: str, what: str, hint: str) -> None:
        super().__init__(what)
        self.line = line
        self.key = key
        self.what = what
        self.hint = hint


def tree(text: str, file: str) -> Node:
    """Return a document's tree."""
    loader: _Loader | None = None
    try:
        loader = _Loader(text)
        return _Converter(loader).document(loader.get_single_node())
    except _RefusedError as refused:
        key = f" {shown(refused.key, 80)[1:-1]}:" if refused.key else ""
        raise SpecError(f"{file}:{refused.line}:{key} {refused.what}", refused.hint) from None
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else 1
        raise SpecError(f"{file}:{line}: not YAML: {_problem(error)}", _hint(error)) from None
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        what = f"character {ascii(chr(error.character))[1:-1]} is not allowed"
        raise SpecError(f"{file}:{line}: not YAML: {what}", "remove it") from None
    # PyYAML lets ValueError, OverflowError and others escape on odd input such as
    # "\UFFFFFFFF". Whatever it is, the file is what caused it.
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError) as error:
        line = loader.line + 1 if loader else 1
        what = shown(error, 120)[1:-1]
        raise SpecError(f"{file}:{line}: not YAML: {what}", "check this line's syntax") from None


class _Loader(yaml.SafeLoader):
    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = 0
        self._nodes = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        self._nodes += 1
        self._depth += 1
        line = self.line + 1
        if self._depth > MAX_DEPTH:
            raise _RefusedError(line, "", f"nested deeper than {MAX_DEPTH} levels", "flatten it")
        if self._nodes > MAX_NODES:
            raise _too_many(line)
        node: yaml.Node | None = super().compose_node(parent, index)
        self._depth -= 1
        return node


class _Converter:
    """Makes our nodes of PyYAML's. Aliases are expanded, and counted."""

    def __init__(self, loader: _Loader) -> None:
        self._loader = loader
        self._nodes = 0
        self._open: set[int] = set()

    def document(self, root: yaml.Node | None) -> Node:
        if root is None:
            raise _RefusedError(1, "", "the file is empty", "`fogft init` writes a working example")
        return self.node(root, "", root.start_mark.line + 1)

    def node(self, node: yaml.Node, path: str, key_line: int) -> Node:
        line = node.start_mark.line + 1
        self._nodes += 1
        if self._nodes > MAX_NODES:
            raise _too_many(line)
        if isinstance(node, yaml.ScalarNode):
            return Node(self._scalar(node, path), line, key_line)
        if id(node) in self._open:
            raise _RefusedError(line, path, "contains itself through an alias", "write it out")
        self._open.add(id(node))
        value = (
            self._map(node, path) if isinstance(node, yaml.MappingNode) else self._list(node, path)
        )
        self._open.discard(id(node))
        return Node(value, line, key_line)

    def _list(self, node: yaml.Node, path: str) -> tuple[Node, ...]:
        _expect(node, path, "seq")
        return tuple(
            self.node(child, f"{path}[{index}]", child.start_mark.line + 1)
            for index, child in enumerate(node.value)
        )

    def _map(self, node: yaml.MappingNode, path: str) -> dict[str, Node]:
        _expect(node, path, "map")
        merged: dict[str, Node] = {}
        own: dict[str, Node] = {}
        for key_node, value_node in node.value:
            line = key_node.start_mark.line + 1
            if key_node.tag == _TAG + "merge":
                for name, child in self._merged(value_node, path).items():
                    merged.setdefault(name, child)
                continue
            key = self._key(key_node, path)
            full = f"{path}.{key}" if path else key
            if key in own:
                first = own[key].key_line
                raise _RefusedError(
                    line, full, f"is given twice (first in line {first})", "keep one"
                )
            own[key] = self.node(value_node, full, line)
        return {**merged, **own}

    def _merged(self, node: yaml.Node, path: str) -> dict[str, Node]:
        sources = node.value if isinstance(node, yaml.SequenceNode) else [node]
        found: dict[str, Node] = {}
        for source in sources:
            child = self.node(source, path, source.start_mark.line + 1)
            if not isinstance(child.value, dict):
                raise _RefusedError(child.line, path, "`<<` must name a map", "merge maps only")
            found = {**child.value, **found}
        return found

    def _key(self, node: yaml.Node, path: str) -> str:
        line = node.start_mark.line + 1
        if not isinstance(node, yaml.ScalarNode):
            raise _RefusedError(line, path, "a list or a map cannot be a key", "write text")
        value = self._scalar(node, path)
        if not isinstance(value, str):
            raise _RefusedError(
                line,
                path,
                f"the key {shown(node.value)} is not text in YAML",
                f'put it in quotes: `"{shown(node.value)[1:-1]}":`',
            )
        return value

    def _scalar(self, node: yaml.ScalarNode, path: str) -> str | int | float | bool | None:
        text: str = node.value
        line = node.start_mark.line + 1
        if node.tag in _AS_WRITTEN:
            if any(c == "\0" or "\ud800" <= c <= "\udfff" for c in text):
                raise _RefusedError(line, path, "holds a character that is not text", "remove it")
            return text
        if node.tag not in _CONVERTED:
            raise _tagged(node, path)
        if len(text) > MAX_NUMBER:
            raise _RefusedError(line, path, f"{shown(text)} is too long a number", "shorten it")
        try:
            value: str | int | float | bool | None = self._loader.construct_object(node)
        except (ValueError, LookupError, AttributeError, ArithmeticError):
            kind = node.tag.removeprefix(_TAG)
            what = f"{shown(text)} cannot be read as `{kind}`"
            raise _RefusedError(line, path, what, "remove the tag, or correct the value") from None
        return value


def _expect(node: yaml.Node, path: str, kind: str) -> None:
    if node.tag != _TAG + kind:
        raise _tagged(node, path)


def _tagged(node: yaml.Node, path: str) -> _RefusedError:
    tag = shown(node.tag.replace(_TAG, "!!"))
    return _RefusedError(
        node.start_mark.line + 1, path, f"the tag {tag} is not allowed", "remove it"
    )


def _too_many(line: int) -> _RefusedError:
    what = f"the file holds more than {MAX_NODES} values, aliases expanded"
    return _RefusedError(line, "", what, "a pool file is short; is this the right file?")


def _problem(error: yaml.MarkedYAMLError) -> str:
    words = (part for part in (error.problem, error.context) if part)
    return shown(", ".join(words) or "unknown problem", 160)[1:-1]


def _hint(error: yaml.MarkedYAMLError) -> str:
    problem = error.problem or ""
    if "'\\t'" in problem:
        return "indent with spaces: YAML allows no tabs"
    if "mapping values are not allowed" in problem:
        return "put a text that contains `: ` in quotes, and check the indentation"
    if "single document" in (error.context or ""):
        return "keep one document: remove the second `---`"
    if "undefined alias" in problem:
        return "define it with `&` first, or put a text that begins with `*` in quotes"
    return "check this line's indentation, colons, quotes and brackets"
