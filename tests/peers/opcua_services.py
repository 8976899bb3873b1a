"""Sends requests that a server has to refuse, one row of a table after the other, and prints the
status codes of the responses."""

import argparse
import asyncio
import datetime
import logging

from asyncua import Client, ua
from asyncua.ua.ua_binary import struct_from_binary
from asyncua.ua.uaerrors import UaStatusCodeError

import lifetime

READ_ONLY = ua.NodeId(10, 2)
NUMBER = ua.NodeId(30, 2)
LIST = ua.NodeId(31, 2)
TEXT = ua.NodeId(32, 2)
RANGED = ua.NodeId(33, 2)
UNKNOWN = ua.NodeId(9999, 2)
ELSEWHERE = ua.NodeId(1, 999)
OBJECTS = ua.NodeId(ua.ObjectIds.ObjectsFolder)
SERVER = ua.NodeId(ua.ObjectIds.Server)
SET_DURABLE = ua.NodeId(ua.ObjectIds.Server_SetSubscriptionDurable)
GET_ITEMS = ua.NodeId(ua.ObjectIds.Server_GetMonitoredItems)
TIME = ua.NodeId(ua.ObjectIds.Server_ServerStatus_CurrentTime)
VALUE = ua.AttributeIds.Value
NAME = ua.AttributeIds.DisplayName
NOTIFIER = ua.AttributeIds.EventNotifier

ROWS = []


def row(service, clause, case, expected):
    """Registers a row: an async function of the server under test that returns a response, or a
    part of it."""

    def register(function):
        ROWS.append((service, clause, case, expected, function))
        return function

    return register


def rows(service, clause, cases, request):
    """Registers a row for each case: its name, the expected status and the argument of `request`."""
    for case, expected, argument in cases:
        row(service, clause, case, expected)(lambda server, argument=argument: request(server, argument))


class Server:
    """The sessions of the table with the server."""

    def __init__(self, client, other):
        self.client = client
        self.other = other
        self.subscription = None
        self.item = None

    async def ask(self, name, client=None, **fields):
        """Sends a request, and returns the fields of the response."""
        request = getattr(ua, f"{name}Request")()
        for field, value in fields.items():
            setattr(request.Parameters, field, value)
        return await self.send(request, client or self.client)

    async def send(self, request, client):
        data = await client.uaclient.protocol.send_request(request, 10)
        name = type(request).__name__.replace("Request", "Response")
        response = struct_from_binary(getattr(ua, name), data)
        return getattr(response, "Parameters", None) or response

    async def one(self, name, client=None, **fields):
        """Returns the single result of a response."""
        (result,) = (await self.ask(name, client, **fields)).Results
        return result

    async def subscribed(self, **more):
        fields = {
            "RequestedPublishingInterval": 50.0,
            "RequestedLifetimeCount": 10_000,
            "RequestedMaxKeepAliveCount": 1_000,
            "PublishingEnabled": False,
            **more,
        }
        return (await self.ask("CreateSubscription", **fields)).SubscriptionId

    async def prepare(self):
        self.subscription = await self.subscribed(RequestedPublishingInterval=1_000.0)
        # The first message of a subscription is a keep-alive.
        await self.ask("Publish")
        created = await self.create({})
        created.StatusCode.check()
        self.item = created.MonitoredItemId
        for node, value in ((NUMBER, 1.0), (LIST, [1, 2, 3]), (TEXT, "äbc"), (RANGED, 1.0)):
            (await self.write({"node": node, "value": value})).check()

    async def read(self, wanted):
        node = ua.ReadValueId(
            wanted.get("node", NUMBER),
            wanted.get("attribute", VALUE),
            wanted.get("range"),
            ua.QualifiedName(wanted["encoding"]) if "encoding" in wanted else ua.QualifiedName(),
        )
        return await self.one("Read", NodesToRead=[node], TimestampsToReturn=ua.TimestampsToReturn.Both)

    async def write(self, wanted):
        value = wanted.get("value", 1.0)
        first = value[0] if isinstance(value, list) else value
        kinds = {float: ua.VariantType.Double, int: ua.VariantType.Int32, str: ua.VariantType.String}
        data = ua.DataValue(ua.Variant(value, kinds[type(first)]), ua.StatusCode(wanted.get("status", 0)))
        item = ua.WriteValue(wanted.get("node", NUMBER), wanted.get("attribute", VALUE), wanted.get("range"), data)
        return await self.one("Write", NodesToWrite=[item])

    async def browse(self, wanted, limit=0):
        node = ua.BrowseDescription(
            wanted.get("node", OBJECTS),
            wanted.get("direction", ua.BrowseDirection.Forward),
            wanted.get("reference", ua.NodeId()),
            True,
            0,
            63,
        )
        view = ua.ViewDescription()
        view.ViewId = wanted.get("view", ua.NodeId())
        view.Timestamp = ua.get_win_epoch()
        fields = {"View": view, "RequestedMaxReferencesPerNode": limit, "NodesToBrowse": [node]}
        return await self.one("Browse", **fields)

    async def translate(self, wanted):
        elements = [
            ua.RelativePathElement(ua.NodeId(ua.ObjectIds.HierarchicalReferences), False, True, name)
            for name in wanted["path"]
        ]
        path = ua.BrowsePath(wanted.get("node", OBJECTS), ua.RelativePath(elements))
        return await self.one("TranslateBrowsePathsToNodeIds", BrowsePaths=[path])

    async def call(self, wanted):
        arguments = wanted.get("arguments", [ua.Variant(self.subscription, ua.VariantType.UInt32)])
        method = ua.CallMethodRequest(wanted.get("object", SERVER), wanted.get("method", GET_ITEMS), arguments)
        return await self.one("Call", MethodsToCall=[method])

    async def create(self, wanted):
        parameters = ua.MonitoringParameters()
        parameters.ClientHandle = 1
        parameters.SamplingInterval = wanted.get("sampling", 0.0)
        parameters.QueueSize = wanted.get("queue", 10)
        parameters.DiscardOldest = wanted.get("oldest", True)
        if "filter" in wanted:
            parameters.Filter = wanted["filter"]
        what = ua.ReadValueId(wanted.get("node", NUMBER), wanted.get("attribute", VALUE), wanted.get("range"))
        item = ua.MonitoredItemCreateRequest(what, ua.MonitoringMode.Reporting, parameters)
        return await self.one(
            "CreateMonitoredItems",
            SubscriptionId=wanted.get("subscription", self.subscription),
            TimestampsToReturn=wanted.get("timestamps", ua.TimestampsToReturn.Both),
            ItemsToCreate=[item],
        )

    async def reported(self, wanted, values):
        """Returns the notifications of an item after these values were written at once, as
        `value/status`."""
        (await self.write({"value": 0.0})).check()
        subscription = await self.subscribed()
        created = await self.create({"subscription": subscription, **wanted})
        created.StatusCode.check()
        for value in values:
            (await self.write({"value": value})).check()
        enabled = await self.one("SetPublishingMode", SubscriptionIds=[subscription], PublishingEnabled=True)
        enabled.check()
        response = await self.ask("Publish")
        (await self.one("DeleteSubscriptions", SubscriptionIds=[subscription])).check()
        items = response.NotificationMessage.NotificationData[0].MonitoredItems
        return " ".join(f"{one.Value.Value.Value:g}/{one.Value.StatusCode.value & 0xFFFF:x}" for one in items)


    async def first(self, wanted):
        """Returns the first notification of an item, as `value/status`."""
        subscription = await self.subscribed(PublishingEnabled=True)
        (await self.create({"subscription": subscription, **wanted})).StatusCode.check()
        data = None
        while not data:
            # The first message is a keep-alive.
            data = (await self.ask("Publish")).NotificationMessage.NotificationData
        (await self.one("DeleteSubscriptions", SubscriptionIds=[subscription])).check()
        value = data[0].MonitoredItems[0].Value
        return f"{value.Value.Value:g}/{value.StatusCode.value & 0xFFFF:x}"


