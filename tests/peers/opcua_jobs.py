"""Uses Job Control (OPC 10031-4) of ua-mes as an asyncua client.

    opcua_jobs.py URL PROCESS

Prints a JSON line for each command: its name, the ReturnStatus, and the states of the job orders.
The last line has the results of the first job order.
"""

import asyncio
import dataclasses
import sys

from asyncua import Client, ua

import lifetime

NAMESPACE = "http://opcfoundation.org/UA/ISA95-JOBCONTROL_V2/"
COMMENT = ua.Variant([], ua.VariantType.LocalizedText, is_array=True)


def order(name, process):
    master = ua.ISA95WorkMasterDataType()
    master.ID, master.Description, master.Parameters = process, None, None
    made = ua.ISA95JobOrderDataType()
    for field in dataclasses.fields(made):
        if field.name != "Encoding":
            setattr(made, field.name, None)
    made.JobOrderID, made.WorkMasterID = name, [master]
    return made


async def named(node, name):
    for child in await node.get_children():
        if (await child.read_browse_name()).Name == name:
            return child
    raise LookupError(name)


async def run(url, process):
    async with Client(url) as client:
        await client.load_data_type_definitions()
        index = await client.get_namespace_index(NAMESPACE)
        component = await named(client.nodes.objects, "mes")
        receiver = await named(component, "JobOrderReceiver")
        provider = await named(component, "JobResponseProvider")
        listed = await named(receiver, "JobOrderList")

        async def states():
            orders = await listed.read_value() or []
            return {one.JobOrder.JobOrderID: one.State[0].StateNumber for one in orders}

        async def call(name, first):
            status = await receiver.call_method(f"{index}:{name}", first, COMMENT)
            lifetime.say(call=name, status=status, states=await states())

        async def ended(name):
            # 5 is Ended, 6 is Aborted.
            while (await states())[name] not in (5, 6):
                await asyncio.sleep(0.05)

        async def interrupted(name):
            while (await states())[name] != 4:
                await asyncio.sleep(0.05)

        await call("Store", order("one", process))
        await call("Store", order("two", "urn:nothing"))
        await call("Stop", "one")
        await call("Start", "one")
        await call("Clear", "one")
        await ended("one")
        await call("StoreAndStart", order("three", process))
        await call("Pause", "three")
        await interrupted("three")
        await call("Resume", "three")
        await call("Stop", "three")
        await ended("three")
        response, status = await provider.call_method(
            f"{index}:RequestJobResponseByJobOrderID", "one"
        )
        await call("Clear", "three")
        data = [one.ID for one in response.JobResponseData or []]
        lifetime.say(status=status, state=response.JobState[0].StateNumber, data=data)


lifetime.bound(60)
asyncio.run(run(*sys.argv[1:3]))
