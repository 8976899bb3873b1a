"""Watches the conditions of an OPC UA server as asyncua requests them, and calls their methods.

It prints a JSON line for each event. Each line of standard input is a JSON object:
{"call": "Acknowledge", "condition": NodeId, "event": base64, "comment": text} calls a method of a
condition, {"refresh": true} and {"refresh2": true} refresh the own item, and {"refresh": number}
refreshes that subscription. The status of each call is a JSON line.
"""

import argparse
import asyncio
import base64
import datetime
import json
import sys

from asyncua import ua
from asyncua.common.events import Event, get_filter_from_event_type

import lifetime
import opcua_session

METHODS = {
    "Acknowledge": ua.ObjectIds.AcknowledgeableConditionType_Acknowledge,
    "Confirm": ua.ObjectIds.AcknowledgeableConditionType_Confirm,
    "AddComment": ua.ObjectIds.ConditionType_AddComment,
    "Enable": ua.ObjectIds.ConditionType_Enable,
    "Disable": ua.ObjectIds.ConditionType_Disable,
}
# AlarmConditionType, with the fields of ExclusiveLimitAlarmType and NonExclusiveLimitAlarmType.
ALARMS = ["i=2915", "i=9341", "i=9906"]
FIELDS = {
    "event": "EventId",
    "name": "ConditionName",
    "message": "Message",
    "severity": "Severity",
    "retain": "Retain",
    "active": "ActiveState/Id",
    "acked": "AckedState/Id",
    "confirmed": "ConfirmedState/Id",
    "enabled": "EnabledState/Id",
    "limit": "LimitState/CurrentState",
    "input": "InputNode",
    "high": "HighState/Id",
    "user": "ClientUserId",
    "comment": "Comment",
}
AUDIT = {"condition_event": "ConditionEventId", "comment": "Comment", "user": "ClientUserId", "good": "Status"}


def plain(value):
    if isinstance(value, ua.LocalizedText):
        return value.Text
    return value.to_string() if isinstance(value, ua.NodeId) else opcua_session.plain(value)


class Watch:
    def event_notification(self, event, fields=None):
        values = vars(event)
        condition = getattr(event, "NodeId", None)
        line = {"type": event.EventType.to_string(), "source": event.SourceNode.to_string()}
        fields = fields or (FIELDS if condition else AUDIT)
        for name, field in fields.items():
            value = values.get(field)
            line[name] = plain(value)
        if condition:
            line["condition"] = condition.to_string()
        lifetime.say(**line)


async def call(client, object_, method, arguments):
    request = ua.CallMethodRequest(ObjectId=object_, MethodId=ua.NodeId(method), InputArguments=arguments)
    (result,) = await client.uaclient.call([request])
    lifetime.say(status=result.StatusCode.name)


async def obey(client, subscription, item, line):
    condition_type = ua.NodeId(ua.ObjectIds.ConditionType)
    number = ua.Variant(subscription.subscription_id, ua.VariantType.UInt32)
    if "refresh2" in line:
        arguments = [number, ua.Variant(item, ua.VariantType.UInt32)]
        await call(client, condition_type, ua.ObjectIds.ConditionType_ConditionRefresh2, arguments)
    elif "refresh" in line:
        if line["refresh"] is not True:
            number = ua.Variant(line["refresh"], ua.VariantType.UInt32)
        await call(client, condition_type, ua.ObjectIds.ConditionType_ConditionRefresh, [number])
    else:
        arguments = []
        if "event" in line:
            comment = ua.LocalizedText(line.get("comment", ""), "en")
            arguments = [ua.Variant(base64.b64decode(line["event"])), ua.Variant(comment)]
        await call(client, ua.NodeId.from_string(line["condition"]), METHODS[line["call"]], arguments)


async def past(client, node, kinds, count):
    """Prints the events of the history of a node, oldest first, and the number of responses."""
    details = ua.ReadEventDetails()
    details.StartTime = datetime.datetime(2020, 1, 1)
    details.EndTime = datetime.datetime(2100, 1, 1)
    details.NumValuesPerNode = count
    details.Filter = await get_filter_from_event_type([client.get_node(kind) for kind in kinds])
    wanted = ua.HistoryReadValueId()
    wanted.NodeId = ua.NodeId.from_string(node)
    parameters = ua.HistoryReadParameters()
    parameters.HistoryReadDetails = details
    parameters.TimestampsToReturn = ua.TimestampsToReturn.Both
    parameters.ReleaseContinuationPoints = False
    parameters.NodesToRead = [wanted]
    answers = 0
    while answers == 0 or wanted.ContinuationPoint:
        (result,) = await client.uaclient.history_read(parameters)
        result.StatusCode.check()
        answers += 1
        for one in result.HistoryData.Events:
            event = Event.from_event_fields(details.Filter.SelectClauses, one.EventFields)
            Watch().event_notification(event, FIELDS)
        wanted.ContinuationPoint = result.ContinuationPoint
    notifier = await client.get_node(node).read_attribute(ua.AttributeIds.EventNotifier)
    lifetime.say(answers=answers, notifier=notifier.Value.Value)


async def main():
    parser = argparse.ArgumentParser()
    opcua_session.add_arguments(parser)
    parser.add_argument("--type", action="append", help="alarms and their limits if not given")
    parser.add_argument("--history", type=int, help="read the history, that many events a response")
    parser.add_argument("--node", default="i=2253", help="the Server object if not given")
    args = parser.parse_args()
    lifetime.bound(args.limit)
    async with await opcua_session.client_of(args) as client:
        if args.history is not None:
            await past(client, args.node, args.type or ALARMS, args.history)
            return
        subscription = await client.create_subscription(50, Watch())
        kinds = [client.get_node(kind) for kind in args.type or ALARMS]
        item = await subscription.subscribe_alarms_and_conditions(client.get_node(args.node), kinds)
        lifetime.say(ready=True, subscription=subscription.subscription_id)
        lines = asyncio.Queue()
        loop = asyncio.get_running_loop()
        loop.add_reader(sys.stdin, lambda: lines.put_nowait(sys.stdin.readline()))
        while True:
            line = await lines.get()
            if not line:
                loop.remove_reader(sys.stdin)
                await asyncio.Event().wait()
            await obey(client, subscription, item, json.loads(line))


asyncio.run(main())