def changes(trigger=ua.DataChangeTrigger.StatusValue, kind=0, value=0.0):
    return ua.DataChangeFilter(trigger, kind, value)


def aggregate(name="Average", interval=1_000.0, start=None):
    found = ua.AggregateFilter()
    found.StartTime = start or ua.get_win_epoch()
    found.AggregateType = ua.NodeId(getattr(ua.ObjectIds, f"AggregateFunction_{name}"))
    found.ProcessingInterval = interval
    found.AggregateConfiguration.UseServerCapabilitiesDefaults = True
    return found


def events():
    select = ua.SimpleAttributeOperand()
    select.TypeDefinitionId = ua.NodeId(ua.ObjectIds.BaseEventType)
    select.BrowsePath = [ua.QualifiedName("Message")]
    select.AttributeId = VALUE
    return ua.EventFilter([select], ua.ContentFilter())


NO_ATTRIBUTE = 99
ABSOLUTE, PERCENT = 1, 2

rows(
    "Read",
    "5.11.2",
    [
        ("a value", "Good", {}),
        ("an unknown node", "BadNodeIdUnknown", {"node": UNKNOWN}),
        ("a node of an unknown namespace", "BadNodeIdUnknown", {"node": ELSEWHERE}),
        ("an unknown attribute", "BadAttributeIdInvalid", {"attribute": NO_ATTRIBUTE}),
        ("the value of an object", "BadAttributeIdInvalid", {"node": OBJECTS}),
        ("the attribute of another node class", "BadAttributeIdInvalid", {"attribute": ua.AttributeIds.Executable}),
        ("a malformed index range", "BadIndexRangeInvalid", {"node": LIST, "range": "1:1"}),
        ("an index range with a space", "BadIndexRangeInvalid", {"node": LIST, "range": "0, 1"}),
        ("an index range behind the end", "BadIndexRangeNoData", {"node": LIST, "range": "3"}),
        ("an index range with too many dimensions", "BadIndexRangeNoData", {"node": LIST, "range": "0,0"}),
        ("an index range of a scalar", "BadIndexRangeNoData", {"range": "0"}),
        ("an index range of an attribute without elements", "BadIndexRangeNoData", {"attribute": NAME, "range": "0"}),
        ("an index range of a string", "Good", {"node": TEXT, "range": "0:1"}),
        ("a data encoding of another attribute", "BadDataEncodingInvalid", {"attribute": NAME, "encoding": "Default XML"}),
        ("a data encoding that is not supported", "BadDataEncodingUnsupported", {"encoding": "Default XML"}),
        ("an unknown data encoding", "BadDataEncodingInvalid", {"encoding": "Default Other"}),
    ],
    Server.read,
)
row("Read", "5.11.2", "no nodes", "BadNothingToDo")(lambda server: server.ask("Read"))
row("Read", "5.11.2", "a negative MaxAge", "BadMaxAgeInvalid")(
    lambda server: server.ask("Read", MaxAge=-1.0, NodesToRead=[ua.ReadValueId(NUMBER, VALUE)])
)
row("Read", "5.11.2", "invalid TimestampsToReturn", "BadTimestampsToReturnInvalid")(
    lambda server: server.ask(
        "Read", TimestampsToReturn=ua.TimestampsToReturn.Invalid, NodesToRead=[ua.ReadValueId(NUMBER, VALUE)]
    )
)


