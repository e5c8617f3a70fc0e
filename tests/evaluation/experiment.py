"""What an experiment of the evaluation is: the interface between experiments and the frame.

Owns: the vocabulary. Not here: running trials (`running`), files (`samples`), words (`report`).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from tests.evaluation.pools import Pools

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tests.estimates import Estimate
    from tests.evaluation.samples import Samples

Value = float | int | str | bool
Row = dict[str, Value]
Run = Callable[[str, int], Row]
T = TypeVar("T")


@dataclass(frozen=True)
class Scale:
    """How much is run: `quick` to see that it runs, `normal`, or `full` as in the paper."""

    name: str

    def choose(self, *, quick: T, normal: T, full: T) -> T:
        """Return the value for this scale."""
        return {"quick": quick, "normal": normal, "full": full}[self.name]


@dataclass
class Stage:
    """What a session has at hand.

    Attributes:
        scale: How much is run.
        options: Values of the experiment's own arguments; those not given are missing.
        folder: An empty folder, removed after the session.
        say: Shows a line beside the progress bars.
    """

    scale: Scale
    options: Mapping[str, str]
    folder: Path
    say: Callable[[str], None] = print

    @contextlib.contextmanager
    def pools(self, name: str = "pools") -> Iterator[Pools]:
        """Yield a place for pools with its own `FOGFT_HOME` and ROS domain; end them after it."""
        folder = self.folder / name
        folder.mkdir()
        pools = Pools(folder)
        try:
            yield pools
        finally:
            pools.close()


@dataclass(frozen=True)
class Finding:
    """One figure of the paper beside ours.

    Attributes:
        what: What it is a figure of.
        paper: As the paper prints it; "-" where it has none.
        ours: Ours; an `Estimate` is shown with its interval.
        unit: Behind both, such as `x` for a ratio.
        why: Why ours differs, in whole sentences. Empty only where it does not.
    """

    what: str
    paper: str
    ours: Estimate | str
    unit: str = "x"
    why: str = ""


@dataclass(frozen=True)
class Table:
    """A table of the report: cells are shown as they are."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]


class Experiment(Protocol):
    """See docs/design/evaluation.md for the meaning of each member."""

    name: str
    title: str
    claim: str
    method: str
    modules: Mapping[str, str]
    options: Mapping[str, str]
    fields: Sequence[str]
    measures: Sequence[str]
    whole: bool

    def trials(self, scale: Scale) -> Mapping[str, int]:
        """Return the number of trials by condition, in the order in which they are shown.

        A condition's name is that of its file: lower-case letters, digits and dashes.
        """

    def session(self, stage: Stage) -> contextlib.AbstractContextManager[Run]:
        """Make everything ready; yield what runs one trial of one condition."""

    def findings(self, samples: Samples) -> Sequence[Finding]:
        """Compare with the paper. Called only with all conditions complete."""

    def tables(self, samples: Samples) -> Sequence[Table]:
        """Return tables beside that of the measures."""

    def figures(self, samples: Samples) -> Mapping[str, Figure]:
        """Draw. Called only with all conditions complete."""


@dataclass
class Defaults:
    """To inherit from: what most experiments do not need."""

    modules: Mapping[str, str] = field(default_factory=dict)
    options: Mapping[str, str] = field(default_factory=dict)
    measures: Sequence[str] = ("latency_s",)
    whole: bool = False

    def tables(self, samples: Any) -> Sequence[Table]:
        """Return none."""
        return ()
