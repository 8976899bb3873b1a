"""Calls skills like a client that knows only Programs of OPC 10000-10, and prints JSON lines.

opcua_skill.py ENDPOINT walk       all states and methods of skill 1, which does not end by itself,
                                   then a run of skill 2, which ends
opcua_skill.py ENDPOINT refused    responses of skill 3 to a Start without a parameter, with wrong
                                   parameters, and with good parameters
opcua_skill.py ENDPOINT frame      skill 3 with its position as a 3DFrame: written, and by Execute
opcua_skill.py ENDPOINT execute    Execute and ReadOutcome of skills 1 and 2, from two sessions, and
                                   the lock of OPC 10000-100
opcua_skill.py ENDPOINT begin      starts skill 1, prints the number of the run and ends
opcua_skill.py ENDPOINT after:RUN  state of skill 1, outcome of that run, number of the next run
opcua_skill.py ENDPOINT idle       how long the second of two sessions waits for the lease of the
                                   first, which is idle
opcua_skill.py ENDPOINT quick      states that a subscription with a queue shows of ten runs of
                                   skill 2
opcua_skill.py ENDPOINT race       two sessions start skill 2 at once, twenty times
opcua_skill.py ENDPOINT uses       targets of UsesSkill of skill 1 of the server's own namespace
opcua_skill.py ENDPOINT find:TYPE  objects of that type of urn:ua-bridge:skills or of a subtype
"""

import argparse
import asyncio
import json
import time

from asyncua import ua
from opcua_session import add_arguments, client_of, plain

STATES = {2406: "Halted", 2400: "Ready", 2402: "Running", 2404: "Suspended"}
METHODS = {"Start": 5, "Halt": 6, "Suspend": 7, "Resume": 8, "Reset": 9}
OF_THE_TYPE = {"Start": 2426, "Suspend": 2427, "Resume": 2428, "Halt": 2429, "Reset": 2430}
WAYS = {
    "Halted": [],
    "Ready": ["Reset"],
    "Running": ["Reset", "Start"],
    "Suspended": ["Reset", "Start", "Suspend"],
}
FIELDS = [
    ["EventType"], ["SourceName"], ["Severity"], ["Message"], ["FromState"], ["FromState", "Id"], ["FromState", "Number"],
    ["ToState"], ["ToState", "Id"], ["ToState", "Number"], ["Transition"], ["Transition", "Id"], ["Transition", "Number"],
]


def say(**what):
    print(json.dumps(what), flush=True)


class Skill:
    def __init__(self, client, ns, number):
        self.client, self.ns, self.first = client, ns, 100 * number
        self.node = self.at(0)

    def at(self, offset):
        return self.client.get_node(ua.NodeId(self.first + offset, self.ns))

    async def child(self, *path):
        node = self.node
        for name in path:
            children = await node.get_children()
            names = [(await child.read_browse_name()).Name for child in children]
            node = children[names.index(name)]
        return node

    async def state(self):
        current = await self.child("CurrentState", "Id")
        return STATES[(await current.read_value()).Identifier]

    async def is_in(self, state):
        return await self.state() == state

    async def shown(self):
        values = [await self.state()]
        for path in [("CurrentState",), ("CurrentState", "Number"), ("RunId",), ("LastTransition",)]:
            # Before the first transition LastTransition has a bad status.
            shown = await (await self.child(*path)).read_data_value(raise_on_bad_status=False)
            value = shown.Value.Value if shown.Value else None
            values.append(value.Text if isinstance(value, ua.LocalizedText) else plain(value))
        return values

    async def call(self, method, of_type=False):
        node = ua.NodeId(OF_THE_TYPE[method], 0) if of_type else self.at(METHODS[method]).nodeid
        try:
            await self.node.call_method(node)
            return "Good"
        except ua.UaStatusCodeError as error:
            return ua.status_codes.get_name_and_doc(error.code)[0]

    async def executable(self, method):
        return (await self.at(METHODS[method]).read_attribute(ua.AttributeIds.Executable)).Value.Value

    async def write(self, name, value):
        node = await self.child("ParameterSet", name)
        try:
            await node.write_value(value)
            return "Good"
        except ua.UaStatusCodeError as error:
            return ua.status_codes.get_name_and_doc(error.code)[0]

    async def result(self):
        group = await self.child("FinalResultData")
        result = {}
        for child in await group.get_children():
            result[(await child.read_browse_name()).Name] = plain(await child.read_value())
        return result