@row("Read", "5.11.2", "a malformed index range beside a value", "BadIndexRangeInvalid Good")
async def _(server):
    nodes = [ua.ReadValueId(LIST, VALUE, "x"), ua.ReadValueId(LIST, VALUE)]
    return (await server.ask("Read", NodesToRead=nodes)).Results


@row("Read", "7.40", "timestamps that were not requested", "Good")
async def _(server):
    for node in (NUMBER, TIME):
        wanted = ua.TimestampsToReturn
        for one in (wanted.Source, wanted.Server, wanted.Both, wanted.Neither):
            read = await server.one("Read", TimestampsToReturn=one, NodesToRead=[ua.ReadValueId(node, VALUE)])
            found = (read.SourceTimestamp is not None, read.ServerTimestamp is not None)
            if found != (one in (wanted.Source, wanted.Both), one in (wanted.Server, wanted.Both)):
                return f"{node} {one.name}: {found}"
    return ua.StatusCode()


rows(
    "Write",
    "5.11.4",
    [
        ("a value", "Good", {}),
        ("an unknown node", "BadNodeIdUnknown", {"node": UNKNOWN}),
        ("an unknown attribute", "BadAttributeIdInvalid", {"attribute": NO_ATTRIBUTE}),
        ("the value of an object", "BadAttributeIdInvalid", {"node": OBJECTS}),
        ("the attribute of another node class", "BadAttributeIdInvalid", {"attribute": ua.AttributeIds.Executable}),
        ("an attribute that is not writable", "BadNotWritable", {"attribute": NAME, "value": "x"}),
        ("a value that is not writable", "BadNotWritable", {"node": READ_ONLY}),
        ("a value of the server that is not writable", "BadNotWritable", {"node": TIME}),
        ("a value of another type", "BadTypeMismatch", {"value": "x"}),
        ("an array in place of a scalar", "BadTypeMismatch", {"value": [1.0, 2.0]}),
        ("a scalar in place of an array", "BadTypeMismatch", {"node": LIST, "value": 1}),
        ("a value out of its range", "BadOutOfRange", {"node": RANGED, "value": 11.0}),
        ("a status", "BadWriteNotSupported", {"status": ua.StatusCodes.BadOutOfService}),
        ("a malformed index range", "BadIndexRangeInvalid", {"node": LIST, "value": [9], "range": "1:1"}),
        ("an index range", "Good", {"node": LIST, "value": [8, 9], "range": "1:2"}),
        ("an index range with too few elements", "BadIndexRangeDataMismatch", {"node": LIST, "value": [9], "range": "1:2"}),
        ("an index range with too many elements", "BadIndexRangeDataMismatch", {"node": LIST, "value": [8, 9], "range": "1"}),
        ("an index range behind the end", "BadIndexRangeNoData", {"node": LIST, "value": [8, 9], "range": "2:3"}),
        ("an index range with another type", "BadTypeMismatch", {"node": LIST, "value": ["x"], "range": "1"}),
        ("an index range of a string", "Good", {"node": TEXT, "value": "ü", "range": "0"}),
        ("an index range of a scalar", "BadIndexRangeNoData", {"range": "0"}),
    ],
    Server.write,
)
row("Write", "5.11.4", "no nodes", "BadNothingToDo")(lambda server: server.ask("Write"))


@row("Write", "5.11.4", "the values after all rows", "[1, 8, 9] übc")
async def _(server):
    found = [(await server.read({"node": node})).Value.Value for node in (LIST, TEXT)]
    return f"{found[0]} {found[1]}"


rows(
    "Browse",
    "5.9.2",
    [
        ("an object", "Good", {}),
        ("an unknown node", "BadNodeIdUnknown", {"node": UNKNOWN}),
        ("a node of an unknown namespace", "BadNodeIdUnknown", {"node": ELSEWHERE}),
        ("an unknown reference type", "BadReferenceTypeIdInvalid", {"reference": UNKNOWN}),
        ("a reference type that is an object", "BadReferenceTypeIdInvalid", {"reference": OBJECTS}),
        ("an invalid direction", "BadBrowseDirectionInvalid", {"direction": ua.BrowseDirection.Invalid}),
        ("an unknown view", "BadViewIdUnknown", {"view": UNKNOWN}),
    ],
    Server.browse,
)
row("Browse", "5.9.2", "no nodes", "BadNothingToDo")(lambda server: server.ask("Browse", View=view()))


def view():
    view = ua.ViewDescription()
    view.Timestamp = ua.get_win_epoch()
    return view


async def next_of(server, point, release=False):
    fields = {"ReleaseContinuationPoints": release, "ContinuationPoints": [point]}
    return await server.one("BrowseNext", **fields)


@row("BrowseNext", "5.9.3", "the remaining references", "Good")
async def _(server):
    whole = await server.browse({"node": SERVER})
    first = await server.browse({"node": SERVER}, 2)
    found, point = list(first.References), first.ContinuationPoint
    while point:
        rest = await next_of(server, point)
        rest.StatusCode.check()
        found, point = found + list(rest.References), rest.ContinuationPoint
    same = sorted(str(one.NodeId) for one in found) == sorted(str(one.NodeId) for one in whole.References)
    return whole.StatusCode if same else f"{len(found)} of {len(whole.References)} references"


