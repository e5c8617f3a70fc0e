"""Fit a market model to recorded traces.

Owns: the estimates. MTTF and MTTR are the total times with and without room, divided by how often
such a spell ended (the maximum likelihood of an exponential, including the last, unfinished
spells). Correlations are means over pairs of locations; `together` is the share of losses in which
another zone of the region was lost at the same time. `regime_s` is not estimated.
"""

import itertools
import math
from bisect import bisect_left
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace

from fogft.errors import FogftError
from fogft.simulation.model import MAX_CORRELATION, MarketModel, rates
from fogft.simulation.timeline import Timeline


def fit(timelines: Mapping[str, Timeline]) -> MarketModel:
    """Return the model of some locations' timelines.

    If no pair of locations shows the correlation within a region or a cloud, that of the other is
    used; between clouds, 0. Negative ones become 0, and no wider domain's exceeds a narrower one's.
    """
    means = _means(timelines.values())
    for mean, what in zip(means, ("full", "free"), strict=True):
        if mean is None:
            raise FogftError(
                f"the traces cannot be fitted: no location ever becomes {what}",
                "omit `--fit` to replay them as they are",
            )
    mttf_s, mttr_s = (mean or 0.0 for mean in means)
    region, cloud, world = _correlations(timelines)
    region = cloud if region is None else region
    cloud = region if cloud is None else cloud
    region = min(MAX_CORRELATION, max(0.0, region or 0.0))
    cloud = min(region, max(0.0, cloud or 0.0))
    return MarketModel(
        mttf_s=mttf_s,
        mttr_s=mttr_s,
        correlation_region=region,
        correlation_cloud=cloud,
        correlation_world=min(cloud, max(0.0, world or 0.0)),
        together=_together(timelines),
    )


def feasible(model: MarketModel) -> MarketModel:
    """Return a feasible model: if needed, all its correlations are lowered by the same factor."""
    for percent in range(100, 0, -1):
        share = percent / 100
        lower = replace(
            model,
            correlation_region=share * model.correlation_region,
            correlation_cloud=share * model.correlation_cloud,
            correlation_world=share * model.correlation_world,
        )
        with suppress(FogftError):
            rates(lower)
            return lower
    return replace(model, correlation_region=0.0, correlation_cloud=0.0, correlation_world=0.0)


def of_zones(timelines: Mapping[str, Timeline]) -> dict[str, tuple[float, float]]:
    """Return the MTTF and MTTR of each location that became both full and free."""
    found: dict[str, tuple[float, float]] = {}
    for place, line in timelines.items():
        mttf_s, mttr_s = _means([line])
        if mttf_s is not None and mttr_s is not None:
            found[place] = mttf_s, mttr_s
    return found


def _means(timelines: Iterable[Timeline]) -> tuple[float | None, ...]:
    """Return the mean times with and without room; None for one that never ended."""
    spells = [(*spell, line.length_s) for line in timelines for spell in line.spells()]
    means = []
    for room in (True, False):
        ended = sum(end < length_s for has_room, _, end, length_s in spells if has_room is room)
        whole_s = sum(end - begin for has_room, begin, end, _ in spells if has_room is room)
        means.append(whole_s / ended if ended else None)
    return tuple(means)


def _together(timelines: Mapping[str, Timeline]) -> float:
    """Return how likely a free zone is lost at the moment when another one of its region is."""
    met = lost = 0
    for one, other in itertools.permutations(sorted(timelines), 2):
        if one.rsplit("/", 1)[0] != other.rsplit("/", 1)[0]:
            continue
        there, until_s = timelines[other], timelines[other].length_s
        times = [at for at, _ in there.changes]
        for at, capacity in timelines[one].changes[1:]:
            if capacity or at >= until_s:
                continue
            index = bisect_left(times, at)
            if index and there.changes[index - 1][1]:
                met += 1
                lost += index < len(times) and times[index] == at and not there.changes[index][1]
    return lost / met if met else 0.0


def _correlations(timelines: Mapping[str, Timeline]) -> tuple[float | None, ...]:
    found: dict[str, list[float]] = {"region": [], "cloud": [], "world": []}
    for one, other in itertools.combinations(sorted(timelines), 2):
        value = correlation(timelines[one], timelines[other])
        if value is None:
            continue
        (cloud, region, _), (cloud2, region2, _) = one.split("/"), other.split("/")
        domain = "world" if cloud != cloud2 else "cloud" if region != region2 else "region"
        found[domain].append(value)
    return tuple(sum(v) / len(v) if v else None for v in found.values())


def correlation(one: Timeline, other: Timeline) -> float | None:
    """Return the correlation of two locations' capacity over shared time; None if constant."""
    length_s = min(one.length_s, other.length_s)
    a, b = one.window(0, length_s), other.window(0, length_s)
    free_s = [[end - begin for room, begin, end in x.spells() if room] for x in (a, b)]
    mean_a, mean_b = (sum(spells) / length_s for spells in free_s)
    spread = mean_a * (1 - mean_a) * mean_b * (1 - mean_b)
    if spread <= 0:
        return None
    changes = sorted((at, which, n) for which, line in enumerate((a, b)) for at, n in line.changes)
    both_s, since_s, room = 0.0, 0.0, [0, 0]
    for at, which, n in [*changes, (length_s, 0, 0)]:
        if all(room):
            both_s += at - since_s
        since_s, room[which] = at, n
    return (both_s / length_s - mean_a * mean_b) / math.sqrt(spread)
