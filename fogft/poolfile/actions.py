"""An action as the three services and two topics that it is proxied as. Pure."""

from __future__ import annotations

from fogft.model.spec import CONCURRENCY_LIMIT, Part, ServiceSpec
from fogft.model.topic import ActionSpec, Origin, Select, TopicSpec


def action_services(action: ActionSpec) -> tuple[ServiceSpec, ...]:
    """Return the three services of an action."""

    def one(end: str, type: str, part: Part, seconds: float, concurrency: int) -> ServiceSpec:
        name = f"{action.name}/_action/{end}"
        return ServiceSpec(name, type, seconds, concurrency=concurrency, part=part)

    accepted_s, type = action.timeout_s, action.type
    return (
        one("send_goal", f"{type}_SendGoal", Part.GOAL, accepted_s, 0),
        one("cancel_goal", "action_msgs/srv/CancelGoal", Part.CANCEL, accepted_s, 0),
        # It is answered when its goal ends: many wait there without being at work.
        one(
            "get_result",
            f"{type}_GetResult",
            Part.RESULT,
            action.result_timeout_s,
            CONCURRENCY_LIMIT,
        ),
    )


def action_topics(action: ActionSpec) -> tuple[TopicSpec, ...]:
    """Return the two topics of an action."""
    feedback, status = f"{action.name}/_action/feedback", f"{action.name}/_action/status"
    of_status = "action_msgs/msg/GoalStatusArray"
    return (
        TopicSpec(feedback, f"{action.type}_FeedbackMessage", Origin.REPLICAS, Select.GOAL),
        TopicSpec(status, of_status, Origin.REPLICAS, Select.STATUS, depth=1, latched=True),
    )
