"""An ordinary ROS 2 service of its own type: `/count_words` counts words and letters."""

from __future__ import annotations

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from word_interfaces.srv import CountWords


class Counter(Node):
    def __init__(self) -> None:
        super().__init__("counter")
        self.create_service(CountWords, "/count_words", self._answer)

    def _answer(
        self, request: CountWords.Request, response: CountWords.Response
    ) -> CountWords.Response:
        response.words = len(request.text.split())
        response.letters = sum(letter.isalpha() for letter in request.text)
        return response


def main() -> None:
    rclpy.init()
    try:
        rclpy.spin(Counter())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
