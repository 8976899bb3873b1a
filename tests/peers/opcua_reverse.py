"""Waits for a server that connects to its client (OPC 10000-6, 7.1.2.6), and reads a value as
asyncua does, over the connection of the server.

It prints the ReverseHello of each connection, and the value.
"""

import argparse
import asyncio
import struct

from asyncua import Client

import lifetime


async def reverse_hello(connection):
    """Returns the fields of the first message of a server."""
    reader, _ = connection
    kind, size = struct.unpack("<4sI", await reader.readexactly(8))
    body = await reader.readexactly(size - 8)
    texts = []
    while body:
        (length,) = struct.unpack_from("<i", body)
        texts.append(body[4 : 4 + length].decode())
        body = body[4 + length :]
    return {"kind": kind.decode(), "texts": texts}


async def pipe(reader, writer):
    while data := await reader.read(65536):
        writer.write(data)
        await writer.drain()
    writer.close()


async def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("port", type=int)
    parser.add_argument("node")
    parser.add_argument("--limit", type=float, default=60.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    connections = asyncio.Queue()
    listener = await asyncio.start_server(
        lambda reader, writer: connections.put_nowait((reader, writer)), "127.0.0.1", args.port
    )
    lifetime.say(ready=True)
    connection = await connections.get()
    lifetime.say(**await reverse_hello(connection))
    reader, writer = connection

    async def forward(own_reader, own_writer):
        await asyncio.gather(pipe(own_reader, writer), pipe(reader, own_writer))

    own = await asyncio.start_server(forward, "127.0.0.1", 0)
    port = own.sockets[0].getsockname()[1]
    async with Client(f"opc.tcp://127.0.0.1:{port}") as client:
        lifetime.say(value=await client.get_node(args.node).read_value())
    lifetime.say(again=await reverse_hello(await connections.get()))
    listener.close()


asyncio.run(main())
