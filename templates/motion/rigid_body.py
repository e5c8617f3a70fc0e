"""Find a way for a rigid body with OMPL: RRT-Connect in SE(3), which samples at random.

The same question takes some milliseconds at one time and some seconds at another. The work is
counted in validity checks too, which do not depend on the machine.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou
from scenes import Collisions, Scene

Pose = tuple[float, float, float, float, float, float, float]  # x y z, then the turn as x y z w
RESOLUTION = 0.015  # distance between two tests of a motion, in parts of the scene's size


@dataclass(frozen=True)
class Way:
    """What a search found: poses from start to goal, none if it was stopped before."""

    poses: Sequence[Pose]
    checks: int


class Planner:
    """Plans in one scene. Holds no state between two plans."""

    def __init__(self, scene: Scene) -> None:
        ou.setLogLevel(ou.LogLevel.LOG_ERROR)
        self._collisions = Collisions(scene)
        self._space = _space(scene)

    def plan(self, start: Pose, goal: Pose, stop: Callable[[], bool]) -> Way:
        """Search until a way is found or `stop` says so."""
        checks = 0
        setup = og.SimpleSetup(self._space)
        information = setup.getSpaceInformation()

        def valid(state: ob.State) -> bool:
            nonlocal checks
            checks += 1
            return information.satisfiesBounds(state) and self._free(state)

        setup.setStateValidityChecker(valid)
        information.setStateValidityCheckingResolution(RESOLUTION)
        setup.setStartAndGoalStates(self._state(start), self._state(goal))
        setup.setPlanner(og.RRTConnect(information))
        setup.solve(ob.PlannerTerminationCondition(stop))
        if not setup.haveExactSolutionPath():
            return Way((), checks)
        return Way([_pose(state) for state in setup.getSolutionPath().getStates()], checks)

    def fault(self, poses: Sequence[Pose], start: Pose, goal: Pose) -> str:
        """Say what is wrong with a way from start to goal; nothing if it is right.

        Motions are tested where the search tests them, so that a right answer passes.
        """
        if len(poses) < 2:
            return "there is no way in the answer"
        for end, wanted in ((poses[0], start), (poses[-1], goal)):
            # Written so that not-a-number is wrong.
            if not max(abs(a - b) for a, b in zip(end, wanted, strict=True)) < 1e-6:
                return f"it ends at {end}, not at {wanted}"
        states = [self._state(pose) for pose in poses]
        between = self._space.allocState()
        for number, (a, b) in enumerate(pairwise(states)):
            steps = max(1, self._space.validSegmentCount(a, b))
            for step in range(steps + 1):
                self._space.interpolate(a, b, step / steps, between)
                if not (self._space.satisfiesBounds(between) and self._free(between)):
                    return f"its part {number} touches what stands there, or leaves the scene"
        return ""

    def _free(self, state: ob.State) -> bool:
        x, y, z, *turn = _pose(state)
        return self._collisions.free((x, y, z), (turn[3], *turn[:3]))

    def _state(self, pose: Pose) -> ob.State:
        state = self._space.allocState()
        state.setXYZ(*pose[:3])
        turn = state.rotation()
        turn.x, turn.y, turn.z, turn.w = pose[3:]
        return state


def unturned(position: Sequence[float]) -> Pose:
    """Return the pose at a position, not turned."""
    x, y, z = position
    return (x, y, z, 0.0, 0.0, 0.0, 1.0)


def _space(scene: Scene) -> ob.SE3StateSpace:
    space = ob.SE3StateSpace()
    bounds = ob.RealVectorBounds(3)
    for axis in range(3):
        bounds.setLow(axis, scene.low[axis])
        bounds.setHigh(axis, scene.high[axis])
    space.setBounds(bounds)
    space.setLongestValidSegmentFraction(RESOLUTION)
    space.setup()
    return space


def _pose(state: ob.State) -> Pose:
    turn = state.rotation()
    return (state.getX(), state.getY(), state.getZ(), turn.x, turn.y, turn.z, turn.w)
