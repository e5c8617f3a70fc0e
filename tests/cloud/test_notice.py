"""Preemption notices: what each cloud says is heard once, and silence is no news."""

from __future__ import annotations

import json
import queue
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogft.cloud import notice
from fogft.cloud import notice_formats as formats
from fogft.cloud.notice import Watch
from fogft.cloud.notice_formats import Notice, NoticeKind
from fogft.errors import CloudError
from tests.cloud.fake_metadata import FakeMetadata, serving

REBALANCE, PREEMPTION = NoticeKind.REBALANCE, NoticeKind.PREEMPTION
WITHIN_S = 30.0


class Heard:
    """Starts watches and keeps what they tell."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self._patch = patch
        self.notices: queue.Queue[Notice] = queue.Queue()
        self.watches: list[Watch] = []

    def watch(self, source: str, metadata: str = "127.0.0.1:1") -> None:
        self._patch.setattr(notice, "METADATA", metadata)
        self.watches.append(Watch(source, self.notices.put))

    def next(self) -> Notice:
        return self.notices.get(timeout=WITHIN_S)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(notice, "POLL_S", 0.01)
    monkeypatch.setattr(notice, "FILE_POLL_S", 0.01)


@pytest.fixture
def heard(monkeypatch: pytest.MonkeyPatch) -> Iterator[Heard]:
    heard = Heard(monkeypatch)
    yield heard
    for one in heard.watches:
        one.close()


def give(fake: FakeMetadata) -> None:
    fake.action = {"action": "terminate", "time": "2026-01-01T00:02:00Z"}
    fake.preempted = "TRUE"
    fake.events = [
        {"EventType": "Preempt", "Resources": ["vm-7"], "EventStatus": "Scheduled",
         "NotBefore": "Thu, 01 Jan 2026 00:02:00 GMT"}
    ]  # fmt: skip


@pytest.mark.parametrize("cloud", ["aws", "gcp", "azure"])
@pytest.mark.parametrize("auto", [False, True])
def test_a_notice_is_heard_once(heard: Heard, cloud: str, auto: bool):
    """However often the cloud repeats it, and whether or not the cloud was named."""
    with serving(cloud) as fake:
        heard.watch("auto" if auto else cloud, fake.address)
        fake.wait_for_questions(4)
        assert heard.notices.empty()
        give(fake)
        notice = heard.next()
        fake.wait_for_questions(4)
        assert (notice.kind, notice.source) == (PREEMPTION, cloud)
        assert notice.at in (None, 1767225720.0)
        assert (notice.at is None) == (cloud == "gcp")
        assert heard.notices.empty()


def test_a_rebalance_comes_first_and_the_preemption_still_comes(heard: Heard):
    with serving("aws") as fake:
        heard.watch("aws", fake.address)
        fake.rebalance = {"noticeTime": "2026-01-01T00:00:00Z"}
        assert heard.next().kind is REBALANCE
        give(fake)
        assert heard.next().kind is PREEMPTION


def test_a_token_that_is_no_longer_good_is_renewed(heard: Heard):
    with serving("aws") as fake:
        heard.watch("aws", fake.address)
        fake.wait_for_questions(3)
        fake.token = "token-2"
        give(fake)
        assert heard.next().kind is PREEMPTION


def test_errors_of_the_metadata_server_are_no_notice_and_are_outlived(heard: Heard):
    with serving("gcp") as fake:
        heard.watch("gcp", fake.address)
        fake.wait_for_questions(2)
        fake.status = 503
        fake.wait_for_questions(2)
        assert heard.notices.empty()
        fake.status = None
        give(fake)
        assert heard.next().kind is PREEMPTION


def test_events_of_other_machines_are_not_ours(heard: Heard):
    with serving("azure") as fake:
        give(fake)
        fake.events[0]["Resources"] = ["vm-8"]
        heard.watch("azure", fake.address)
        fake.wait_for_questions(4)
        assert heard.notices.empty()


def test_no_proxy_of_the_environment_is_asked(heard: Heard, monkeypatch: pytest.MonkeyPatch):
    """The address is the machine's own: a proxy would speak of another machine, if at all."""
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:1")
    with serving("gcp") as fake:
        give(fake)
        heard.watch("gcp", fake.address)
        assert heard.next().kind is PREEMPTION


