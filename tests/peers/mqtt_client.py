"""A client of MQTT 5 by aiomqtt.

Arguments: the filter of its subscription. Each message is a line with topic and payload, a text.
Each line of standard input is published: {"topic": .., "payload": text}.
"""

import asyncio
import json
import sys

import aiomqtt


async def publish(client):
    lines = asyncio.StreamReader(limit=1 << 20)
    loop = asyncio.get_running_loop()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(lines), sys.stdin)
    while line := await lines.readline():
        order = json.loads(line)
        await client.publish(order["topic"], order["payload"], qos=1)


async def main():
    async with aiomqtt.Client("127.0.0.1", 1883, protocol=aiomqtt.ProtocolVersion.V5) as client:
        await client.subscribe(sys.argv[1], qos=1)
        print(json.dumps({"ready": True}), flush=True)
        publisher = asyncio.create_task(publish(client))
        async for message in client.messages:
            line = {"topic": str(message.topic), "payload": message.payload.decode()}
            print(json.dumps(line), flush=True)
        await publisher


asyncio.run(main())