@row("BrowseNext", "5.9.3", "a released continuation point", "Good BadContinuationPointInvalid")
async def _(server):
    first = await server.browse({"node": SERVER}, 1)
    point = first.ContinuationPoint
    return [await next_of(server, point, True), await next_of(server, point)]


row("BrowseNext", "5.9.3", "an unknown continuation point", "BadContinuationPointInvalid")(
    lambda server: next_of(server, b"other")
)
row("BrowseNext", "5.9.3", "no continuation points", "BadNothingToDo")(lambda server: server.ask("BrowseNext"))

rows(
    "TranslateBrowsePathsToNodeIds",
    "5.9.4",
    [
        ("a path", "Good", {"path": [ua.QualifiedName("Server")]}),
        ("an unknown starting node", "BadNodeIdUnknown", {"node": UNKNOWN, "path": [ua.QualifiedName("Server")]}),
        ("a path without elements", "BadNothingToDo", {"path": []}),
        ("an element without a name", "BadBrowseNameInvalid", {"path": [ua.QualifiedName()]}),
        ("a name that does not exist", "BadNoMatch", {"path": [ua.QualifiedName("Other")]}),
    ],
    Server.translate,
)
row("TranslateBrowsePathsToNodeIds", "5.9.4", "no paths", "BadNothingToDo")(
    lambda server: server.ask("TranslateBrowsePathsToNodeIds")
)
row("RegisterNodes", "5.9.5", "no nodes", "BadNothingToDo")(lambda server: server.ask("RegisterNodes"))
row("UnregisterNodes", "5.9.6", "no nodes", "BadNothingToDo")(lambda server: server.ask("UnregisterNodes"))

rows(
    "Call",
    "5.12.2",
    [
        ("a method", "Good", {}),
        ("an unknown object", "BadNodeIdUnknown", {"object": UNKNOWN}),
        ("an unknown method", "BadMethodInvalid", {"method": UNKNOWN}),
        ("a method of another object", "BadMethodInvalid", {"object": OBJECTS}),
        ("a method that is a variable", "BadMethodInvalid", {"method": TIME}),
        ("no arguments", "BadArgumentsMissing", {"arguments": []}),
        ("too many arguments", "BadTooManyArguments", {"arguments": [ua.Variant(1, ua.VariantType.UInt32)] * 2}),
        ("an argument of another type", "BadInvalidArgument", {"arguments": [ua.Variant("x")]}),
        ("an unknown subscription", "BadSubscriptionIdInvalid", {"arguments": [ua.Variant(1 << 30, ua.VariantType.UInt32)]}),
    ],
    Server.call,
)
row("Call", "5.12.2", "no methods", "BadNothingToDo")(lambda server: server.ask("Call"))


def durable(server, subscription, hours):
    arguments = [ua.Variant(number, ua.VariantType.UInt32) for number in (subscription, hours)]
    return server.call({"method": SET_DURABLE, "arguments": arguments})


@row("Call", "10000-5, 9.3", "lifetimes of durable subscriptions in hours", "1 is 1, 0 is 168, 1000 is 168")
async def _(server):
    subscription, found = await server.subscribed(), []
    for hours in (1, 0, 1_000):
        result = await durable(server, subscription, hours)
        result.StatusCode.check()
        found.append(f"{hours} is {result.OutputArguments[0].Value}")
    return ", ".join(found)


row("Call", "10000-5, 9.3", "a durable subscription with items", "BadInvalidState")(
    lambda server: durable(server, server.subscription, 1)
)
row("Call", "10000-5, 9.3", "an unknown durable subscription", "BadSubscriptionIdInvalid")(
    lambda server: durable(server, 1 << 30, 1)
)