@pytest.mark.parametrize(
    ("cloud", "variable", "form"),
    [
        ("aws", "AWS_EC2_METADATA_SERVICE_ENDPOINT", "http://{}/"),
        ("gcp", "GCE_METADATA_HOST", "{}"),
    ],
)
def test_the_environment_says_where_the_metadata_server_is(
    heard: Heard, monkeypatch: pytest.MonkeyPatch, cloud: str, variable: str, form: str
):
    """By the variables that the clouds' own clients read."""
    with serving(cloud) as fake:
        monkeypatch.setenv(variable, form.format(fake.address))
        give(fake)
        heard.watch(cloud)
        assert heard.next().kind is PREEMPTION


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("", Notice(PREEMPTION, None, "file")),
        ('{"action": "terminate", "at": 12.5}', Notice(PREEMPTION, 12.5, "file")),
        ('{"action": "rebalance"}', Notice(REBALANCE, None, "file")),
        ("half a docum", Notice(PREEMPTION, None, "file")),
        ("[1]", Notice(PREEMPTION, None, "file")),
    ],
)
def test_a_file_that_appears_is_a_notice(
    heard: Heard, tmp_path: Path, content: str, expected: Notice
):
    path = tmp_path / "notice.json"
    heard.watch(f"file:{path}")
    path.with_suffix(".new").write_text(content)
    path.with_suffix(".new").rename(path)
    assert heard.next() == expected


def test_where_there_is_no_metadata_server_nothing_is_heard(monkeypatch: pytest.MonkeyPatch):
    """`auto` on a robot or a workstation is silent, and its thread ends when told to."""
    told: list[Notice] = []
    before = set(threading.enumerate())
    monkeypatch.setattr(notice, "METADATA", "127.0.0.1:1")
    one = Watch("auto", told.append)
    [thread] = set(threading.enumerate()) - before
    one.close()
    thread.join(WITHIN_S)
    assert not thread.is_alive()
    assert not told


@pytest.mark.parametrize("source", ["", "ibm", "file:", "AWS"])
def test_an_unknown_source_is_refused_with_the_known_ones(source: str):
    with pytest.raises(CloudError) as caught:
        Watch(source, lambda notice: None)
    assert "`auto`" in caught.value.hint


def test_where_no_thread_can_start_it_says_what_to_check(monkeypatch: pytest.MonkeyPatch):
    def start(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", start)
    with pytest.raises(OSError, match="check `ulimit -u`"):
        Watch("auto", lambda notice: None)


READERS: list[Callable[[str], Any]] = [
    formats.aws_action,
    formats.aws_rebalance,
    formats.gcp_preempted,
    lambda body: formats.azure_events(body, "vm"),
    formats.file_notice,
]
documents = st.one_of(
    st.text(),
    st.recursive(
        st.none() | st.booleans() | st.floats() | st.text(),
        lambda inner: (
            st.lists(inner)
            | st.dictionaries(
                st.sampled_from(["action", "time", "Events", "EventType", "at", "Resources"])
                | st.text(),
                inner | st.just("Preempt"),
            )
        ),
    ).map(json.dumps),
)


@given(documents, st.sampled_from(READERS))
def test_no_answer_can_break_the_watch(body: str, read: Callable[[str], Any]):
    """Whatever a metadata server says, the reader returns a notice or none."""
    assert read(body) is None or isinstance(read(body), Notice)


@pytest.mark.parametrize("status", ["Completed", "Canceled"])
def test_azure_events_that_are_over_are_no_notice(status: str):
    body = json.dumps({"Events": [{"EventType": "Preempt", "EventStatus": status}]})
    assert formats.azure_events(body, "vm") is None


def test_an_aws_action_of_unknown_form_is_still_a_notice():
    """The address exists only when there is one."""
    assert formats.aws_action("<html>") == Notice(
        PREEMPTION, None, "aws", "spot instance action: unknown"
    )
    assert formats.aws_action('{"action": "none"}') is None