class Events:
    """Collects the transition events of skills."""

    def __init__(self):
        self.seen = []

    async def begin(self, client, skills):
        subscription = await client.create_subscription(20, self)
        selects = [
            ua.SimpleAttributeOperand(
                TypeDefinitionId=ua.NodeId(ua.ObjectIds.BaseEventType),
                BrowsePath=[ua.QualifiedName(name, 0) for name in path],
                AttributeId=ua.AttributeIds.Value,
            )
            for path in FIELDS
        ]
        for skill in skills:
            await subscription.subscribe_events(skill.node, evfilter=ua.EventFilter(SelectClauses=selects), queuesize=100)

    def event_notification(self, event):
        values = {}
        for path, field in zip(FIELDS, event.event_fields):
            value = field.Value
            if isinstance(value, ua.NodeId):
                value = value.to_string()
            elif isinstance(value, ua.LocalizedText):
                value = value.Text
            values[".".join(path)] = value
        self.seen.append(values)
        say(event=values)


async def until(what, seconds=20):
    for _ in range(int(seconds / 0.02)):
        if await what():
            return
        await asyncio.sleep(0.02)
    raise TimeoutError


async def walk(client, ns):
    skill, quick = Skill(client, ns, 1), Skill(client, ns, 2)
    events = Events()
    await events.begin(client, [skill, quick])
    for state, way in WAYS.items():
        for method in METHODS:
            if await skill.state() != "Halted":
                await skill.call("Halt")
            for step in way:
                assert await skill.call(step) == "Good", (state, step)
            before, executable = await skill.shown(), await skill.executable(method)
            status = await skill.call(method, of_type=method == "Start")
            after = await skill.shown()
            say(state=state, method=method, executable=executable, status=status, before=before, after=after)
    await quick.call("Reset")
    await quick.call("Start")

    async def ended():
        return await quick.state() == "Ready"

    await until(ended)
    shown = await quick.shown()
    say(result=await quick.result(), state=shown[0], run=shown[3])
    diagnostic = await (await quick.child("ProgramDiagnostic")).read_value()
    say(diagnostic={"method": diagnostic.LastMethodCall, "status": diagnostic.LastMethodReturnStatus.name})

    async def all_seen():
        return {event["Transition.Number"] for event in events.seen} == set(range(1, 10))

    await until(all_seen)


async def refused(client, ns):
    move = Skill(client, ns, 3)
    await move.call("Reset")
    double = lambda value, kind=ua.VariantType.Double: ua.Variant(value, kind)
    say(what="without", status=await move.call("Start"), shown=await move.shown())
    say(what="short", status=await move.write("TargetPosition", double([0.1] * 5)), shown=await move.shown())
    say(what="text", status=await move.write("TargetPosition", ua.Variant("here")), shown=await move.shown())
    say(what="fast", status=await move.write("MaxVelocity", double(99.0)), shown=await move.shown())
    await move.write("TargetPosition", double([3.0] * 6))
    say(what="far", status=await move.call("Start"), shown=await move.shown())
    await move.write("TargetPosition", double([0.3, 0.1, 0.4, 0.0, 0.0, 0.0]))
    say(what="good", status=await move.call("Start"), shown=await move.shown())
    say(what="while it runs", status=await move.write("MaxVelocity", double(1.0)), shown=await move.shown())


def three_d_frame(x, y, z, a, b, c):
    return ua.ThreeDFrame(ua.ThreeDCartesianCoordinates(x, y, z), ua.ThreeDOrientation(a, b, c))


async def frame(client, ns):
    move = Skill(client, ns, 3)
    await move.call("Reset")
    parameter = await move.child("ParameterSet", "TargetPosition")
    written = await move.write("TargetPosition", three_d_frame(0.3, 0.1, 0.4, 0.0, 0.5, 0.0))
    say(what="written", status=written, value=plain(await parameter.read_value()))
    wrong = ua.Variant(ua.ThreeDCartesianCoordinates(0.3, 0.1, 0.4))
    say(what="not a frame", status=await move.write("TargetPosition", wrong), value=plain(await parameter.read_value()))
    status = await move.call("Start")
    await until(lambda: move.is_in("Ready"))
    say(what="started", status=status, value=(await move.result())["Position"])
    target = ua.Variant([ua.Variant(three_d_frame(0.4, 0.0, 0.4, 0.0, 0.0, 0.0))], ua.VariantType.Variant, is_array=True)
    status, _ = await asked(move, "Execute", names("TargetPosition"), target, timeout(0))
    await until(lambda: move.is_in("Ready"))
    say(what="executed", status=status, value=(await move.result())["Position"])


