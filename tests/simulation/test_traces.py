"""Recorded traces: what is read from them, and what is told of broken ones."""

from __future__ import annotations

import json

import pytest

from fogft.errors import FogftError
from fogft.model.replica import Placement
from fogft.simulation import traces
from fogft.simulation.market import Market, changes
from fogft.simulation.model import Timing
from fogft.simulation.timeline import PER_USD, of_samples

PLACES = [Placement("local", "us-west-2", zone, "cpu4") for zone in "ab"]


def trace(data=(1, 1, 0, 1), gap_s=300, **more):
    return {"metadata": {"gap_seconds": gap_s}, "data": list(data), **more}


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([], r"\[\] is not a map"),
        ({"data": [1]}, "metadata: is missing"),
        (trace(gap_s=0), "metadata.gap_seconds: 0.0 is not from 0.001"),
        (trace(data=[]), "data: the trace is empty"),
        (trace(data=[1, None, 1]), r"data\[1\]: the trace has a gap"),
        (trace(data=[1, -1]), r"data\[1\]: -1.0 is not from 0"),
        (trace(data=[1, "up"]), r"data\[1\]: .up. is not of type `float`"),
        (trace(data=[1, True]), r"data\[1\]: True is not of type `float`"),
        (trace(data=[1, 0.5]), r"data\[1\]: 0.5 is not a number of machines"),
        (trace(data=[1, float("nan")]), r"data\[1\]: nan is out of range"),
        (trace(times=[0, 300]), "times: must be a list as long as `data`"),
        (trace(times=[0, 300, 200, 500]), r"times\[2\]: -100 s after the sample before it"),
        (trace(times=[0, 300, 1500, 1800]), r"times\[2\]: 1200 s after the sample before it"),
    ],
)
def test_a_broken_trace_is_told_with_its_place(value, message):
    with pytest.raises(FogftError, match=message):
        traces.parse(value, "x.json")


def test_samples_hold_until_the_next():
    line = traces.parse(trace(times=[10, 309, 611, 911]), "x.json")
    assert line.changes == ((0.0, 1), (600.0, 0), (900.0, 1))
    assert line.length_s == 1200
    assert [line.capacity(at) for at in (0, 599, 600, 899, 900)] == [1, 1, 0, 0, 1]


def write(folder, name, value=None):
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(trace() if value is None else value))


@pytest.mark.parametrize(
    "name",
    [
        "local/us-west-2/a.json",
        "us-west-2a_v100_1.json",
        "us-west-2-a.json",
        "1-node/aws-02-15-2023/us-west-2a_v100_1.json",
        "preemption/1-node/aws-04-22-2023/us-west-2a_v100_1.json",
    ],
)
def test_a_file_s_name_tells_its_location(tmp_path, name):
    write(tmp_path, name)
    assert list(traces.located(traces.read(tmp_path), PLACES)) == ["local/us-west-2/a"]


def test_traces_of_different_gaps_are_told(tmp_path):
    write(tmp_path, "us-west-2a.json")
    write(tmp_path, "us-west-2b.json", trace() | {"metadata": {"gap_seconds": 600}})
    with pytest.raises(FogftError, match="gap_seconds is 600, but 300"):
        traces.located(traces.read(tmp_path), PLACES)


def test_a_region_that_does_not_exist_is_told(tmp_path):
    write(tmp_path, "us-wets-2a.json")
    with pytest.raises(FogftError, match="no location `us-wets-2a`") as caught:
        traces.located(traces.read(tmp_path), PLACES)
    assert caught.value.hint == "did you mean `us-west-2a`?"


def test_two_traces_of_one_zone_are_told(tmp_path):
    write(tmp_path, "us-west-2a_k80_1.json")
    write(tmp_path, "us-west-2a_v100_1.json")
    with pytest.raises(FogftError, match=r"is for `local/us-west-2/a`, like .*k80"):
        traces.located(traces.read(tmp_path), PLACES)


def test_a_zone_of_two_clouds_is_told(tmp_path):
    write(tmp_path, "us-west-2a.json")
    both = [*PLACES, Placement("other", "us-west-2", "us-west-2a", "m1")]
    with pytest.raises(FogftError, match="could be `local/us-west-2/a` or `other/"):
        traces.located(traces.read(tmp_path), both)


def test_a_folder_without_traces_and_no_folder_are_told(tmp_path):
    with pytest.raises(FogftError, match="there is no trace"):
        traces.read(tmp_path)
    with pytest.raises(FogftError, match="is not a folder"):
        traces.read(tmp_path / "none")


def test_prices_are_those_beside_the_samples_where_a_file_has_them(tmp_path):
    """As published: some files of a folder have them, others do not."""
    write(tmp_path, "us-west-2a_v100_1.json", trace(prices=[0.9, 0.9, 1.2, 0.9]))
    write(tmp_path, "us-west-2b_v100_1.json")
    [priced] = traces.read(tmp_path, PER_USD)
    assert priced.timeline.changes == ((0.0, 900_000), (600.0, 1_200_000), (900.0, 900_000))
    assert len(traces.read(tmp_path)) == 2


def test_a_file_that_is_not_json_is_told(tmp_path):
    (tmp_path / "a.json").write_text('{"data": [1, ')
    with pytest.raises(FogftError, match=r"a\.json: is not JSON"):
        traces.read(tmp_path)


def test_a_loss_is_announced_but_not_before_the_room_was_there():
    """Room for 300 s cannot be announced as lost 600 s before it ends."""
    line = of_samples([0, 1, 0, 0, 1, 1, 1, 0], 300)
    market = Market(lambda resources: [], {"c/r/z": line}, Timing(notice_s=400))
    found = [(c.at_s, c.capacity, c.ends_s) for c in changes(market, 1.0)]
    assert found == [
        (0, 0, 0),
        (300, 1, 300),
        (300, 0, 600),
        (1200, 1, 1200),
        (1700, 0, 2100),
    ]
