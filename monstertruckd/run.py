"""``monstertruckd run``: one daemon on the wall clock as a process."""

import asyncio
import faulthandler
import logging
import os
import signal
from pathlib import Path

from monstertruck_runtime import wire
from monstertruck_runtime.clock import Clock, run_wall
from monstertruck_runtime.errors import PortBusyError, first_of
from monstertruck_runtime.map_folders import tidy
from monstertruck_runtime.memory import settle
from monstertruck_runtime.small_files import remove_leftovers
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.topics import TOPICS
from monstertruckd.assembly.catalogs import TABLES
from monstertruckd.config.load import load_config
from monstertruckd.config.start import started
from monstertruckd.config.truck import TruckConfig
from monstertruckd.daemon import Daemon
from monstertruckd.host.logging_queue import start_logging

log = logging.getLogger(__name__)


def run_daemon(config_file: Path, *, verbose: bool) -> Reason:
    """Run the daemon of ``config_file`` until SIGTERM or SIGINT; returns why it ended.

    Raises:
        ConfigError: the configuration was refused, or its calibration is of another truck.
        BusyError: another daemon runs this robot or holds the endpoint.
        PortBusyError: another process holds an actuator's port.
    """
    config, tree, left_out = started(*load_config(config_file, TruckConfig))
    faulthandler.enable()
    listener = start_logging(verbose=verbose)
    log.info("calibration: %s", tree.calibration or f"none in {config.calibration_folder}")
    if tree.unused:
        text = "%s: ignored, because the configuration has no such part: %s"
        log.warning(text, tree.calibration, ", ".join(tree.unused))
    clean_up(config)
    for table in TABLES:
        for broken in table.broken:
            log.warning("plug-in skipped: %s", broken)

    async def main(clock: Clock) -> None:
        stop = asyncio.Event()
        for number in (signal.SIGTERM, signal.SIGINT):
            asyncio.get_running_loop().add_signal_handler(number, stop.set)
        daemon = Daemon(config, clock, tree=tree, environment=os.environ, left_out=left_out)
        for topic in TOPICS:
            wire.schema(topic)  # built once, before the control tick would wait for it
        settle()
        await daemon.run(stop)

    try:
        run_wall(main)
    except BaseExceptionGroup as group:
        if (busy := first_of(group, PortBusyError)) is not None:
            raise busy from None
        log.exception("ended by a bug; the actuators were stopped")
        return Reason.INTERNAL
    finally:
        listener.stop()
    return Reason.OK


def clean_up(config: TruckConfig) -> None:
    """Remove the unfinished files of killed programs from the folders of state; what cannot be removed stays."""
    folders = [(remove_leftovers, config.state_directory), (remove_leftovers, config.calibration_folder)]
    if config.slam is not None and config.slam.save is not None:
        folders.append((tidy, config.slam.save))
    for clean, folder in folders:
        try:
            for file in clean(folder):
                log.info("%s: removed, left by a program that was killed while writing it", file)
        except OSError as error:
            log.warning("%s: files of killed programs cannot be removed: %s", folder, error.strerror)
