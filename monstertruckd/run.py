"""``monstertruckd run``: one daemon on the wall clock as a process."""

import asyncio
import faulthandler
import gc
import logging
import signal
from pathlib import Path

from monstertruck_runtime.clock import Clock, run_wall
from monstertruck_schemas.reasons import Reason
from monstertruckd.config.load import load_truck
from monstertruckd.daemon import Daemon

log = logging.getLogger(__name__)


def run_daemon(config_file: Path, *, verbose: bool) -> Reason:
    """Run the daemon of ``config_file`` until SIGTERM or SIGINT; returns why it ended.

    Raises:
        ConfigError: the configuration was refused.
        BusyError: another daemon runs this robot or holds the endpoint.
    """
    logging.basicConfig(
        level=logging.DEBUG if verbose else logging.INFO, format="%(levelname)-7s %(name)s: %(message)s"
    )
    faulthandler.enable()
    config, tree = load_truck(config_file)

    async def main(clock: Clock) -> None:
        stop = asyncio.Event()
        for number in (signal.SIGTERM, signal.SIGINT):
            asyncio.get_running_loop().add_signal_handler(number, stop.set)
        daemon = Daemon(config, clock, tree=tree)
        # A full collection over everything loaded so far takes tens of milliseconds: take it out of the heap's view.
        gc.collect()
        gc.freeze()
        await daemon.run(stop)

    try:
        run_wall(main)
    except BaseExceptionGroup:
        log.exception("ended by a bug; the actuators were told to stop")
        return Reason.INTERNAL
    return Reason.OK
