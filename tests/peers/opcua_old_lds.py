"""Runs asyncua's discovery server without RegisterServer2, like discovery servers before OPC UA
1.03, which only have RegisterServer."""

import argparse
import asyncio

from asyncua import Server, ua
from asyncua.common.utils import ServiceError
from asyncua.server.uaprocessor import UaProcessor

import lifetime

NEW = ua.NodeId(ua.ObjectIds.RegisterServer2Request_Encoding_DefaultBinary)
process = UaProcessor._process_message


async def old(self, typeid, requesthdr, seqhdr, body):
    if typeid == NEW:
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)
    return await process(self, typeid, requesthdr, seqhdr, body)


async def run(endpoint):
    UaProcessor._process_message = old
    server = Server()
    await server.init()
    server.set_endpoint(endpoint)
    async with server:
        lifetime.say(ready=True)
        await asyncio.Event().wait()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("endpoint")
    parser.add_argument("--limit", type=float, default=60.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    asyncio.run(run(args.endpoint))


main()