async def asked(of, method, *arguments):
    """Returns the status of a call, and its output."""
    try:
        given = await of.node.call_method(await of.child(method), *arguments)
        return "Good", [plain(value) for value in given] if isinstance(given, list) else plain(given)
    except ua.UaStatusCodeError as error:
        return ua.status_codes.get_name_and_doc(error.code)[0], None


def names(*of):
    return ua.Variant(list(of), ua.VariantType.String, is_array=True)


def values(*of):
    return ua.Variant([ua.Variant(value) for value in of], ua.VariantType.Variant, is_array=True)


def timeout(ms):
    return ua.Variant(float(ms), ua.VariantType.Double)


def number(run):
    return ua.Variant(run, ua.VariantType.UInt32)


async def begin(client, ns, _other):
    status, run = await asked(Skill(client, ns, 1), "Execute", names(), values(), timeout(0))
    say(status=status, run=run)


async def after(client, ns, run):
    skill = Skill(client, ns, 1)
    shown = await skill.shown()
    known = await asked(skill, "ReadOutcome", number(run))
    status, newer = await asked(skill, "Execute", names(), values(), timeout(0))
    say(state=shown[0], shown=shown[3], known=known[0], status=status, run=newer)


async def idle(client, ns, other):
    mine, theirs = Skill(client, ns, 2), Skill(other, ns, 2)
    assert await mine.call("Reset") == "Good"
    began = time.monotonic()
    say(what="at once", status=await theirs.call("Start"))

    async def free():
        return await theirs.call("Start") == "Good"

    await until(free)
    say(what="later", seconds=time.monotonic() - began, mine=await mine.call("Halt"))


async def race(client, ns, other):
    skills = [Skill(client, ns, 2), Skill(other, ns, 2)]
    component = await client.nodes.objects.get_child([f"{ns}:bench"])
    di = await client.get_namespace_index("http://opcfoundation.org/UA/DI/")
    locks = [await of.get_node(component.nodeid).get_child([f"{di}:Lock"]) for of in (client, other)]
    execute = [await skill.child("Execute") for skill in skills]

    async def one(skill, method):
        try:
            return "Good", await skill.node.call_method(method, names(), values(), timeout(0))
        except ua.UaStatusCodeError as error:
            return ua.status_codes.get_name_and_doc(error.code)[0], None

    for _ in range(20):
        both = await asyncio.gather(*[one(*pair) for pair in zip(skills, execute)])
        say(race=sorted(status for status, _ in both), runs=[run for _, run in both if run is not None])

        async def ended():
            return await skills[0].state() in ("Ready", "Halted")

        await until(ended)
        winner = [status for status, _ in both].index("Good")
        # The session of the winner holds the lease until it releases it.
        await locks[winner].call_method(f"{di}:InitLock", "")
        await locks[winner].call_method(f"{di}:ExitLock")


class States:
    def __init__(self):
        self.seen = []

    def datachange_notification(self, _node, value, _data):
        self.seen.append(value.Text)


async def quick(client, ns, _other):
    skill, states = Skill(client, ns, 2), States()
    await skill.call("Reset")
    subscription = await client.create_subscription(100, states)
    await subscription.subscribe_data_change(await skill.child("CurrentState"), queuesize=50, sampling_interval=100)
    for _ in range(10):
        status, _run = await asked(skill, "Execute", names(), values(), timeout(0))
        assert status == "Good", status

        async def ended():
            return await skill.state() in ("Ready", "Halted")

        await until(ended)

    async def all_seen():
        return states.seen.count("Running") >= 10 and states.seen[-1] != "Running"

    try:
        await until(all_seen, 5)
    except TimeoutError:
        pass
    say(seen=states.seen)


