"""Judge the `services` section of a pool file."""

from __future__ import annotations

from fogft.model import ros_names
from fogft.model.choices import FallbackSpec, Freshness
from fogft.model.spec import MAX_REPLICAS, Advertise, HedgingMode, OnTimeout, ServiceSpec
from fogft.poolfile.keys import (
    CONCURRENCY_LIMIT,
    DAY_S,
    FALLBACK_KEYS,
    LATER_KEYS,
    SERVICE_KEYS,
    places,
)
from fogft.poolfile.placement import read_traffic
from fogft.poolfile.state import read_state
from fogft.poolfile.tree import Section, shown

_SERVICES_HINT = "write a list, such as `services: [{name: /detect, type: my_msgs/srv/Detect}]`"


def read_services(ours: Section) -> tuple[ServiceSpec, ...]:
    """Return what `services` asks for; nothing where it is left out: then `run` tells.

    Raises:
        SpecError: The first mistake.
    """
    if "services" not in ours.children:
        return ()
    found: dict[str, ServiceSpec] = {}
    lines: dict[str, int] = {}
    for section in ours.sections("services", _SERVICES_HINT):
        section.only(SERVICE_KEYS, later=LATER_KEYS, elsewhere=places(SERVICE_KEYS))
        service = read_service(section)
        if service.name in found:
            raise section.error(
                "name",
                f"`{service.name}` stands here twice (first in line {lines[service.name]})",
                "give each service one entry",
            )
        found[service.name] = service
        lines[service.name] = section.children["name"].line
    return tuple(found.values())


def read_service(section: Section) -> ServiceSpec:
    """Return what one entry of `services` asks for.

    Raises:
        SpecError: The first mistake.
    """
    written = section.text("name", "write the service's name, such as `name: /detect`")
    try:
        name = ros_names.absolute_service_name(written)
    except ValueError as error:
        what = f"{shown(written)} is not a service name: {error}"
        raise section.error("name", what, "write a name such as `/detect`") from None
    ok_field = section.text("ok_field", "name a boolean field of the response", default="")
    if ok_field and not ros_names.is_field_name(ok_field):
        what = f"{shown(ok_field)} is not the name of a field"
        raise section.error("ok_field", what, "name a boolean field, such as `success`")
    _check_stateful(section)
    return ServiceSpec(
        name=name,
        type=_type(section),
        timeout_s=section.number("timeout_s", DAY_S, "seconds", ServiceSpec.timeout_s),
        on_timeout=section.choice("on_timeout", ServiceSpec.on_timeout),
        ok_field=ok_field,
        hedging=section.choice("hedging", ServiceSpec.hedging),
        hedging_budget=_hedging_budget(section),
        replicas=section.whole("replicas", 0, 1, MAX_REPLICAS),
        traffic=read_traffic(section),
        concurrency=_concurrency(section),
        cancel=_other_service(section, "cancel", name, "the name of its cancel service"),
        quorum=_quorum(section),
        tolerance=_tolerance(section),
        state=read_state(section),
        fallback=_fallback(section, name),
        trace=_trace(section),
        uplinks=section.choice("uplinks", ServiceSpec.uplinks),
        freshness=_freshness(section),
        compression=section.choice("compression", ServiceSpec.compression),
        advertise=_advertise(section),
    )


def _freshness(section: Section) -> Freshness:
    wanted = section.choice("freshness", ServiceSpec.freshness)
    if wanted is Freshness.LATEST and section.has("state"):
        what = "cannot be `latest` for a service with `state`: its requests are kept in order"
        raise section.error("freshness", what, "remove it")
    return wanted


def _advertise(section: Section) -> Advertise | None:
    if not section.has("advertise"):
        return None
    wanted = section.choice("advertise", Advertise.WHILE_READY)
    if wanted is Advertise.WHILE_READY and section.has("state"):
        what = "cannot be `while_ready` for a service with `state`: its requests are kept in order"
        raise section.error("advertise", what, "remove it")
    return wanted


