"""The experiments that run, in the order of the paper. A line each; loaded when needed."""

from __future__ import annotations

import importlib

from tests.evaluation.experiment import Experiment

# Name -> module with an object `EXPERIMENT`.
MODULES = {
    "planning": "tests.evaluation.experiments.planning",
    "detection": "tests.evaluation.experiments.detection",
    "segmentation": "tests.evaluation.experiments.segmentation",
    "picking": "tests.evaluation.experiments.picking",
    "costs": "tests.evaluation.experiments.costs",
    "failures": "tests.evaluation.experiments.failures",
    "overhead": "tests.evaluation.experiments.overhead",
    "uplink": "tests.evaluation.experiments.uplink",
    "recovery": "tests.evaluation.experiments.recovery",
    "markets": "tests.evaluation.experiments.markets",
}


def load(name: str) -> Experiment:
    """Return an experiment by name."""
    found: Experiment = importlib.import_module(MODULES[name]).EXPERIMENT
    return found
