"""Other robots: their poses are received over their own Zenoh endpoints, and published on ``state/peers``."""

from typing import Final

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import Clock, Schedule
from monstertruck_runtime.errors import NoAnswerError
from monstertruck_runtime.mailbox import latest
from monstertruck_runtime.ports import Publisher, Ready
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.state import Odometry, Peer, Peers
from monstertruck_schemas.topics import GATE, PEERS, POSE
from monstertruckd.bus.zenoh_config import PeerConfig

SILENT: Final = 5.0
"""Maximum age of a pose before the other robot is lost (s)."""


class PeerService:
    """Publishes the latest poses of other robots at a steady rate, with the time of receipt.

    Args:
        clock: time source.
        out: publisher for ``state/peers``.
    """

    name = ServiceName.PEERS.value

    def __init__(self, clock: Clock, out: Publisher[Peers]) -> None:
        self._clock, self._out = clock, out
        self._heard: dict[str, Peer] = {}

    def hear(self, robot: str, pose: Odometry) -> None:
        """Process the latest pose of another robot."""
        self._heard[robot] = Peer(
            robot=robot,
            pose=pose.pose,
            twist=pose.twist,
            deviation=pose.position_deviation,
            heard=self._clock.now(),
        )

    async def run(self, ready: Ready) -> None:
        """Publish until cancelled."""
        ready()
        assert PEERS.rate is not None
        schedule = Schedule(self._clock, PEERS.rate)
        while True:
            await schedule.next()
            now = self._clock.now()
            message = Peers(
                stamp=now, received=now, seq=self._out.next_seq(), frame="map", peers=tuple(self._heard.values())
            )
            self._out.put(message)


class PeerSubscriber:
    """Receives the poses of one other robot; ready when the first pose arrives.

    Args:
        robot: name of the robot.
        config: address of the robot.
        clock: time source.
        peers: service that receives its poses.
    """

    def __init__(self, robot: str, config: PeerConfig, clock: Clock, peers: PeerService) -> None:
        self.name = f"peer_{robot}"
        self._robot, self._config, self._clock, self._peers = robot, config, clock, peers

    async def run(self, ready: Ready) -> None:
        """Listen until cancelled.

        Raises:
            NotFoundError: no robot answers at the address, or none with this name.
            NoAnswerError: the robot has published no pose for 5 s.
        """
        endpoint = self._config.endpoint
        async with TruckClient(self._robot, endpoint, clock=self._clock) as client:
            with client.subscribe(POSE, latest()) as poses:
                while (pose := await poses.next_within(SILENT)) is not None:
                    ready()
                    self._peers.hear(self._robot, pose)
            await client.get_retained(GATE)  # names the robot there
            raise NoAnswerError(f"robot {self._robot!r} at {endpoint} has published no pose for {SILENT:g} s")