rows(
    "CreateMonitoredItems",
    "5.13.2",
    [
        ("a value", "Good", {}),
        ("an unknown subscription", "BadSubscriptionIdInvalid", {"subscription": 1 << 30}),
        ("invalid TimestampsToReturn", "BadTimestampsToReturnInvalid", {"timestamps": ua.TimestampsToReturn.Invalid}),
        ("an unknown node", "BadNodeIdUnknown", {"node": UNKNOWN}),
        ("an unknown node of namespace 0", "BadNodeIdUnknown", {"node": ua.NodeId(999_999, 0)}),
        ("an unknown attribute", "BadAttributeIdInvalid", {"attribute": NO_ATTRIBUTE}),
        ("the value of an object", "BadAttributeIdInvalid", {"node": OBJECTS}),
        ("the attribute of another node class", "BadAttributeIdInvalid", {"attribute": ua.AttributeIds.Executable}),
        ("a malformed index range", "BadIndexRangeInvalid", {"node": LIST, "range": "2:1"}),
        ("events of an object without events", "BadAttributeIdInvalid", {"node": OBJECTS, "attribute": NOTIFIER, "filter": events()}),
        ("events", "Good", {"node": SERVER, "attribute": NOTIFIER, "filter": events()}),
        ("events without a filter", "BadFilterNotAllowed", {"node": SERVER, "attribute": NOTIFIER}),
        ("events with a data change filter", "BadFilterNotAllowed", {"node": SERVER, "attribute": NOTIFIER, "filter": changes()}),
        ("a value with an event filter", "BadFilterNotAllowed", {"filter": events()}),
        ("a name with a deadband", "BadFilterNotAllowed", {"attribute": NAME, "filter": changes(kind=ABSOLUTE, value=1.0)}),
        ("a string with a deadband", "BadFilterNotAllowed", {"node": TEXT, "filter": changes(kind=ABSOLUTE, value=1.0)}),
        ("a number with a deadband", "Good", {"filter": changes(kind=ABSOLUTE, value=1.0)}),
        ("a negative deadband", "BadDeadbandFilterInvalid", {"filter": changes(kind=ABSOLUTE, value=-1.0)}),
        ("an unknown deadband type", "BadDeadbandFilterInvalid", {"filter": changes(kind=7, value=1.0)}),
        ("a percent deadband", "Good", {"node": RANGED, "filter": changes(kind=PERCENT, value=10.0)}),
        ("more than 100 percent", "BadDeadbandFilterInvalid", {"node": RANGED, "filter": changes(kind=PERCENT, value=101.0)}),
        (
            "a percent deadband without EURange",
            "BadMonitoredItemFilterUnsupported",
            {"filter": changes(kind=PERCENT, value=10.0)},
        ),
        ("an aggregate", "Good", {"filter": aggregate()}),
        ("an unknown aggregate", "BadAggregateNotSupported", {"filter": aggregate("NumberOfTransitions")}),
        ("an aggregate of a value without history", "BadMonitoredItemFilterUnsupported", {"node": TIME, "filter": aggregate()}),
        ("an aggregate of a name", "BadFilterNotAllowed", {"attribute": NAME, "filter": aggregate()}),
        ("an aggregate of parts of an array", "BadMonitoredItemFilterUnsupported", {"node": LIST, "range": "0:1", "filter": aggregate()}),
        ("a negative processing interval", "BadMonitoredItemFilterInvalid", {"filter": aggregate(interval=-1.0)}),
    ],
    Server.create,
)
row("CreateMonitoredItems", "5.13.2", "no items", "BadNothingToDo")(
    lambda server: server.ask("CreateMonitoredItems", SubscriptionId=server.subscription)
)


@row("CreateMonitoredItems", "7.21", "sampling intervals", "-1 is 1000, 0 is 0, 125.5 is 125.5")
async def _(server):
    found = []
    for wanted in (-1.0, 0.0, 125.5):
        created = await server.create({"sampling": wanted})
        found.append(f"{wanted:g} is {created.RevisedSamplingInterval:g}")
    return ", ".join(found)


@row("CreateMonitoredItems", "7.22.4", "processing intervals", "0 is 100, 125.5 is 125.5")
async def _(server):
    found = []
    for wanted in (0.0, 125.5):
        created = await server.create({"filter": aggregate(interval=wanted)})
        found.append(f"{wanted:g} is {created.FilterResult.RevisedProcessingInterval:g}")
    return ", ".join(found)


@row("CreateMonitoredItems", "7.22.4", "the Maximum of an interval", "9/401")
async def _(server):
    # The interval began before the values, and ends behind them also on a busy machine.
    start = datetime.datetime.now(datetime.timezone.utc) - datetime.timedelta(milliseconds=500)
    for value in (7.0, 9.0, 8.0):
        (await server.write({"value": value})).check()
    return await server.first({"filter": aggregate("Maximum", 5_500.0, start)})


row("CreateMonitoredItems", "5.13.1.5", "an overflow that discards the oldest value", "3/480 4/0")(
    lambda server: server.reported({"queue": 2}, [1.0, 2.0, 3.0, 4.0])
)
row("CreateMonitoredItems", "5.13.1.5", "an overflow that discards the newest value", "0/0 4/480")(
    lambda server: server.reported({"queue": 2, "oldest": False}, [1.0, 2.0, 3.0, 4.0])
)
row("CreateMonitoredItems", "5.13.1.5", "a queue of one value", "4/0")(
    lambda server: server.reported({"queue": 1}, [1.0, 2.0, 3.0, 4.0])
)
row("CreateMonitoredItems", "5.13.1.2", "each change", "0/0 1/0 2/0 3/0")(
    lambda server: server.reported({"sampling": 0.0}, [1.0, 2.0, 3.0])
)
row("CreateMonitoredItems", "5.13.1.2", "one sample an hour", "0/0")(
    lambda server: server.reported({"sampling": 3_600_000.0}, [1.0, 2.0, 3.0])
)


def modified(server, wanted):
    item = ua.MonitoredItemModifyRequest()
    item.MonitoredItemId = wanted.get("item", server.item)
    if "filter" in wanted:
        item.RequestedParameters.Filter = wanted["filter"]
    return server.one(
        "ModifyMonitoredItems",
        SubscriptionId=wanted.get("subscription", server.subscription),
        TimestampsToReturn=wanted.get("timestamps", ua.TimestampsToReturn.Both),
        ItemsToModify=[item],
    )


rows(
    "ModifyMonitoredItems",
    "5.13.3",
    [
        ("an item", "Good", {}),
        ("an unknown item", "BadMonitoredItemIdInvalid", {"item": 1 << 30}),
        ("an unknown subscription", "BadSubscriptionIdInvalid", {"subscription": 1 << 30}),
        ("invalid TimestampsToReturn", "BadTimestampsToReturnInvalid", {"timestamps": ua.TimestampsToReturn.Invalid}),
        ("a value with an event filter", "BadFilterNotAllowed", {"filter": events()}),
        ("a negative deadband", "BadDeadbandFilterInvalid", {"filter": changes(kind=ABSOLUTE, value=-1.0)}),
    ],
    modified,
)
row("ModifyMonitoredItems", "5.13.3", "no items", "BadNothingToDo")(
    lambda server: server.ask("ModifyMonitoredItems", SubscriptionId=server.subscription)
)


