"""A client of MQTT 5 by aiomqtt.

Arguments: the filter of its subscription. Each message is a line with topic and payload, a text.
"""

import asyncio
import json
import sys

import aiomqtt


async def main():
    async with aiomqtt.Client("127.0.0.1", 1883, protocol=aiomqtt.ProtocolVersion.V5) as client:
        await client.subscribe(sys.argv[1], qos=1)
        print(json.dumps({"ready": True}), flush=True)
        async for message in client.messages:
            line = {"topic": str(message.topic), "payload": message.payload.decode()}
            print(json.dumps(line), flush=True)


asyncio.run(main())
