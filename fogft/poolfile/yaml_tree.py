"""Parse YAML into a tree with the line of every key and value.

PyYAML's own loader drops lines, keeps the last of two equal keys, and expands aliases without
limit. The resulting tree can be written as JSON: dates stay text, as written.
"""

import yaml

from fogft.errors import SpecError
from fogft.poolfile.tree import Node, shown

MAX_NODES = 20_000
MAX_DEPTH = 40
MAX_NUMBER = 60  # characters; a longer one cannot be a setting, and takes time to convert
_TAG = "tag:yaml.org,2002:"
_AS_WRITTEN = {_TAG + "str", _TAG + "timestamp", _TAG + "value"}
_CONVERTED = {_TAG + "null", _TAG + "bool", _TAG + "int", _TAG + "float"}


def tree(text: str, file: str) -> Node:
    """Return a document's tree."""
    loader: _Loader | None = None
    try:
        loader = _Loader(text, file)
        return loader.document()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else 1
        words = ", ".join(filter(None, (error.problem, error.context))) or "unknown problem"
        what = f"not YAML: {shown(words, 160)[1:-1]}"
        raise SpecError(f"{file}:{line}: {what}", _hint(error)) from None
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        what = f"character {ascii(chr(error.character))[1:-1]} is not allowed"
        raise SpecError(f"{file}:{line}: not YAML: {what}", "remove it") from None
    # PyYAML lets ValueError, OverflowError and others escape on odd input such as
    # "\UFFFFFFFF". Whatever the error is, the file caused it.
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError) as error:
        line = loader.line + 1 if loader else 1
        what = shown(error, 120)[1:-1]
        raise SpecError(f"{file}:{line}: not YAML: {what}", "check this line's syntax") from None


class _Loader(yaml.SafeLoader):
    """Turns PyYAML's nodes into `Node`. Aliases are expanded and counted."""

    def __init__(self, text: str, file: str) -> None:
        super().__init__(text)
        self._file = file
        self._depth = 0
        self._composed = 0
        self._made = 0
        self._open: set[int] = set()

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        self._composed += 1
        self._depth += 1
        line = self.line + 1
        if self._depth > MAX_DEPTH:
            raise self._error(line, "", f"nested deeper than {MAX_DEPTH} levels", "flatten it")
        self._check_count(self._composed, line)
        node: yaml.Node | None = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def document(self) -> Node:
        root = self.get_single_node()
        if root is None:
            raise self._error(1, "", "the file is empty", "`fogft init` writes a working example")
        return self._node(root, "", root.start_mark.line + 1)

    def _error(self, line: int, path: str, what: str, hint: str) -> SpecError:
        key = f" {shown(path, 80)[1:-1]}:" if path else ""
        return SpecError(f"{self._file}:{line}:{key} {what}", hint)

    def _check_count(self, nodes: int, line: int) -> None:
        if nodes > MAX_NODES:
            what = f"the file holds more than {MAX_NODES} values, aliases expanded"
            raise self._error(line, "", what, "a pool file is short; is this the right file?")

    def _node(self, node: yaml.Node, path: str, key_line: int) -> Node:
        line = node.start_mark.line + 1
        self._made += 1
        self._check_count(self._made, line)
        if isinstance(node, yaml.ScalarNode):
            return Node(self._scalar(node, path), line, key_line)
        if id(node) in self._open:
            raise self._error(line, path, "contains itself through an alias", "write it out")
        is_map = isinstance(node, yaml.MappingNode)
        if node.tag != _TAG + ("map" if is_map else "seq"):
            raise self._tagged(node, path)
        self._open.add(id(node))
        value = self._map(node, path) if is_map else self._list(node, path)
        self._open.discard(id(node))
        return Node(value, line, key_line)

    def _list(self, node: yaml.Node, path: str) -> tuple[Node, ...]:
        return tuple(
            self._node(child, f"{path}[{index}]", child.start_mark.line + 1)
            for index, child in enumerate(node.value)
        )

    def _map(self, node: yaml.Node, path: str) -> dict[str, Node]:
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
                what = f"is given twice (first in line {own[key].key_line})"
                raise self._error(line, full, what, "keep one")
            own[key] = self._node(value_node, full, line)
        return {**merged, **own}

    def _merged(self, node: yaml.Node, path: str) -> dict[str, Node]:
        sources = node.value if isinstance(node, yaml.SequenceNode) else [node]
        found: dict[str, Node] = {}
        for source in sources:
            child = self._node(source, path, source.start_mark.line + 1)
            if not isinstance(child.value, dict):
                raise self._error(child.line, path, "`<<` must name a map", "merge maps only")
            found = {**child.value, **found}
        return found

    def _key(self, node: yaml.Node, path: str) -> str:
        line = node.start_mark.line + 1
        if not isinstance(node, yaml.ScalarNode):
            raise self._error(line, path, "a list or a map cannot be a key", "write text")
        value = self._scalar(node, path)
        if not isinstance(value, str):
            what = f"the key {shown(node.value)} is not text in YAML"
            hint = f'put it in quotes: `"{shown(node.value)[1:-1]}":`'
            raise self._error(line, path, what, hint)
        return value

    def _scalar(self, node: yaml.ScalarNode, path: str) -> str | int | float | bool | None:
        text: str = node.value
        line = node.start_mark.line + 1
        if node.tag in _AS_WRITTEN or (":" in text and node.tag in _CONVERTED):  # not base 60
            if any(c == "\0" or "\ud800" <= c <= "\udfff" for c in text):
                raise self._error(line, path, "holds a character that is not text", "remove it")
            return text
        if node.tag not in _CONVERTED:
            raise self._tagged(node, path)
        if len(text) > MAX_NUMBER:
            raise self._error(line, path, f"{shown(text)} is too long a number", "shorten it")
        try:
            value: str | int | float | bool | None = self.construct_object(node)
        except (ValueError, LookupError, AttributeError, ArithmeticError):
            what = f"{shown(text)} cannot be read as `{node.tag.removeprefix(_TAG)}`"
            hint = "remove the tag, or correct the value"
            raise self._error(line, path, what, hint) from None
        return value

    def _tagged(self, node: yaml.Node, path: str) -> SpecError:
        what = f"the tag {shown(node.tag.replace(_TAG, '!!'))} is not allowed"
        return self._error(node.start_mark.line + 1, path, what, "remove it")


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