def with_items(service, **more):
    """Registers the rows of a service that takes the ids of a subscription's items."""
    clause = {"SetMonitoringMode": "5.13.4", "DeleteMonitoredItems": "5.13.6"}[service]

    def request(server, wanted):
        subscription = wanted.get("subscription", server.subscription)
        ids = [wanted["item"]] if "item" in wanted else []
        return server.ask(service, SubscriptionId=subscription, MonitoredItemIds=ids, **more)

    rows(
        service,
        clause,
        [
            ("no items", "BadNothingToDo", {}),
            ("an unknown item", "BadMonitoredItemIdInvalid", {"item": 1 << 30}),
            ("an unknown subscription", "BadSubscriptionIdInvalid", {"item": 1, "subscription": 1 << 30}),
        ],
        request,
    )


with_items("SetMonitoringMode", MonitoringMode=ua.MonitoringMode.Sampling)
with_items("DeleteMonitoredItems")


def triggering(server, wanted):
    return server.ask(
        "SetTriggering",
        SubscriptionId=wanted.get("subscription", server.subscription),
        TriggeringItemId=wanted.get("item", server.item),
        LinksToAdd=wanted.get("add", []),
    )


rows(
    "SetTriggering",
    "5.13.5",
    [
        ("no links", "BadNothingToDo", {}),
        ("an unknown link", "BadMonitoredItemIdInvalid", {"add": [1 << 30]}),
        ("an unknown item", "BadMonitoredItemIdInvalid", {"item": 1 << 30, "add": [1]}),
        ("an unknown subscription", "BadSubscriptionIdInvalid", {"subscription": 1 << 30, "add": [1]}),
    ],
    triggering,
)
row("ModifySubscription", "5.14.3", "an unknown subscription", "BadSubscriptionIdInvalid")(
    lambda server: server.ask("ModifySubscription", SubscriptionId=1 << 30)
)
for service, clause in (
    ("SetPublishingMode", "5.14.4"),
    ("TransferSubscriptions", "5.14.7"),
    ("DeleteSubscriptions", "5.14.8"),
):
    row(service, clause, "no subscriptions", "BadNothingToDo")(
        lambda server, service=service: server.ask(service, SubscriptionIds=[])
    )
    row(service, clause, "an unknown subscription", "BadSubscriptionIdInvalid")(
        lambda server, service=service: server.ask(service, SubscriptionIds=[1 << 30])
    )
row("Publish", "5.14.5", "a session without subscriptions", "BadNoSubscription")(
    lambda server: server.ask("Publish", server.other)
)
row("Republish", "5.14.6", "an unknown subscription", "BadSubscriptionIdInvalid")(
    lambda server: server.ask("Republish", SubscriptionId=1 << 30, RetransmitSequenceNumber=1)
)
row("Republish", "5.14.6", "an unknown message", "BadMessageNotAvailable")(
    lambda server: server.ask("Republish", SubscriptionId=server.subscription, RetransmitSequenceNumber=99)
)
row("HistoryRead", "5.11.3", "no nodes", "BadNothingToDo")(
    lambda server: server.ask("HistoryRead", HistoryReadDetails=ua.ReadRawModifiedDetails())
)


async def history(server, wanted):
    details = ua.ReadRawModifiedDetails()
    details.StartTime, details.NumValuesPerNode = datetime.datetime(2020, 1, 1), 1
    details.IsReadModified, details.ReturnBounds = wanted.get("modified", False), False
    node = ua.HistoryReadValueId()
    node.NodeId, node.ContinuationPoint = wanted.get("node", NUMBER), wanted.get("point")
    result = await server.one(
        "HistoryRead",
        HistoryReadDetails=wanted.get("details", details),
        TimestampsToReturn=wanted.get("timestamps", ua.TimestampsToReturn.Both),
        ReleaseContinuationPoints=False,
        NodesToRead=[node],
    )
    return result.StatusCode


rows(
    "HistoryRead",
    "5.11.3",
    [
        ("values", "Good", {}),
        ("modified values", "BadHistoryOperationUnsupported", {"modified": True}),
        ("an unknown node", "BadNodeIdUnknown", {"node": UNKNOWN}),
        ("a node without history", "BadHistoryOperationUnsupported", {"node": TIME}),
        ("an unknown continuation point", "BadContinuationPointInvalid", {"point": b"none"}),
        ("invalid TimestampsToReturn", "BadTimestampsToReturnInvalid", {"timestamps": ua.TimestampsToReturn.Invalid}),
        ("no timestamps", "BadTimestampsToReturnInvalid", {"timestamps": ua.TimestampsToReturn.Neither}),
        ("details that are no details", "BadHistoryOperationInvalid", {"details": ua.DataChangeFilter()}),
    ],
    history,
)


row("HistoryUpdate", "5.11.5", "no details", "BadNothingToDo")(
    lambda server: server.ask("HistoryUpdate", HistoryUpdateDetails=[])
)


