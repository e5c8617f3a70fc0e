"""``fogft rendezvous --config FILE``: run a rendezvous in the foreground.

Records on disk save callers a moment after a restart; without them, callers send all again.
"""

import asyncio
import contextlib
import logging
import os
import time
from pathlib import Path

from fogft import disk
from fogft.errors import StateError
from fogft.metrics.scrape import Scrape
from fogft.model.proxy_config import RendezvousConfig
from fogft.pool.manager.tally import of_rendezvous
from fogft.poolfile import config_file
from fogft.process import Watchdog, ending_signals, notify, start_log
from fogft.records import cache
from fogft.records.exchange import Exchange
from fogft.records.expiry import Expiry
from fogft.records.record_set import RecordSet
from fogft.records.server import RendezvousServer
from fogft.records.signing import Verifier

log = logging.getLogger(__name__)

_SAVE_EVERY_S = 0.5


def run(path: Path, *, listen: str | None = None, metrics: str | None = None) -> None:
    """Run a rendezvous with a configuration file until a signal ends it."""
    config = config_file.read(RendezvousConfig, path, {"listen": listen, "metrics": metrics})
    start_log()
    asyncio.run(_Rendezvous(config).live())


class _Rendezvous:
    def __init__(self, config: RendezvousConfig) -> None:
        self._config = config
        self._status = disk.Report(config.status) if config.status else None
        self._expiry = Expiry(config.credentials.certificate)
        verify = Verifier(config.credentials.ca)
        self._records = RecordSet(config.pool_uid, verify)
        cache.restore(config.records, self._records, config.credentials.ca)
        self._news = asyncio.Event()
        self._reported = ""
        self._trouble = ""
        self._server = RendezvousServer(
            config.listen, config.credentials, verify, Exchange(self._records, self._news.set)
        )

    async def live(self) -> None:
        loop = asyncio.get_running_loop()
        stop = asyncio.Event()
        for number in ending_signals():
            loop.add_signal_handler(number, stop.set)
        self._server.bind()
        log.info("rendezvous_listening endpoint=%s pid=%d", self._server.endpoint, os.getpid())
        scrape = Scrape(
            lambda: of_rendezvous(self._server.report()), {"pool_uid": self._config.pool_uid}
        )
        scrape.at(self._config.metrics)
        serving, watchdog = loop.create_task(self._server.serve()), Watchdog()
        notify("READY=1")
        try:
            while not stop.is_set() and not serving.done():
                self._save()
                watchdog.work()
                self._expiry.look()
                with contextlib.suppress(asyncio.TimeoutError):
                    await asyncio.wait_for(stop.wait(), _SAVE_EVERY_S)
        finally:
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)
            self._save()
            scrape.close()
            log.info("rendezvous_stopped")

    def _save(self) -> None:
        try:
            if self._news.is_set():
                cache.write(self._config.records, self._records.lacking({}))
                self._news.clear()
            report = {"pid": os.getpid(), "endpoint": self._server.endpoint}
            report.update(self._server.report())
            if self._status is not None and str(report) != self._reported:
                self._status.write({**report, "written_at": time.time()})
                self._reported = str(report)
            self._trouble = ""
        except StateError as error:
            if error.message != self._trouble:
                self._trouble = error.message
                log.error("file_failed reason=%r", error.message)
