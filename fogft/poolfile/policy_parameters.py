"""A service's policy as ROS parameters, each checked by the pool file's own reader. Pure."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeAlias

from fogft.errors import FogftError, SpecError, told
from fogft.model.keys import LONGEST_S, keys_of
from fogft.model.plain import to_plain
from fogft.model.spec import OnTimeout, Part, ServiceSpec
from fogft.poolfile.reader import ADVANCED, Reader
from fogft.poolfile.rules import NOT_WITH_QUORUM, NOT_WITH_STATE, RULES
from fogft.poolfile.tree import Section, tree

Value: TypeAlias = "bool | float | str"
FieldCheck: TypeAlias = "Callable[[str, str], FogftError | None]"  # of a type and a boolean field

KEYS = tuple(entry.name for entry in keys_of(ServiceSpec) if entry.key.parameter)
_ADVANCED = frozenset(entry.name for entry in keys_of(ServiceSpec) if entry.key.advanced)


def prefix(service: str) -> str:
    """Return the prefix of a service's parameters: ``arm.plan`` for ``/arm/plan``."""
    return service.strip("/").replace("/", ".")


def shown(spec: ServiceSpec) -> dict[str, Value]:
    """Return a service's policy as parameters, by key."""
    if spec.part is not Part.NONE:
        return {"timeout_s": spec.timeout_s}
    unfit: Sequence[str] = NOT_WITH_QUORUM if spec.quorum > 1 else ()
    if spec.state is not None:
        unfit = NOT_WITH_STATE
    values = {key: getattr(spec, key) for key in KEYS if key not in unfit}
    values["advertise"] = spec.advertised
    return {key: getattr(value, "value", value) for key, value in values.items()}


def changed(spec: ServiceSpec, values: Mapping[str, Value]) -> ServiceSpec:
    """Return a service's policy with some values changed. Raises ValueError.

    `fallback_service` is dropped if `on_timeout` no longer uses it.
    """
    now = shown(spec)
    news = {key: value for key, value in values.items() if now.get(key) != value}
    unknown = sorted(news.keys() - now.keys())
    if unknown:
        raise ValueError(f"`{spec.name}` has no parameter `{unknown[0]}`")
    if not news:
        return spec
    raw: dict[str, Any] = {**to_plain(spec, omit_defaults=True), **news}
    if raw.get("on_timeout") != OnTimeout.FALLBACK.value:
        raw.pop("fallback_service", None)
    if raw.get("ok_field") == "":
        del raw["ok_field"]
    below = {key: raw.pop(key) for key in _ADVANCED & raw.keys()}
    section = Section("parameter", spec.name, tree({**raw, ADVANCED: below}))
    try:
        if spec.part is not Part.NONE:  # its only parameter
            return replace(spec, timeout_s=section.number("timeout_s", LONGEST_S, "seconds"))
        read: ServiceSpec = Reader(RULES).map(ServiceSpec, section)
    except SpecError as error:
        key = error.key.removeprefix(f"{spec.name}.").removeprefix(f"{ADVANCED}.")
        raise ValueError(told(SpecError(f"{key}: {error.what}", error.hint))) from None
    return replace(read, traffic=spec.traffic)


class Policies:
    """The pool file's services, overridden by parameters.

    A parameter that was set applies until the pool file changes that key.
    """

    def __init__(self, check_field: FieldCheck = lambda kind, field: None) -> None:
        self._check_field = check_field
        self._file: dict[str, ServiceSpec] = {}
        self._set: dict[str, dict[str, Value]] = {}

    def follow(self, specs: Iterable[ServiceSpec]) -> None:
        """Set the pool file's services."""
        new = {spec.name: spec for spec in specs}
        for name, values in list(self._set.items()):
            if name not in new:
                del self._set[name]
                continue
            before, after = shown(self._file[name]), shown(new[name])
            for key in [k for k in values if k not in after or before.get(k) != after[k]]:
                del values[key]
            try:
                changed(new[name], values)
            except ValueError:  # the parameters conflict with the new file
                values.clear()
        self._file = new

    def set(self, values: Mapping[str, Value]) -> None:
        """Set parameters by their full names: all of them, or none. Raises ValueError."""
        by_prefix = {prefix(name): name for name in self._file}
        wanted: dict[str, dict[str, Value]] = {}
        for full, value in values.items():
            head, _, key = full.rpartition(".")
            if head not in by_prefix or key not in KEYS:
                raise ValueError(f"there is no parameter `{full}`")
            wanted.setdefault(by_prefix[head], {})[key] = value
        merged = {name: {**self._set.get(name, {}), **news} for name, news in wanted.items()}
        for name, news in merged.items():
            spec = changed(self._file[name], news)
            if spec.ok_field and spec.ok_field != self._file[name].ok_field:
                found = self._check_field(spec.type, spec.ok_field)
                if found is not None:
                    raise ValueError(f"{prefix(name)}.ok_field: {told(found)}")
        self._set.update(merged)

    def services(self) -> tuple[ServiceSpec, ...]:
        """Return the services with parameters applied."""
        return tuple(changed(s, self._set.get(name, {})) for name, s in self._file.items())

    def parameters(self) -> dict[str, Value]:
        """Return every parameter by its full name, with its value."""
        return {
            f"{prefix(spec.name)}.{key}": value
            for spec in self.services()
            for key, value in shown(spec).items()
        }
