"""Read recorded spot traces, and match them to locations.

A trace is a JSON file: ``{"metadata": {"gap_seconds": 300}, "data": [1, 1, 0, ...]}``; each
sample is the number of machines available then. Optional: ``times``, the seconds at which the
samples were taken, used to find gaps and clock jumps; ``prices``, one per sample: if any file of a
folder has them, prices are read from these, and files without them are ignored.

Its location is its path below the folder, ``aws/us-west-2/us-west-2b.json``, or the zone
alone, ``us-west-2b_v100_1.json``: the part from the first underscore on is ignored.

Not here: the use of traces (`comparison`).
"""

import itertools
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from fogft.errors import FogftError
from fogft.model.plain import stored, within
from fogft.model.replica import Placement
from fogft.poolfile.tree import nearest
from fogft.simulation.timeline import Timeline, of_samples

FORMAT = 'a trace is `{"metadata": {"gap_seconds": 300}, "data": [1, 1, 0, ...]}`'
MAX_BYTES = 64 << 20


@dataclass(frozen=True)
class Trace:
    """One trace file."""

    file: str
    place: str  # ``cloud/region/zone``, or the zone alone
    gap_s: float
    timeline: Timeline


@dataclass(frozen=True)
class _Metadata:
    gap_seconds: Annotated[float, within(1e-3, 1e9)]


@dataclass(frozen=True)
class _Written:
    metadata: _Metadata
    data: tuple[Annotated[float, within(0, 1e15)] | None, ...]
    times: tuple[float, ...] | None = None


def read(folder: Path, per_unit: int = 1) -> list[Trace]:
    """Read every ``.json`` file in and below a folder; an invalid trace is an error.

    `per_unit` is the factor that samples are multiplied by: 1 for machines, `PER_USD` for prices.
    """
    if not folder.is_dir():
        raise FogftError(f"{folder}: is not a folder of traces", FORMAT)
    try:
        files = sorted(path for path in folder.rglob("*.json") if path.is_file())
    except OSError as error:
        raise FogftError(f"{folder}: cannot be read: {error.strerror}") from None
    if not files:
        raise FogftError(f"{folder}: there is no trace (`*.json`) in it", FORMAT)
    found = [(path, _loaded(path)) for path in files]
    own = [(path, value) for path, value in found if isinstance(value, dict) and "prices" in value]
    if own and per_unit > 1:
        found = [(path, {**value, "data": value["prices"]}) for path, value in own]
    return [_trace(value, path, folder, per_unit) for path, value in found]


def _loaded(path: Path) -> Any:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise FogftError(f"{path}: is larger than {MAX_BYTES >> 20} MiB", FORMAT)
        return json.loads(path.read_bytes())
    except OSError as error:
        raise FogftError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise FogftError(f"{path}: is not JSON: {error}", FORMAT) from None


def _trace(value: Any, path: Path, folder: Path, per_unit: int) -> Trace:
    inner = path.relative_to(folder).with_suffix("").parts
    zone = inner[-1].split("_")[0]
    place = "/".join((*inner[:-1], zone)) if len(inner) == 3 else zone
    timeline = parse(value, str(path), per_unit)
    return Trace(str(path), place, float(value["metadata"]["gap_seconds"]), timeline)


def parse(value: Any, file: str, per_unit: int = 1) -> Timeline:
    """Return the timeline of a trace. Raises FogftError, which names the place in the file."""
    trace = stored(_Written, value, file, FORMAT)
    gap_s = trace.metadata.gap_seconds
    if not trace.data:
        raise FogftError(f"{file}: data: the trace is empty", "remove the file, or record again")
    samples = []
    for index, sample in enumerate(trace.data):
        if sample is None:
            raise FogftError(
                f"{file}: data[{index}]: the trace has a gap here ({gap_s:g} s a sample)",
                "cut the trace before or after it: the state in between is unknown",
            )
        if per_unit == 1 and sample % 1:
            words = f"{file}: data[{index}]: {sample:g} is not a number of machines"
            raise FogftError(words, FORMAT)
        samples.append(round(sample * per_unit))
    if trace.times is not None:
        _check_times(trace.times, len(samples), gap_s, file)
    return of_samples(samples, gap_s)


def _check_times(times: Sequence[float], samples: int, gap_s: float, file: str) -> None:
    if len(times) != samples:
        raise FogftError(
            f"{file}: times: must be a list as long as `data` ({samples})", "or leave it out"
        )
    for index, (before, at) in enumerate(itertools.pairwise(times), start=1):
        if not 0.5 * gap_s <= at - before <= 1.5 * gap_s:
            raise FogftError(
                f"{file}: times[{index}]: {at - before:g} s after the sample before it, where "
                f"`gap_seconds` says {gap_s:g}: a gap or a clock that jumped",
                "cut the trace there: the state in between is unknown",
            )


def located(traces: Iterable[Trace], offered: Sequence[Placement]) -> dict[str, Timeline]:
    """Return the timelines of traces by location.

    `offered` are all placements that are sold, not only those for this pool. Raises FogftError: a
    location is unknown, ambiguous or given twice, or traces differ in `gap_seconds`.
    """
    traces = list(traces)
    found: dict[str, tuple[str, Timeline]] = {}
    for trace in traces:
        places = sorted({p.location for p in offered if trace.place in _names(p)})
        if not places:  # published traces are in folders without cloud and region
            zone = trace.place.rpartition("/")[2]
            places = sorted({p.location for p in offered if zone in _names(p)})
        if not places:
            known = {p.location for p in offered}
            raise FogftError(
                f"{trace.file}: there is no location `{trace.place}` among the {len(known)} that "
                "are offered",
                nearest(trace.place, sorted(known | {p.region + p.zone for p in offered})),
            )
        if len(places) > 1:
            raise FogftError(
                f"{trace.file}: `{trace.place}` could be {' or '.join(f'`{p}`' for p in places)}",
                f"put it in folders: `{places[0]}.json`",
            )
        if places[0] in found:
            raise FogftError(
                f"{trace.file}: is for `{places[0]}`, like {found[places[0]][0]}",
                "keep the trace of the instance type that the pool uses",
            )
        found[places[0]] = trace.file, trace.timeline
    for other in traces[1:]:
        if other.gap_s != traces[0].gap_s:
            raise FogftError(
                f"{other.file}: gap_seconds is {other.gap_s:g}, but {traces[0].gap_s:g} in "
                f"{traces[0].file}",
                "use traces from one recording: others cover different times",
            )
    return {place: timeline for place, (_, timeline) in found.items()}


def _names(placement: Placement) -> set[str]:
    """Return a zone's possible names in traces: clouds prefix it with the region."""
    region, zone = placement.region, placement.zone
    return {placement.location, zone, region + zone, f"{region}-{zone}"}
