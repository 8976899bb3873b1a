"""amqtt, a broker of MQTT 3.1.1, at 127.0.0.1:1883 for everybody."""

import asyncio
import json

from amqtt.broker import Broker

CONFIGURATION = {
    "listeners": {"default": {"type": "tcp", "bind": "127.0.0.1:1883"}},
    "plugins": {"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}},
}


async def main():
    broker = Broker(CONFIGURATION)
    await broker.start()
    print(json.dumps({"ready": True}), flush=True)
    await asyncio.Event().wait()


asyncio.run(main())