@row("HistoryUpdate", "5.11.5", "the deletion of values", "BadHistoryOperationUnsupported")
async def _(server):
    details = ua.DeleteRawModifiedDetails()
    details.NodeId = NUMBER
    return (await server.one("HistoryUpdate", HistoryUpdateDetails=[details])).StatusCode


def changed(server, wanted):
    service, field, item, fields = wanted
    changed = item()
    for name, value in fields.items():
        setattr(changed, name, value)
    return server.ask(service, **{field: [changed] if fields else []})


ADDED = {
    "ParentNodeId": ua.ExpandedNodeId(85),
    "ReferenceTypeId": ua.NodeId(ua.ObjectIds.Organizes),
    "RequestedNewNodeId": ua.ExpandedNodeId(9998, 2),
    "BrowseName": ua.QualifiedName("added", 2),
    "NodeClass": ua.NodeClass.Object,
    "NodeAttributes": ua.ObjectAttributes(),
    "TypeDefinition": ua.ExpandedNodeId(ua.ObjectIds.BaseObjectType),
}
LINKED = {
    "SourceNodeId": OBJECTS,
    "ReferenceTypeId": ua.NodeId(ua.ObjectIds.Organizes),
    "IsForward": True,
    "TargetNodeId": ua.ExpandedNodeId(30, 2),
    "TargetNodeClass": ua.NodeClass.Variable,
}
UNLINKED = {name: value for name, value in LINKED.items() if name != "TargetNodeClass"}
for service, clause, case, field, item, fields in (
    ("AddNodes", "5.8.2", "nodes", "NodesToAdd", ua.AddNodesItem, ADDED),
    ("AddReferences", "5.8.3", "references", "ReferencesToAdd", ua.AddReferencesItem, LINKED),
    ("DeleteNodes", "5.8.4", "nodes", "NodesToDelete", ua.DeleteNodesItem, {"NodeId": NUMBER}),
    ("DeleteReferences", "5.8.5", "references", "ReferencesToDelete", ua.DeleteReferencesItem, UNLINKED),
):
    rows(
        service,
        clause,
        [
            (f"no {case}", "BadNothingToDo", (service, field, item, {})),
            ("a change of the address space", "BadServiceUnsupported", (service, field, item, fields)),
        ],
        changed,
    )
row("QueryFirst", "5.10.3", "no types", "BadNothingToDo")(lambda server: server.ask("QueryFirst", View=view()))
row("QueryNext", "5.10.4", "an unknown continuation point", "BadContinuationPointInvalid")(
    lambda server: server.ask("QueryNext", ContinuationPoint=b"none")
)


@row("QueryFirst", "5.10.3", "a query", "BadServiceUnsupported")
async def _(server):
    kind = ua.NodeTypeDescription()
    kind.TypeDefinitionNode, kind.IncludeSubTypes = ua.ExpandedNodeId(ua.ObjectIds.BaseObjectType), True
    request = ua.QueryFirstRequest()
    request.Parameters.View, request.Parameters.NodeTypes = view(), [kind]
    data = await server.client.uaclient.protocol.send_request(request, 10)
    # The response is no ServiceFault.
    return struct_from_binary(ua.QueryFirstResponse, data).ResponseHeader.ServiceResult


rows(
    "RegisterNodes",
    "5.9.5",
    [("a node", "Good", NUMBER)],
    lambda server, node: server.ask("RegisterNodes", NodesToRegister=[node]),
)
rows(
    "UnregisterNodes",
    "5.9.6",
    [("a node", "Good", NUMBER), ("an unknown node", "Good", UNKNOWN)],
    lambda server, node: server.ask("UnregisterNodes", NodesToUnregister=[node]),
)
row("FindServers", "5.5.2", "all servers", "Good")(lambda server: server.ask("FindServers"))
row("GetEndpoints", "5.5.4", "all endpoints", "Good")(lambda server: server.ask("GetEndpoints"))
row("FindServersOnNetwork", "5.5.3", "all servers", "BadServiceUnsupported")(
    lambda server: server.ask("FindServersOnNetwork")
)
row("RegisterServer", "5.5.5", "a server", "BadServiceUnsupported")(lambda server: registered(server, "RegisterServer"))
row("RegisterServer2", "5.5.6", "a server", "BadServiceUnsupported")(
    lambda server: registered(server, "RegisterServer2")
)


def registered(server, service):
    request = getattr(ua, f"{service}Request")()
    (getattr(request, "Parameters", None) or request).Server = ua.RegisteredServer()
    return server.send(request, server.client)


@row("CreateSubscription", "5.14.2", "publishing intervals", "0 is 10, -1 is 10, 125.5 is 125.5")
async def _(server):
    found = []
    for wanted in (0.0, -1.0, 125.5):
        made = await server.ask("CreateSubscription", RequestedPublishingInterval=wanted)
        await server.ask("DeleteSubscriptions", SubscriptionIds=[made.SubscriptionId])
        found.append(f"{wanted:g} is {made.RevisedPublishingInterval:g}")
    return ", ".join(found)


@row(
    "CreateSubscription",
    "5.14.2",
    "lifetimes and keep-alives in intervals of 500 ms",
    "10000 and 3000 are 1200 and 400, 100 and 10 are 100 and 10",
)
async def _(server):
    found = []
    for lifetime, keep_alive in ((10_000, 3_000), (100, 10)):
        made = await server.ask(
            "CreateSubscription",
            RequestedPublishingInterval=500.0,
            RequestedLifetimeCount=lifetime,
            RequestedMaxKeepAliveCount=keep_alive,
        )
        await server.ask("DeleteSubscriptions", SubscriptionIds=[made.SubscriptionId])
        revised = f"{made.RevisedLifetimeCount} and {made.RevisedMaxKeepAliveCount}"
        found.append(f"{lifetime} and {keep_alive} are {revised}")
    return ", ".join(found)


