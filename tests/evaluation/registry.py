"""The experiments that run, in the order of the paper. A line each; loaded when needed."""

from __future__ import annotations

import importlib

from tests.evaluation.experiment import Experiment

# Name -> module with an object `EXPERIMENT`.
MODULES = {
    "planning": "tests.evaluation.planning",
    "detection": "tests.evaluation.detection",
    "segmentation": "tests.evaluation.segmentation",
    "picking": "tests.evaluation.picking",
    "costs": "tests.evaluation.costs",
    "failures": "tests.evaluation.failures",
    "overhead": "tests.evaluation.overhead",
    "uplink": "tests.evaluation.uplink",
    "recovery": "tests.evaluation.recovery",
    "markets": "tests.evaluation.markets",
}


def load(name: str) -> Experiment:
    """Return an experiment by name."""
    found: Experiment = importlib.import_module(MODULES[name]).EXPERIMENT
    return found