def _fallback(section: Section, name: str) -> FallbackSpec | None:
    """Return the fallback, which `on_timeout: fallback` needs and nothing else may have."""
    wanted = section.choice("on_timeout", ServiceSpec.on_timeout) is OnTimeout.FALLBACK
    example = f"such as `fallback: {{service: {name}_onboard}}`"
    if not wanted:
        if "fallback" in section.children:
            raise section.error(
                "fallback", "is not used: `on_timeout` is not `fallback`",
                "write `on_timeout: fallback`, or remove it",
            )  # fmt: skip
        return None
    if "state" in section.children:
        raise section.error(
            "on_timeout", "cannot be `fallback` for a service with `state`: it knows none of it",
            "write `silent` or `empty`",
        )  # fmt: skip
    if not section.has("fallback"):
        hint = f"name a service of the same type on the robot, {example}"
        raise section.error("fallback", "is missing", hint)
    below = section.section("fallback", f"write a map, {example}")
    below.only(FALLBACK_KEYS)
    service = _other_service(below, "service", name, "the name of a service on the robot")
    if not service:
        raise below.error("service", "is missing", f"name a service on the robot, {example}")
    timeout_s = section.number("timeout_s", DAY_S, "seconds", ServiceSpec.timeout_s)
    after_s = below.number("after_s", DAY_S, "seconds", 0.0) or None
    if after_s is not None and after_s >= timeout_s:
        raise below.error(
            "after_s",
            f"must be below `timeout_s`, which is {timeout_s:g}",
            "make it shorter, or remove it: at the deadline the fallback is asked anyway",
        )
    return FallbackSpec(
        service=service,
        after_s=after_s,
        while_none_ready=below.flag("while_none_ready", FallbackSpec.while_none_ready),
        limit_s=below.number("limit_s", DAY_S, "seconds", FallbackSpec.limit_s),
    )


def _trace(section: Section) -> bool:
    wanted = section.flag("trace", ServiceSpec.trace)
    if wanted and "state" in section.children:
        raise section.error("trace", "is not there for a service with `state`", "remove it")
    return wanted


def _concurrency(section: Section) -> int:
    limit = section.whole("concurrency", 0, 1, CONCURRENCY_LIMIT)
    if limit > 1 and "cancel" in section.children:
        raise section.error(
            "concurrency",
            "must be 1 where there is a `cancel` service: that names no request",
            "remove one of the two",
        )
    return limit


def _other_service(section: Section, key: str, of: str, what: str) -> str:
    """Return the name of a service that belongs to this one; empty where there is none."""
    hint = f"write {what}, such as `{key}: {of}_{key}`"
    written = section.text(key, hint, default="")
    if not written:
        return ""
    try:
        name = ros_names.absolute_service_name(written)
    except ValueError as error:
        raise section.error(key, f"{shown(written)} is not a service name: {error}", hint) from None
    if name == of:
        raise section.error(key, "is the service itself", hint)
    return name


def _quorum(section: Section) -> int:
    if "quorum" not in section.children:
        return ServiceSpec.quorum
    for key in ("ok_field", "hedging", "cancel"):
        if section.has(key) and section.children[key].value != HedgingMode.ALL.value:
            what = "does not go with `quorum`: every replica is asked, and every answer counts"
            raise section.error(key, what, "remove it")
    return section.whole("quorum", 2, 2, MAX_REPLICAS)


def _tolerance(section: Section) -> tuple[tuple[str, float], ...]:
    if "tolerance" not in section.children:
        return ()
    if "quorum" not in section.children:
        what = "has no meaning here: answers are compared only with a `quorum`"
        raise section.error("tolerance", what, "write `quorum: 2`, or remove it")
    by_field = section.section("tolerance", "write `tolerance: {plan.cost: 0.01}`")
    for path in by_field.children:
        if not all(map(ros_names.is_field_name, path.split("."))):
            what = f"{shown(path)} is not the path of a field"
            raise by_field.error(path, what, "write a path such as `plan.cost`", at_key=True)
    unit = "the field's own"
    return tuple((path, by_field.number(path, 1e12, unit)) for path in by_field.children)


def _check_stateful(section: Section) -> None:
    """A stateful service is asked of every replica, and its first answer is the answer."""
    if not section.has("state"):
        return
    for key in ("ok_field", "hedging", "concurrency", "cancel", "quorum", "trace"):
        if section.has(key) and section.children[key].value != HedgingMode.ALL.value:
            what = "does not go with `state`: every replica applies every request"
            raise section.error(key, what, "remove it")


def _hedging_budget(section: Section) -> float:
    budget = section.number(
        "hedging_budget", 1, "extra copies for each request", ServiceSpec.hedging_budget
    )
    adaptive = section.choice("hedging", ServiceSpec.hedging) is HedgingMode.ADAPTIVE
    if "hedging_budget" in section.children and not adaptive:
        raise section.error(
            "hedging_budget",
            "has no meaning here: only `hedging: adaptive` sends extra copies by a budget",
            "write `hedging: adaptive`, or remove it",
        )
    return budget


def _type(section: Section) -> str:
    example = "write `package/srv/Name`, such as `type: std_srvs/srv/SetBool`"
    written = section.text("type", example)
    if ros_names.is_service_type(written):
        return written
    meant = ros_names.suggested_service_type(written)
    raise section.error(
        "type",
        f"{shown(written)} is not a service type",
        f"did you mean `{meant}`?" if meant else example,
    )
