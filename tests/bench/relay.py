"""A TCP relay in front of one replica that can swallow everything, without closing: a blackhole.

python -m tests.bench.relay LISTEN_PORT TARGET_PORT     SIGUSR1 swallows, SIGUSR2 passes again
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import signal
import sys

_CHUNK_BYTES = 256 * 1024


class Relay:
    """Passes bytes while `passing` is set."""

    def __init__(self, target_port: int) -> None:
        self._target_port = target_port
        self.passing = asyncio.Event()
        self.passing.set()

    async def accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Join one connection to the target."""
        await self.passing.wait()
        with contextlib.suppress(OSError):
            far_reader, far_writer = await asyncio.open_connection("127.0.0.1", self._target_port)
            await asyncio.gather(self._pass(reader, far_writer), self._pass(far_reader, writer))

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            while data := await reader.read(_CHUNK_BYTES):
                await self.passing.wait()  # nothing more is read: the sender's buffers fill up
                writer.write(data)
                await writer.drain()
        with contextlib.suppress(OSError):
            writer.close()


async def run(listen_port: int, target_port: int) -> None:
    """Relay until the process is ended."""
    relay = Relay(target_port)
    loop = asyncio.get_running_loop()
    loop.add_signal_handler(signal.SIGUSR1, relay.passing.clear)
    loop.add_signal_handler(signal.SIGUSR2, relay.passing.set)
    server = await asyncio.start_server(relay.accept, "127.0.0.1", listen_port)
    print("ready", flush=True)
    async with server:
        await server.serve_forever()


if __name__ == "__main__":
    ctypes.CDLL(None).prctl(1, signal.SIGKILL, 0, 0, 0)  # die with the bench
    asyncio.run(run(int(sys.argv[1]), int(sys.argv[2])))
