"""Reads the history of nodes of an OPC UA server.

It takes a JSON list of queries and prints a JSON line for each, after all continuation points.
Times are milliseconds since 2023-11-14T22:13:20Z, statuses of values are the whole StatusCode.
"""

import argparse
import asyncio
import datetime
import json

from asyncua import ua

import lifetime
import opcua_session

EPOCH = datetime.datetime(2023, 11, 14, 22, 13, 20, tzinfo=datetime.timezone.utc)
NONE = ua.get_win_epoch()


def when(milliseconds):
    return NONE if milliseconds is None else EPOCH + datetime.timedelta(milliseconds=milliseconds)


def since(time):
    if time is None:
        return None
    time = time if time.tzinfo else time.replace(tzinfo=datetime.timezone.utc)
    return round((time - EPOCH) / datetime.timedelta(milliseconds=1))


def details_of(question):
    if "at" in question:
        details = ua.ReadAtTimeDetails()
        details.ReqTimes = [when(time) for time in question["at"]]
        return details
    if "aggregate" in question:
        details = ua.ReadProcessedDetails()
        details.ProcessingInterval = float(question["interval"])
        kind = getattr(ua.ObjectIds, f"AggregateFunction_{question['aggregate']}")
        details.AggregateType = [ua.NodeId(kind)]
        details.AggregateConfiguration.UseServerCapabilitiesDefaults = True
    else:
        details = ua.ReadRawModifiedDetails()
        details.IsReadModified = False
        details.NumValuesPerNode = question.get("count", 0)
        details.ReturnBounds = question.get("bounds", False)
    details.StartTime, details.EndTime = when(question.get("start")), when(question.get("end"))
    return details


async def asked(client, question):
    node = client.get_node(question["node"])
    if "attribute" in question:
        answer = await node.read_attribute(ua.AttributeIds[question["attribute"]], raise_on_bad_status=False)
        return {"status": answer.StatusCode.name, "value": opcua_session.plain(answer.Value.Value)}
    if "property" in question:
        value = await (await node.get_child(f"0:{question['property']}")).read_value()
        return {"value": opcua_session.plain(value)}
    if question.get("children"):
        names = [(await child.read_browse_name()).Name for child in await node.get_children()]
        return {"children": sorted(names)}
    parameters = ua.HistoryReadParameters()
    parameters.HistoryReadDetails = details_of(question)
    parameters.TimestampsToReturn = ua.TimestampsToReturn.Both
    # With True the server would only release the continuation points.
    parameters.ReleaseContinuationPoints = False
    values, answers, point = [], 0, None
    while True:
        wanted = ua.HistoryReadValueId()
        wanted.NodeId, wanted.IndexRange, wanted.ContinuationPoint = node.nodeid, "", point
        parameters.NodesToRead = [wanted]
        (result,) = await client.uaclient.history_read(parameters)
        answers += 1
        if result.HistoryData is not None:
            for data in getattr(result.HistoryData, "DataValues", None) or []:
                value = data.Value.Value if data.Value is not None else None
                values.append([since(data.SourceTimestamp), opcua_session.plain(value), data.StatusCode.value])
        point = result.ContinuationPoint
        if not point:
            return {"status": result.StatusCode.name, "answers": answers, "values": values}


async def main():
    parser = argparse.ArgumentParser()
    opcua_session.add_arguments(parser)
    parser.add_argument("questions")
    args = parser.parse_args()
    lifetime.bound(args.limit)
    async with await opcua_session.client_of(args) as client:
        for question in json.loads(args.questions):
            lifetime.say(**await asked(client, question))


asyncio.run(main())