async def execute(client, ns, other):
    hold, quick = Skill(client, ns, 1), Skill(client, ns, 2)
    theirs = Skill(other, ns, 2)
    uneven = await asked(hold, "Execute", names("Force"), values(), timeout(0))
    say(what="uneven", status=uneven[0], state=await hold.state())
    wrong = await asked(hold, "Execute", names("Force"), values("much"), timeout(0))
    say(what="wrong", status=wrong[0], state=await hold.state())
    status, run = await asked(quick, "Execute", names(), values(), timeout(0))
    say(what="without", status=status)

    async def ended():
        return (await asked(theirs, "ReadOutcome", number(run)))[1][0]

    await until(ended)
    say(what="outcome", run=run, outcome=(await asked(theirs, "ReadOutcome", number(run)))[1])
    say(what="newest", outcome=(await asked(theirs, "ReadOutcome", number(0)))[1])
    say(what="unknown", status=(await asked(theirs, "ReadOutcome", number(run - 1)))[0])
    status, run = await asked(hold, "Execute", names("Force"), values(3.5), timeout(300))
    say(what="given", status=status, force=await (await hold.child("ParameterSet", "Force")).read_value())

    async def halted():
        return await hold.state() == "Halted"

    await until(halted)
    say(what="late", outcome=(await asked(hold, "ReadOutcome", number(run)))[1])

    di = await client.get_namespace_index("http://opcfoundation.org/UA/DI/")
    component = await client.nodes.objects.get_child([f"{ns}:bench"])
    lock = await component.get_child([f"{di}:Lock"])
    locked = await lock.get_child([f"{di}:Locked"])
    say(what="lock", other=await theirs.call("Reset"), locked=await locked.read_value())
    init = await lock.call_method(f"{di}:InitLock", "a person at a panel")
    client_name = await (await lock.get_child([f"{di}:LockingClient"])).read_value()
    say(what="locked", init=init, other=await theirs.call("Reset"), locked=await locked.read_value(), by=client_name)
    exit_lock = await lock.call_method(f"{di}:ExitLock")
    say(what="unlocked", exit=exit_lock, other=await theirs.call("Halt"), locked=await locked.read_value())


async def find(client, name):
    """Finds objects by the references of types; the only name is the name of the wanted type."""
    ns = await client.get_namespace_index("urn:ua-bridge:skills")
    path = ["0:Types", "0:ObjectTypes", "0:BaseObjectType"]
    types, wanted = [await client.nodes.root.get_child(path)], None
    for of in types:
        if (await of.read_browse_name()) == ua.QualifiedName(name, ns):
            wanted = of
        types += await of.get_children(refs=ua.ObjectIds.HasSubtype)
    closure = [wanted]
    for of in closure:
        closure += await of.get_children(refs=ua.ObjectIds.HasSubtype)
    ids = [of.nodeid for of in closure]
    objects = [client.nodes.objects]
    for node in objects:
        if node.nodeid == ua.NodeId(ua.ObjectIds.Server):
            continue
        definition = await node.read_type_definition()
        if definition in ids:
            of = (await client.get_node(definition).read_browse_name()).Name
            say(name=(await node.read_browse_name()).Name, type=of, node=node.nodeid.to_string())
        else:
            objects += await node.get_children(nodeclassmask=ua.NodeClass.Object)


async def uses(client):
    own = client.get_node(ua.NodeId(100, 1))
    types = await client.get_namespace_index("urn:ua-bridge:skills")
    references = client.get_node(ua.NodeId(ua.ObjectIds.NonHierarchicalReferences))
    named = [of for of in await references.get_children() if await of.read_browse_name() == ua.QualifiedName("UsesSkill", types)]
    for used in await own.get_referenced_nodes(refs=named[0].nodeid, includesubtypes=False):
        values = [await (await used.get_child([f"{types}:{name}"])).read_value() for name in ("Component", "Type")]
        say(uses=values)


async def main():
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    parser.add_argument("part")
    args = parser.parse_args()
    async with await client_of(args) as client:
        if args.part.startswith("find:"):
            await find(client, args.part.removeprefix("find:"))
            return
        if args.part == "uses":
            await uses(client)
            return
        ns = await client.get_namespace_index("urn:ua-bridge:system-tests:component")
        if args.part.startswith("after:"):
            await after(client, ns, int(args.part.removeprefix("after:")))
            return
        of_two = {"begin": begin, "quick": quick, "execute": execute, "idle": idle, "race": race}
        if args.part in of_two:
            async with await client_of(args) as other:
                await of_two[args.part](client, ns, other)
            return
        await {"walk": walk, "refused": refused, "frame": frame}[args.part](client, ns)


asyncio.run(main())
