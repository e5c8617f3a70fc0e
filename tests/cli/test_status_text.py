"""What stands below the tables of `fogft status`."""

from __future__ import annotations

from dataclasses import replace

from fogft.cli.status_text import notes
from tests.cli.pools import STATUS


def test_the_lines_of_a_log_stand_below_the_note_that_they_explain():
    status = replace(STATUS, notes=("it was never ready\nno module `plan`", "over"), services=())
    assert [line.plain for line in notes(replace(status, excluded=()))] == [
        *("note: it was never ready", "  no module `plan`", "note: over"),
    ]