@row("ModifySubscription", "5.14.3", "publishing intervals", "0 is 10, 125.5 is 125.5")
async def _(server):
    subscription, found = await server.subscribed(), []
    for wanted in (0.0, 125.5):
        fields = {"SubscriptionId": subscription, "RequestedPublishingInterval": wanted}
        changed = await server.ask("ModifySubscription", **fields)
        found.append(f"{wanted:g} is {changed.RevisedPublishingInterval:g}")
    await server.ask("DeleteSubscriptions", SubscriptionIds=[subscription])
    return ", ".join(found)


row("SetPublishingMode", "5.14.4", "a subscription", "Good")(
    lambda server: server.ask("SetPublishingMode", PublishingEnabled=False, SubscriptionIds=[server.subscription])
)
row("TransferSubscriptions", "5.14.7", "another session of an anonymous user without security", "BadUserAccessDenied")(
    lambda server: server.ask("TransferSubscriptions", server.other, SubscriptionIds=[server.subscription])
)


@row("DeleteSubscriptions", "5.14.8", "a subscription, twice", "Good BadSubscriptionIdInvalid")
async def _(server):
    subscription = await server.subscribed()
    answers = [await server.ask("DeleteSubscriptions", SubscriptionIds=[subscription]) for _ in range(2)]
    return " ".join(statuses(one) for one in answers)


@row("CloseSession", "5.7.4", "a session, then a Read of it", "Good BadSessionIdInvalid")
async def _(server):
    client = Client(server.client.server_url.geturl(), timeout=20)
    await client.connect()
    leaving = Server(client, None)
    request = ua.CloseSessionRequest()
    request.DeleteSubscriptions = True
    closed = await outcome(leaving.send(request, client))
    read = await outcome(leaving.read({}))
    client.disconnect_socket()
    return f"{closed} {read}"


@row("Publish", "5.14.5", "ten requests of a subscription", "10 wait")
async def _(server):
    made = await server.ask(
        "CreateSubscription",
        server.other,
        RequestedPublishingInterval=60_000.0,
        RequestedLifetimeCount=10_000,
        RequestedMaxKeepAliveCount=1_000,
        PublishingEnabled=True,
    )
    requests = [ua.PublishRequest() for _ in range(10)]
    waiting = [asyncio.ensure_future(server.send(request, server.other)) for request in requests]
    while not all(request.RequestHeader.RequestHandle for request in requests):
        await asyncio.sleep(0)
    # A request that is too many answers the oldest one.
    done = await asyncio.wait(waiting, timeout=0.5)
    count = len(waiting) - len(done[0])
    await server.ask("DeleteSubscriptions", server.other, SubscriptionIds=[made.SubscriptionId])
    await asyncio.gather(*waiting, return_exceptions=True)
    return f"{count} wait"


@row("CreateSession", "5.7.2", "timeouts", "0 is 1000, 5000 is 5000, 1e+09 is 60000")
async def _(server):
    found = []
    for wanted in (0.0, 5_000.0, 1e9):
        url = server.client.server_url.geturl()
        created = await server.ask("CreateSession", server.other, EndpointUrl=url, RequestedSessionTimeout=wanted)
        found.append(f"{wanted:g} is {created.RevisedSessionTimeout:g}")
    return ", ".join(found)


@row("Cancel", "5.7.5", "a Publish request", "1 BadRequestCancelledByRequest")
async def _(server):
    publish = ua.PublishRequest()
    waiting = asyncio.ensure_future(server.send(publish, server.client))
    while not publish.RequestHeader.RequestHandle:
        await asyncio.sleep(0)
    cancelled = await server.ask("Cancel", RequestHandle=publish.RequestHeader.RequestHandle)
    return f"{cancelled.CancelCount} {await outcome(waiting)}"


row("Cancel", "5.7.5", "an unknown request", "0")(
    lambda server: counted(server.ask("Cancel", RequestHandle=1 << 30))
)


async def counted(cancelled):
    return str((await cancelled).CancelCount)


def statuses(answer):
    """Returns the statuses of a response, or of a part of it."""
    if isinstance(answer, str):
        return answer
    if isinstance(answer, ua.StatusCode):
        return ua.StatusCode(answer.value & 0xFFFF0000).name
    if isinstance(answer, list):
        return " ".join(statuses(one) for one in answer)
    for name in ("StatusCode", "Results", "AddResults"):
        found = getattr(answer, name, None)
        if found is not None:
            return statuses(found)
    return "Good"


async def outcome(answer):
    try:
        return statuses(await answer)
    except UaStatusCodeError as refused:
        return ua.StatusCode(refused.code).name
    except Exception as error:  # any failure is the outcome
        return repr(error)


async def run(args):
    async with Client(args.endpoint, timeout=20) as client, Client(args.endpoint, timeout=20) as other:
        server = Server(client, other)
        await server.prepare()
        for service, clause, case, expected, function in ROWS:
            got = await outcome(function(server))
            lifetime.say(service=service, clause=clause, case=case, expected=expected, got=got)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("endpoint")
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    # Each refused request would be logged.
    logging.disable(logging.ERROR)
    asyncio.run(run(args))


if __name__ == "__main__":
    main()
