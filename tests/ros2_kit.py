"""A client of ROS 2 services over Zenoh with its tokens in the graph, for tests of the other end."""

import asyncio
import json

import zenoh

from monstertruck_runtime.clock import WallClock
from monstertruckd.ros2.cdr import decode, encode
from monstertruckd.ros2.interfaces import type_hash
from monstertruckd.ros2.rmw import Attachment, EntityKind, RosEntity, data_key, dds_name, gid_of, token_key
from monstertruckd.ros2.zenoh_node import session_settings


class ServiceClient:
    """Asks services as ``rmw_zenoh`` does; without a name it has no tokens."""

    def __init__(self, endpoint: str, name: str | None = "asker"):
        self.session = zenoh.open(zenoh.Config.from_json5(json.dumps(session_settings(endpoint, ""))))
        self.name = name
        self._clients = {}
        self._sequence = 0
        self._tokens = []
        if name is not None:
            self._token((0, 0), RosEntity(EntityKind.NODE, "/", name))

    def _token(self, numbers, entity, types=("", "")):
        key = token_key(0, str(self.session.zid()), numbers, entity, types)
        self._tokens.append(self.session.liveliness().declare_token(key))
        return gid_of(key)

    async def ask(self, service, interface, request=None, timeout=60.0):
        if service not in self._clients:
            gid = bytes(range(16))
            if self.name is not None:
                entity = RosEntity(EntityKind.CLIENT, "/", self.name, service, dds_name(interface))
                gid = self._token((0, len(self._clients) + 1), entity, (type_hash(interface), "::,10:,:,:,,"))
            self._clients[service] = gid
            await asyncio.sleep(0.3)  # until the graph has it
        self._sequence += 1
        clock = WallClock()
        attachment = Attachment(self._sequence, clock.now() + clock.real_offset(), self._clients[service])

        def get():
            return list(
                self.session.get(
                    data_key(0, service, interface),
                    payload=encode(f"{interface}_Request", request or {}),
                    attachment=attachment.packed(),
                    target=zenoh.QueryTarget.ALL_COMPLETE,
                    consolidation=zenoh.ConsolidationMode.NONE,
                    timeout=timeout,
                )
            )

        (reply,) = await asyncio.to_thread(get)
        sent = Attachment.parse(reply.ok.attachment.to_bytes())
        assert (sent.sequence, sent.gid) == (attachment.sequence, attachment.gid)
        return decode(f"{interface}_Response", reply.ok.payload.to_bytes())

    def close(self):
        self.session.close()
